"""Pictures asked for: a map of an epoch or of a pair, the curve of an area, a film of a span."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from station.archive.layout import Series
from station.archive.store import Row, rows, series_in
from station.config import Site
from station.errors import StationError
from station.products.areas import PREVIOUS, REFERENCE, AreaLine, Span, epoch
from station.products.gallery import default_limit
from station.products.look import Base, Look, base_of, look_at, look_between
from station.products.maps import Caption, change_map, few_colours, points_map, sigma_map
from station.products.record import Record, read_record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHOWN = ("change", "sigma", "points")
MOST_FRAMES = 150  # of a film; of more epochs every nth
FRAME_MS, LAST_FRAME_MS = 250, 2000
STILL, MOVING, CURVE = (".png", ".webp", ".jpg"), (".webp", ".gif"), (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class _Album:
    """What all pictures of one call share."""

    series: Series
    record: Record
    rows: list[Row]  # that have a reference
    name: str
    width_px: int
    limit_m: float

    @classmethod
    def of(cls, site: Site, width_px: int | None, limit_m: float | None) -> _Album:
        series = series_in(site.station.data)
        record = read_record(series)
        versions = dict(zip(record.words["epoch_file"], record.words["reference_version"], strict=True))
        measured = [row for row in rows(series) if versions.get(row.epoch_file)]
        if not measured:
            raise StationError("no epoch has a change yet: the reference is made from the first scans")
        limit_m = limit_m or site.products.change_limit_m
        limit_m = limit_m or default_limit(series, measured[0], versions[measured[0].epoch_file])
        name = site.station.name or site.station.id
        return cls(series, record, measured, name, width_px or site.products.quicklook_width_px, limit_m)

    def version(self, row: Row) -> str:
        return self.record.words["reference_version"][self.record.words["epoch_file"].index(row.epoch_file)]

    def base(self, row: Row) -> Base:
        return base_of(self.series, self.version(row), self.width_px)

    def caption(self, row: Row) -> Caption:
        return Caption(self.name, f"{row.start:%Y-%m-%d %H:%M} UTC")


def plot_map(
    site: Site, told: str, against: str, shown: str, out: Path, width_px: int | None, limit_m: float | None
) -> Path:
    """Draw an epoch, or its change from another, into a file; return that."""
    _fits(out, STILL)
    album = _Album.of(site, width_px, limit_m)
    row = epoch(album.series, told)
    if row not in album.rows:
        raise StationError(f"{told}: has no change: it was measured before there was a reference")
    if against == REFERENCE:
        look, since = look_at(row, album.base(row), points=shown == "points"), "the reference"
    else:
        other = _other(album, row, against)
        look = look_between(row, other, album.base(row), album.series)
        since = f"{other.start:%Y-%m-%d %H:%M} UTC"
    picture = _drawn(album, look, row, shown, since)
    picture.save(out, quality=85)  # of which PNG knows nothing
    return out


def plot_film(
    site: Site,
    span: Span,
    out: Path,
    width_px: int | None,
    limit_m: float | None,
    each: Callable[[list[Row]], Iterable[Row]] = iter,
) -> Path:
    """Draw the epochs of a span one after the other into a film; return its file."""
    _fits(out, MOVING)
    album = _Album.of(site, width_px or 800, limit_m)
    chosen = [row for row in album.rows if row.start in span]
    if not chosen:
        raise StationError("no epoch with a change lies between --from and --to")
    step = -(-len(chosen) // MOST_FRAMES)
    chosen = chosen[(len(chosen) - 1) % step :: step]
    base = album.base(chosen[-1])  # one window and one terrain for all
    frames = [_drawn(album, look_at(row, base), row, "change", "the reference") for row in each(chosen)]
    times = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS]
    if out.suffix == ".gif":
        frames = [few_colours(frame) for frame in frames]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=70, method=2)
    return out


def plot_curve(lines: Iterable[AreaLine], area: str | None, title: str, out: Path) -> Path:
    """Draw the mean change of areas over time with their 95 % intervals; return the file.

    Raises StationError where matplotlib is not installed or no such area is there.
    """
    _fits(out, CURVE)
    by_area: dict[str, list[AreaLine]] = {}
    for line in lines:
        by_area.setdefault(line.area, []).append(line)
    if area is not None and area not in by_area:
        raise StationError(f"no area {area!r} with a change; there are: {', '.join(by_area) or 'none'}")
    chosen = {area: by_area[area]} if area is not None else by_area
    if not chosen:
        raise StationError("no epoch has a change there")
    try:
        from matplotlib.dates import AutoDateLocator, ConciseDateFormatter  # noqa: PLC0415 - an extra
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise StationError("curves need matplotlib: pip install 'tls-station[plot]'") from error
    figure = Figure(figsize=(9, 2.7 * len(chosen) + 0.7), layout="constrained")
    axes = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (name, of_area) in zip(axes, chosen.items(), strict=True):
        _curve(axis, name, of_area)
    locator = AutoDateLocator()
    axes[-1].xaxis.set_major_locator(locator)
    axes[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes[-1].set_xlabel("UTC")
    figure.align_ylabels(axes)
    figure.suptitle(title, parse_math=False)
    figure.savefig(out, dpi=150)
    return out


def _curve(axis: Axes, name: str, lines: list[AreaLine]) -> None:
    time = np.array([np.datetime64(line.start.replace(tzinfo=None)) for line in lines])
    mean, low, high = (
        np.array([line.figures[f"mean_change{end}"] for line in lines]) for end in ("", "_low", "_high")
    )
    axis.fill_between(time, low, high, color="#0b5c8a", alpha=0.25, linewidth=0, label="95 %")
    axis.plot(
        time, mean, color="#0b5c8a", linewidth=1.4, marker="o" if len(time) < 60 else None, markersize=3
    )
    axis.axhline(0, color="#999999", linewidth=0.8)
    axis.set_title(name, loc="left", fontsize=10, parse_math=False)
    axis.set_ylabel("mean change, m")
    axis.grid(visible=True, color="#e3e3e3", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(loc="best", frameon=False, fontsize=8)


def _other(album: _Album, row: Row, against: str) -> Row:
    if against != PREVIOUS:
        other = epoch(album.series, against)
        if other not in album.rows:
            raise StationError(f"{against}: has no change: it was measured before there was a reference")
        return other
    at = album.rows.index(row)
    if at == 0:
        raise StationError("no epoch with a change lies before it")
    return album.rows[at - 1]


def _drawn(album: _Album, look: Look, row: Row, shown: str, since: str) -> Image.Image:
    caption = album.caption(row)
    if shown == "sigma":
        return sigma_map(look, caption, album.limit_m, album.width_px)
    if shown == "points":
        return points_map(look, caption, album.width_px)
    return change_map(look, caption, album.limit_m, album.width_px, since)


def _fits(out: Path, suffixes: tuple[str, ...]) -> None:
    if out.suffix not in suffixes:
        raise StationError(f"{out}: the name must end in {', '.join(suffixes)}")
