"""Images on request: a map of an epoch or of a pair, the curve of an area, a film of a span."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.series.index import list_epochs, series_in
from station.config import Site
from station.errors import StationError
from station.products.area_tables import PREVIOUS, REFERENCE, AreaRecord, Span, find_epoch
from station.products.epoch_table import EpochTable, read_epoch_table
from station.products.gallery import default_limit
from station.products.maps import Caption, change_map, points_map, quantise, sigma_map
from station.products.overview import BaseMap, Overview, base_map, difference_overview, read_overview

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAP_VARIABLES = ("change", "sigma", "points")
MAX_FRAMES = 150  # of a film; of more epochs, every nth
FRAME_MS, LAST_FRAME_MS = 250, 2000
MAP_SUFFIXES, FILM_SUFFIXES, CURVE_SUFFIXES = (
    (".png", ".webp", ".jpg"),
    (".webp", ".gif"),
    (".png", ".svg", ".pdf"),
)


@dataclass(frozen=True)
class _PlotContext:
    """What all images of a call share."""

    series: Series
    table: EpochTable
    epochs: list[EpochRef]  # that have a reference
    name: str
    width_px: int
    limit_m: float

    @classmethod
    def load(cls, site: Site, width_px: int | None, limit_m: float | None) -> _PlotContext:
        series = series_in(site.station.data)
        table = read_epoch_table(series)
        versions = dict(zip(table.texts["epoch_file"], table.texts["reference_version"], strict=True))
        measured = [epoch for epoch in list_epochs(series) if versions.get(epoch.epoch_file)]
        if not measured:
            raise StationError("no epoch has a change yet: the reference is built from the first scans")
        limit_m = limit_m or site.products.change_limit_m
        limit_m = limit_m or default_limit(series, measured[0], versions[measured[0].epoch_file])
        name = site.station.name or site.station.id
        return cls(series, table, measured, name, width_px or site.products.quicklook_width_px, limit_m)

    def reference_version(self, epoch: EpochRef) -> str:
        return self.table.texts["reference_version"][self.table.texts["epoch_file"].index(epoch.epoch_file)]

    def base_map(self, epoch: EpochRef) -> BaseMap:
        return base_map(self.series, self.reference_version(epoch), self.width_px)

    def caption(self, epoch: EpochRef) -> Caption:
        return Caption(self.name, f"{epoch.start:%Y-%m-%d %H:%M} UTC")


def plot_map(
    site: Site,
    epoch_text: str,
    against: str,
    variable: str,
    out: Path,
    width_px: int | None,
    limit_m: float | None,
) -> Path:
    """Draw an epoch, or its change since another, into a file; return the file."""
    _check_suffix(out, MAP_SUFFIXES)
    context = _PlotContext.load(site, width_px, limit_m)
    epoch = find_epoch(context.series, epoch_text)
    if epoch not in context.epochs:
        raise StationError(f"{epoch_text}: has no change: it was measured before the reference was built")
    if against == REFERENCE:
        overview, since = (
            read_overview(epoch, context.base_map(epoch), points=variable == "points"),
            "the reference",
        )
    else:
        other = _second_epoch(context, epoch, against)
        overview = difference_overview(epoch, other, context.base_map(epoch), context.series)
        since = f"{other.start:%Y-%m-%d %H:%M} UTC"
    picture = _render(context, overview, epoch, variable, since)
    picture.save(out, quality=85)  # ignored for PNG
    return out


def plot_film(
    site: Site,
    span: Span,
    out: Path,
    width_px: int | None,
    limit_m: float | None,
    track: Callable[[list[EpochRef]], Iterable[EpochRef]] = iter,
) -> Path:
    """Draw the epochs of a span as a film; return its file."""
    _check_suffix(out, FILM_SUFFIXES)
    context = _PlotContext.load(site, width_px or 800, limit_m)
    chosen = [epoch for epoch in context.epochs if epoch.start in span]
    if not chosen:
        raise StationError("no epoch with a change lies between --from and --to")
    step = -(-len(chosen) // MAX_FRAMES)
    chosen = chosen[(len(chosen) - 1) % step :: step]
    base = context.base_map(chosen[-1])  # one extent and one hillshade for all
    frames = [
        _render(context, read_overview(epoch, base), epoch, "change", "the reference")
        for epoch in track(chosen)
    ]
    times = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS]
    if out.suffix == ".gif":
        frames = [quantise(frame) for frame in frames]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=70, method=2)
    return out


def plot_curve(records: Iterable[AreaRecord], area: str | None, title: str, out: Path) -> Path:
    """Draw the mean change of areas over time with their 95 % intervals; return the file.

    Raises StationError if matplotlib is not installed or there is no such area.
    """
    _check_suffix(out, CURVE_SUFFIXES)
    by_area: dict[str, list[AreaRecord]] = {}
    for record in records:
        by_area.setdefault(record.area, []).append(record)
    if area is not None and area not in by_area:
        raise StationError(f"no area {area!r} with a change; available: {', '.join(by_area) or 'none'}")
    chosen = {area: by_area[area]} if area is not None else by_area
    if not chosen:
        raise StationError("no epoch with a change in this span")
    try:
        from matplotlib.dates import AutoDateLocator, ConciseDateFormatter  # noqa: PLC0415 - an extra
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise StationError("curves need matplotlib: pip install 'tls-station[plot]'") from error
    figure = Figure(figsize=(9, 2.7 * len(chosen) + 0.7), layout="constrained")
    axes = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (name, area_records) in zip(axes, chosen.items(), strict=True):
        _curve(axis, name, area_records)
    locator = AutoDateLocator()
    axes[-1].xaxis.set_major_locator(locator)
    axes[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes[-1].set_xlabel("UTC")
    figure.align_ylabels(axes)
    figure.suptitle(title, parse_math=False)
    figure.savefig(out, dpi=150)
    return out


def _curve(axis: Axes, name: str, records: list[AreaRecord]) -> None:
    time = np.array([np.datetime64(record.start.replace(tzinfo=None)) for record in records])
    mean, low, high = (
        np.array([record.statistics[f"mean_change{suffix}"] for record in records])
        for suffix in ("", "_low", "_high")
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


def _second_epoch(context: _PlotContext, epoch: EpochRef, against: str) -> EpochRef:
    if against != PREVIOUS:
        other = find_epoch(context.series, against)
        if other not in context.epochs:
            raise StationError(f"{against}: has no change: it was measured before the reference was built")
        return other
    index = context.epochs.index(epoch)
    if index == 0:
        raise StationError("no earlier epoch with a change")
    return context.epochs[index - 1]


def _render(
    context: _PlotContext, overview: Overview, epoch: EpochRef, variable: str, since: str
) -> Image.Image:
    caption = context.caption(epoch)
    if variable == "sigma":
        return sigma_map(overview, caption, context.limit_m, context.width_px)
    if variable == "points":
        return points_map(overview, caption, context.width_px)
    return change_map(overview, caption, context.limit_m, context.width_px, since)


def _check_suffix(out: Path, suffixes: tuple[str, ...]) -> None:
    if out.suffix not in suffixes:
        raise StationError(f"{out}: the name must end in {', '.join(suffixes)}")


def curve_title(site: Site, against: str) -> str:
    """Return the title of the curves of areas: the station, and what the change is measured against."""
    since = f"the {against} one" if against == "previous" else against.replace("reference", "the reference")
    return f"{site.station.name or site.station.id}: mean change since {since}"
