"""Map images: hillshade, a quantity in colour on it, title, colour bar, scale and north arrow."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from station.products.colours import (
    ColourScale,
    Pixels,
    change_scale,
    points_scale,
    shared_palette,
    sigma_scale,
)
from station.products.overview import BaseMap, Overview
from station.quantities import Bools

ASSETS = Path(__file__).parent / "assets"
UNSEEN = "not observed"  # in the legend
MAX_BYTES = 150_000  # of a map: ten seconds at 128 kbit/s
LOSSLESS = 100  # in the shared palette
# Quality of WebP and scale of the image; the first that is small enough is used.
QUALITIES = ((LOSSLESS, 1.0), (82, 1.0), (65, 1.0), (45, 1.0), (25, 1.0), (40, 0.7), (40, 0.5))
SAMPLE_ROWS, SAMPLE_STEP = 32, 12  # bands from which the file size is estimated …
SIZE_TOLERANCE = 0.15  # … to within this share
MAX_ASPECT = 1.1  # largest height of a map, in widths of the image
PAPER, INK, FAINT = (250, 250, 248), (30, 33, 38), (105, 110, 118)
HATCH, HATCH_PX = (176, 168, 188), 8  # lines on ground that was not observed, and their distance
UNOBSERVED_GREY, OBSERVED_GREY = (
    (216.0, 40.0),
    (128.0, 84.0),
)  # grey of terrain in the shade, and what full light adds


@dataclass(frozen=True)
class Caption:
    """The text around a map."""

    station: str
    time_text: str
    verdict: str = ""  # empty if it is good


def change_map(
    overview: Overview, caption: Caption, limit_m: float, width_px: int, since: str
) -> Image.Image:
    """Return a map of change: coloured where significant at 95 %, grey where not, hatched where not seen."""
    scale = change_scale(limit_m, since, on_map=overview.base.grid.plane.is_map)
    observed, significant = overview.observed, overview.is_significant
    light = np.nan_to_num(overview.base.hillshade, nan=0.63)[..., None]
    painted = _terrain(overview, observed)
    coloured = scale.paint(overview.change_m[significant]) * (0.80 + 0.30 * light[significant])
    painted[significant] = np.minimum(coloured, 255).astype(np.uint8)
    grey = int(OBSERVED_GREY[0] + 0.63 * OBSERVED_GREY[1])
    legend = (
        ("not significant (95 %)", (grey,) * 3),
        (UNSEEN, (int(UNOBSERVED_GREY[0] + 0.63 * UNOBSERVED_GREY[1]),) * 3),
    )
    subtitle = "nothing observed"
    if observed.any():
        subtitle = (
            f"median σ {_format_metres(float(np.median(overview.sigma_m[observed])))} ·"
            f" {100 * np.count_nonzero(significant) / np.count_nonzero(observed):.0f} % changed"
        )
    return _compose(painted, overview, caption, scale, legend, subtitle, width_px)


def sigma_map(overview: Overview, caption: Caption, limit_m: float, width_px: int) -> Image.Image:
    """Return a map of the sigma of the change, on a scale of two decades up to the limit of the change."""
    observed = overview.observed
    subtitle = ""
    if observed.any():
        low, high = np.percentile(overview.sigma_m[observed], [5, 95])
        subtitle = f"90 % between {_format_metres(float(low))} and {_format_metres(float(high))}"
    scale = sigma_scale(limit_m)
    return _compose(
        _overlay(overview, observed, scale, overview.sigma_m),
        overview,
        caption,
        scale,
        (),
        subtitle,
        width_px,
    )


def points_map(overview: Overview, caption: Caption, width_px: int) -> Image.Image:
    """Return a map of the points per cell; cells that were not observed are pale."""
    points = overview.points if overview.points is not None else np.full_like(overview.change_m, np.nan)
    observed, known = np.isfinite(points), np.isfinite(overview.base.hillshade)
    share = np.count_nonzero(observed & known) / (np.count_nonzero(known) or 1)
    subtitle = f"{100 * share:.0f} % of the known ground observed"
    scale = points_scale()
    return _compose(
        _overlay(overview, observed, scale, points), overview, caption, scale, (), subtitle, width_px
    )


def encode_webp(picture: Image.Image, max_bytes: int = MAX_BYTES) -> bytes:
    """Return an image as WebP: lossless in the shared palette if small enough, else in the best quality.

    Cells larger than a pixel compress well without loss; a field of single noisy pixels does not. A sample of
    bands shows which quality can succeed: trying all of them on the whole image takes twice as long.
    """
    bands = np.arange(picture.height) // SAMPLE_ROWS
    chosen = bands % SAMPLE_STEP == min(SAMPLE_STEP // 2, bands[-1] // 2)
    sample, share = Image.fromarray(np.asarray(picture)[chosen]), np.mean(chosen)
    encoded_bytes = b""
    for setting in QUALITIES:
        if setting != QUALITIES[-1] and len(_webp(sample, *setting)) / share > max_bytes * (
            1 + SIZE_TOLERANCE
        ):
            continue
        encoded_bytes = _webp(picture, *setting)
        if len(encoded_bytes) <= max_bytes:
            break
    return encoded_bytes


def quantise(picture: Image.Image) -> Image.Image:
    """Return an image quantised to the shared palette."""
    palette_image = Image.new("P", (1, 1))
    palette_image.putpalette(shared_palette().tobytes())
    return picture.quantize(palette=palette_image, dither=Image.Dither.NONE)


def _webp(picture: Image.Image, quality: int, size: float) -> bytes:
    stream = io.BytesIO()
    if quality == LOSSLESS:
        quantise(picture).convert("RGB").save(stream, "WEBP", lossless=True, quality=20, method=1)
    else:
        scaled = picture if size == 1 else ImageOps.scale(picture, size, Image.Resampling.BOX)
        scaled.save(stream, "WEBP", quality=quality, method=2)
    return stream.getvalue()


def _terrain(overview: Overview, observed: Bools) -> Pixels:
    """Return the terrain in grey: darker where observed, pale where not, paper colour where unknown."""
    shade = overview.base.hillshade
    known = np.isfinite(shade)
    light = np.where(known, shade, np.float32(0.63))
    grey = np.where(
        observed, OBSERVED_GREY[0] + OBSERVED_GREY[1] * light, UNOBSERVED_GREY[0] + UNOBSERVED_GREY[1] * light
    )
    painted = np.repeat(np.minimum(grey, 255).astype(np.uint8)[..., None], 3, axis=-1)
    painted[~known & ~observed] = PAPER
    return painted


def _overlay(overview: Overview, observed: Bools, scale: ColourScale, values: np.ndarray) -> Pixels:
    painted = _terrain(overview, np.zeros_like(observed))
    painted[observed] = scale.paint(values[observed])
    return painted


def map_box(base: BaseMap, width_px: int) -> tuple[float, float, float, float]:
    """Return where the map is in its image: left, top, width and height as shares of the image's size."""
    _, _, (left, top, right, bottom), height_px = _layout(base.grid.ny, base.grid.nx, width_px)
    width = right - left
    return left / width_px, top / height_px, width / width_px, (bottom - top) / height_px


def _layout(ny: int, nx: int, width_px: int) -> tuple[int, int, tuple[int, int, int, int], int]:
    """Return margin, inner width, box of the map, and height of an image [pixels]."""
    unit = width_px / 1200
    margin, header_height, footer_height = round(24 * unit), round(92 * unit), round(104 * unit)
    inner = width_px - 2 * margin
    stretch = min(inner / nx, MAX_ASPECT * inner / ny)
    width, height = max(1, round(nx * stretch)), max(1, round(ny * stretch))
    left = (width_px - width) // 2
    box = left, header_height, left + width, header_height + height
    return margin, inner, box, header_height + height + footer_height


def _compose(
    painted: Pixels,
    overview: Overview,
    caption: Caption,
    scale: ColourScale,
    legend: tuple[tuple[str, tuple[int, ...]], ...],
    subtitle: str,
    width_px: int,
) -> Image.Image:
    """Return the whole image: the map with title, colour bar, legend, scale and north arrow."""
    unit = width_px / 1200
    ny, nx = painted.shape[:2]
    margin, inner, box, height_px = _layout(ny, nx, width_px)
    corner, size = box[:2], (box[2] - box[0], box[3] - box[1])
    resampling = Image.Resampling.NEAREST if size[0] >= nx else Image.Resampling.BOX
    unseen = np.isfinite(overview.base.hillshade) & ~overview.observed
    map_image = _hatch(Image.fromarray(painted).resize(size, resampling), unseen)
    picture = Image.new("RGB", (width_px, height_px), PAPER)
    picture.paste(map_image, corner)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((box[0] - 1, box[1] - 1, box[2], box[3]), outline=(205, 207, 210))
    _draw_header(draw, caption, subtitle, width_px, margin, unit)
    _draw_colour_bar(draw, scale, (margin, box[3] + round(16 * unit)), round(inner * 0.56), unit)
    _legend(draw, legend, (margin + round(inner * 0.64), box[3] + round(22 * unit)), unit)
    grid = overview.base.grid
    upward = "N" if grid.plane.is_map else "up"
    _draw_north_and_scale(picture, box, grid.cell_m * nx / size[0], unit, upward)
    return picture


def _hatch(map_image: Image.Image, unseen: Bools) -> Image.Image:
    """Return a map with lines where nothing was observed: bright ground alone would look the same."""
    width, height = map_image.size
    lines = (np.add.outer(np.arange(height), np.arange(width)) % HATCH_PX) == 0
    pixels = np.array(map_image)
    pixels[lines & np.asarray(Image.fromarray(unseen).resize(map_image.size))] = HATCH
    return Image.fromarray(pixels)


def _draw_header(
    draw: ImageDraw.ImageDraw, caption: Caption, subtitle: str, width: int, margin: int, unit: float
) -> None:
    large, small = font(30 * unit), font(21 * unit)
    x_max, baseline = width - margin, round(50 * unit)
    draw.text((x_max, baseline), caption.time_text, INK, large, anchor="rs")
    max_width = x_max - draw.textlength(caption.time_text, large) - 2 * margin - margin
    draw.text((margin, baseline), _truncate(draw, caption.station, large, max_width), INK, large, anchor="ls")
    second_baseline = round(80 * unit)
    draw.text((x_max, second_baseline), subtitle, FAINT, small, anchor="rs")
    max_width = x_max - draw.textlength(subtitle, small) - 3 * margin
    if caption.verdict:
        draw.text(
            (margin, second_baseline),
            _truncate(draw, caption.verdict, small, max_width),
            (158, 60, 0),
            small,
            anchor="ls",
        )


def _draw_colour_bar(
    draw: ImageDraw.ImageDraw, scale: ColourScale, corner: tuple[int, int], length: int, unit: float
) -> None:
    x_min, top = corner
    height, small = round(18 * unit), font(19 * unit)
    pad = round(26 * unit)  # space for half a label at either end
    x_min, length = x_min + pad, length - 2 * pad
    bar = Image.fromarray(np.ascontiguousarray(scale.colour_table()[None]))
    draw._image.paste(bar.resize((length, height)), (x_min, top))  # noqa: SLF001 - the image drawn on
    draw.rectangle((x_min - 1, top - 1, x_min + length, top + height), outline=(150, 152, 156))
    for tick, share in zip(scale.ticks, scale.position(np.array(scale.ticks)), strict=True):
        x = x_min + round(float(share) * (length - 1))
        draw.line((x, top + height, x, top + height + round(5 * unit)), INK, max(1, round(1.5 * unit)))
        draw.text((x, top + height + round(8 * unit)), _format_tick(tick, scale), INK, small, anchor="mt")
    draw.text((x_min, top + height + round(36 * unit)), scale.title, INK, small, anchor="lt")


def _legend(
    draw: ImageDraw.ImageDraw,
    legend: tuple[tuple[str, tuple[int, ...]], ...],
    corner: tuple[int, int],
    unit: float,
) -> None:
    x_min, top = corner
    side, small = round(18 * unit), font(19 * unit)
    for text, colour in legend:
        draw.rectangle((x_min, top, x_min + side, top + side), fill=colour, outline=(150, 152, 156))
        for offset in range(0, side + 1, HATCH_PX) if text == UNSEEN else ():
            draw.line((x_min, top + offset, x_min + offset, top), HATCH)
            draw.line((x_min + offset, top + side, x_min + side, top + offset), HATCH)
        draw.text((x_min + round(1.5 * side), top + side // 2), text, INK, small, anchor="lm")
        top += round(30 * unit)


def _draw_north_and_scale(
    picture: Image.Image, box: tuple[int, int, int, int], pixel_m: float, unit: float, upward: str
) -> None:
    """Draw scale and arrow, to the north or what is `upward`, on a plate in the lower left of the map."""
    x_min, _, x_max, bottom = box
    length_m = _round_down(pixel_m * (x_max - x_min) / 5)
    length, small, gap = round(length_m / pixel_m), font(19 * unit), round(12 * unit)
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    arrow = round(30 * unit)
    width, height = length + arrow + 3 * gap, round(52 * unit)
    plate = Image.new("RGBA", (width, height), (*PAPER, 215))
    corner = x_min + gap, bottom - gap - height
    picture.paste(plate, corner, plate)
    draw = ImageDraw.Draw(picture)
    x, y = corner[0] + gap, corner[1] + round(40 * unit)
    thick = max(2, round(3 * unit))
    draw.line((x, y, x + length, y), INK, thick)
    for end in (x, x + length):
        draw.line((end, y - round(7 * unit), end, y), INK, thick)
    draw.text((x + length / 2, y - round(6 * unit)), text, INK, small, anchor="ms")
    middle, top = x + length + gap + arrow // 2, corner[1] + round(6 * unit)
    draw.polygon(
        [
            (middle, top),
            (middle + arrow // 3, top + round(22 * unit)),
            (middle, top + round(17 * unit)),
            (middle - arrow // 3, top + round(22 * unit)),
        ],
        fill=INK,
    )
    draw.text((middle, y + round(5 * unit)), upward, INK, small, anchor="ms")


@lru_cache(maxsize=8)
def font(size: float) -> ImageFont.FreeTypeFont:
    """Return the font of the maps in a size [pixels]."""
    return ImageFont.truetype(str(ASSETS / "dejavu.ttf"), max(7.0, size))


def _truncate(draw: ImageDraw.ImageDraw, text: str, face: ImageFont.FreeTypeFont, max_width: float) -> str:
    """Return a line of text, truncated to a width [pixels]."""
    text = " ".join(text.split())
    if draw.textlength(text, face) <= max_width:
        return text
    while text and draw.textlength(f"{text}…", face) > max_width:
        text = text[:-1]
    return f"{text}…"


def _format_tick(tick: float, scale: ColourScale) -> str:
    sign = "−" if tick < 0 else "+" if tick > 0 and scale.low < 0 else ""
    return f"{sign}{abs(tick):.3g}"


def _format_metres(length_m: float) -> str:
    return f"{length_m:.3f} m" if length_m < 0.1 else f"{length_m:.2f} m"


def _round_down(max_length_m: float) -> float:
    """Return a length rounded down to 1, 2, 5, 10 … [m]."""
    decade = 10.0 ** np.floor(np.log10(max_length_m))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= max_length_m * (1 + 1e-9)))
