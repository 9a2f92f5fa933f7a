"""Maps: terrain, a number in colour over it, and what is needed to read them, in one picture."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from station.products.colours import Pixels, Scale, change_scale, palette, points_scale, sigma_scale
from station.products.look import Look
from station.quantities import Bools

ASSETS = Path(__file__).parent / "assets"
MOST_BYTES = 150_000  # of a map: ten seconds at 128 kbit/s
LOSSLESS = 100  # in few colours
# Quality of WebP, and how much smaller the picture: the first that is small enough.
QUALITIES = ((LOSSLESS, 1.0), (82, 1.0), (65, 1.0), (45, 1.0), (25, 1.0), (40, 0.7), (40, 0.5))
SAMPLE_ROWS, SAMPLE_ONE_IN = 32, 12  # bands that tell how large a picture becomes …
DOUBT = 0.15  # … within so much
TALLEST = 1.1  # a map is as high as the picture is wide, and no more
PAPER, INK, FAINT = (250, 250, 248), (30, 33, 38), (105, 110, 118)
UNSEEN, MUTED = (216.0, 40.0), (128.0, 84.0)  # grey of terrain in the shade, and how much light adds


@dataclass(frozen=True)
class Caption:
    """What stands around a map."""

    station: str
    when: str
    verdict: str = ""  # where it is not good


def change_map(look: Look, caption: Caption, limit_m: float, width_px: int, since: str) -> Image.Image:
    """Change in colour where it is significant at 95 %; grey where it is not, pale where nothing was seen."""
    scale = change_scale(limit_m, since)
    seen, certain = look.seen, look.is_significant
    light = np.nan_to_num(look.base.shade, nan=0.63)[..., None]
    painted = _terrain(look, seen)
    coloured = scale.paint(look.change_m[certain]) * (0.80 + 0.30 * light[certain])
    painted[certain] = np.minimum(coloured, 255).astype(np.uint8)
    grey = int(MUTED[0] + 0.63 * MUTED[1])
    keys = (("not significant (95 %)", (grey,) * 3), ("not seen", (int(UNSEEN[0] + 0.63 * UNSEEN[1]),) * 3))
    told = "nothing seen"
    if seen.any():
        told = (
            f"median σ {_metres(float(np.median(look.sigma_m[seen])))} ·"
            f" {100 * np.count_nonzero(certain) / np.count_nonzero(seen):.0f} % changed"
        )
    return _picture(painted, look, caption, scale, keys, told, width_px)


def sigma_map(look: Look, caption: Caption, limit_m: float, width_px: int) -> Image.Image:
    """One sigma of the change, on a scale of two decades up to the limit of the change."""
    seen = look.seen
    told = ""
    if seen.any():
        low, high = np.percentile(look.sigma_m[seen], [5, 95])
        told = f"nine tenths between {_metres(float(low))} and {_metres(float(high))}"
    scale = sigma_scale(limit_m)
    return _picture(_over(look, seen, scale, look.sigma_m), look, caption, scale, (), told, width_px)


def points_map(look: Look, caption: Caption, width_px: int) -> Image.Image:
    """How many points the cells have, and which were not seen."""
    points = look.points if look.points is not None else np.full_like(look.change_m, np.nan)
    seen, known = np.isfinite(points), np.isfinite(look.base.shade)
    share = np.count_nonzero(seen & known) / (np.count_nonzero(known) or 1)
    told = f"{100 * share:.0f} % of the known ground seen"
    scale = points_scale()
    return _picture(_over(look, seen, scale, points), look, caption, scale, (), told, width_px)


def encoded(picture: Image.Image, most_bytes: int = MOST_BYTES) -> bytes:
    """Return a picture as WebP: crisp in few colours where that is small enough, else as good as it may be.

    Cells larger than a pixel are small so; a field of single noisy pixels is not. Some bands tell which
    quality has a chance: to try all of them on the whole takes twice as long.
    """
    bands = np.arange(picture.height) // SAMPLE_ROWS
    chosen = bands % SAMPLE_ONE_IN == min(SAMPLE_ONE_IN // 2, bands[-1] // 2)
    sample, share = Image.fromarray(np.asarray(picture)[chosen]), np.mean(chosen)
    found = b""
    for how in QUALITIES:
        if how != QUALITIES[-1] and len(_webp(sample, *how)) / share > most_bytes * (1 + DOUBT):
            continue
        found = _webp(picture, *how)
        if len(found) <= most_bytes:
            break
    return found


def few_colours(picture: Image.Image) -> Image.Image:
    """Return a picture in the colours of all maps."""
    with_colours = Image.new("P", (1, 1))
    with_colours.putpalette(palette().tobytes())
    return picture.quantize(palette=with_colours, dither=Image.Dither.NONE)


def _webp(picture: Image.Image, quality: int, size: float) -> bytes:
    beside = io.BytesIO()
    if quality == LOSSLESS:
        few_colours(picture).convert("RGB").save(beside, "WEBP", lossless=True, quality=20, method=1)
    else:
        less = picture if size == 1 else ImageOps.scale(picture, size, Image.Resampling.BOX)
        less.save(beside, "WEBP", quality=quality, method=2)
    return beside.getvalue()


def _terrain(look: Look, seen: Bools) -> Pixels:
    """Terrain in grey: darker where it was seen, pale where not, paper where nobody knows it."""
    shade = look.base.shade
    known = np.isfinite(shade)
    light = np.where(known, shade, np.float32(0.63))
    grey = np.where(seen, MUTED[0] + MUTED[1] * light, UNSEEN[0] + UNSEEN[1] * light)
    painted = np.repeat(np.minimum(grey, 255).astype(np.uint8)[..., None], 3, axis=-1)
    painted[~known & ~seen] = PAPER
    return painted


def _over(look: Look, seen: Bools, scale: Scale, values: np.ndarray) -> Pixels:
    painted = _terrain(look, np.zeros_like(seen))
    painted[seen] = scale.paint(values[seen])
    return painted


def _picture(
    painted: Pixels,
    look: Look,
    caption: Caption,
    scale: Scale,
    keys: tuple[tuple[str, tuple[int, ...]], ...],
    told: str,
    width_px: int,
) -> Image.Image:
    """Put a map on paper, with title, colour bar, scale and north."""
    unit = width_px / 1200
    margin, head, foot = round(24 * unit), round(92 * unit), round(104 * unit)
    inner = width_px - 2 * margin
    ny, nx = painted.shape[:2]
    stretch = min(inner / nx, TALLEST * inner / ny)
    size = max(1, round(nx * stretch)), max(1, round(ny * stretch))
    way = Image.Resampling.NEAREST if stretch >= 1 else Image.Resampling.BOX
    plan = Image.fromarray(painted).resize(size, way)
    picture = Image.new("RGB", (width_px, head + size[1] + foot), PAPER)
    corner = (width_px - size[0]) // 2, head
    picture.paste(plan, corner)
    draw = ImageDraw.Draw(picture)
    box = (*corner, corner[0] + size[0], corner[1] + size[1])
    draw.rectangle((box[0] - 1, box[1] - 1, box[2], box[3]), outline=(205, 207, 210))
    _head(draw, caption, told, width_px, margin, unit)
    _bar(draw, scale, (margin, box[3] + round(16 * unit)), round(inner * 0.56), unit)
    _keys(draw, keys, (margin + round(inner * 0.64), box[3] + round(22 * unit)), unit)
    _north_and_scale(picture, box, look.base.grid.cell_m * nx / size[0], unit)
    return picture


def _head(
    draw: ImageDraw.ImageDraw, caption: Caption, told: str, width: int, margin: int, unit: float
) -> None:
    large, small = font(30 * unit), font(21 * unit)
    right, base = width - margin, round(50 * unit)
    draw.text((right, base), caption.when, INK, large, anchor="rs")
    room = right - draw.textlength(caption.when, large) - 2 * margin - margin
    draw.text((margin, base), _fitted(draw, caption.station, large, room), INK, large, anchor="ls")
    second = round(80 * unit)
    draw.text((right, second), told, FAINT, small, anchor="rs")
    room = right - draw.textlength(told, small) - 3 * margin
    if caption.verdict:
        draw.text(
            (margin, second), _fitted(draw, caption.verdict, small, room), (158, 60, 0), small, anchor="ls"
        )


def _bar(draw: ImageDraw.ImageDraw, scale: Scale, corner: tuple[int, int], length: int, unit: float) -> None:
    left, top = corner
    height, small = round(18 * unit), font(19 * unit)
    pad = round(26 * unit)  # room for half a number at either end
    left, length = left + pad, length - 2 * pad
    bar = Image.fromarray(np.ascontiguousarray(scale.table()[None]))
    draw._image.paste(bar.resize((length, height)), (left, top))  # noqa: SLF001 - the picture drawn on
    draw.rectangle((left - 1, top - 1, left + length, top + height), outline=(150, 152, 156))
    for tick, share in zip(scale.ticks, scale.place(np.array(scale.ticks)), strict=True):
        x = left + round(float(share) * (length - 1))
        draw.line((x, top + height, x, top + height + round(5 * unit)), INK, max(1, round(1.5 * unit)))
        draw.text((x, top + height + round(8 * unit)), _number(tick, scale), INK, small, anchor="mt")
    draw.text((left, top + height + round(36 * unit)), scale.title, INK, small, anchor="lt")


def _keys(
    draw: ImageDraw.ImageDraw,
    keys: tuple[tuple[str, tuple[int, ...]], ...],
    corner: tuple[int, int],
    unit: float,
) -> None:
    left, top = corner
    side, small = round(18 * unit), font(19 * unit)
    for text, colour in keys:
        draw.rectangle((left, top, left + side, top + side), fill=colour, outline=(150, 152, 156))
        draw.text((left + round(1.5 * side), top + side // 2), text, INK, small, anchor="lm")
        top += round(30 * unit)


def _north_and_scale(
    picture: Image.Image, box: tuple[int, int, int, int], pixel_m: float, unit: float
) -> None:
    """Draw both on a plate in the lower left corner of the map."""
    left, _, right, bottom = box
    length_m = _length(pixel_m * (right - left) / 5)
    length, small, gap = round(length_m / pixel_m), font(19 * unit), round(12 * unit)
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    arrow = round(30 * unit)
    width, height = length + arrow + 3 * gap, round(52 * unit)
    plate = Image.new("RGBA", (width, height), (*PAPER, 215))
    corner = left + gap, bottom - gap - height
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
    draw.text((middle, y + round(5 * unit)), "N", INK, small, anchor="ms")


@lru_cache(maxsize=8)
def font(size: float) -> ImageFont.FreeTypeFont:
    """Return the one font there is, so high [pixels]."""
    return ImageFont.truetype(str(ASSETS / "dejavu.ttf"), max(7.0, size))


def _fitted(draw: ImageDraw.ImageDraw, text: str, by: ImageFont.FreeTypeFont, room: float) -> str:
    """Cut a line of text to the room there is."""
    text = " ".join(text.split())
    if draw.textlength(text, by) <= room:
        return text
    while text and draw.textlength(f"{text}…", by) > room:
        text = text[:-1]
    return f"{text}…"


def _number(tick: float, scale: Scale) -> str:
    sign = "−" if tick < 0 else "+" if tick > 0 and scale.low < 0 else ""
    return f"{sign}{abs(tick):.3g}"


def _metres(length_m: float) -> str:
    return f"{length_m:.3f} m" if length_m < 0.1 else f"{length_m:.2f} m"


def _length(wanted_m: float) -> float:
    """Return the largest of 1, 2, 5, 10 … that is not longer."""
    decade = 10.0 ** np.floor(np.log10(wanted_m))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= wanted_m * (1 + 1e-9)))
