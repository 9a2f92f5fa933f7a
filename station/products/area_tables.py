"""Change of areas: any polygons, any time span, against any epoch; as CSV and as text."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np

from station.archive.areas import area_statistics, matches
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.schema import VERDICTS
from station.archive.series.index import list_epochs, nearest_epoch, series_in
from station.config import Site
from station.errors import ConfigError, StationError
from station.products.epoch_table import (
    AreaSeries,
    EpochTable,
    csv_times,
    read_area_series,
    read_epoch_table,
)
from station.quantities import Bools
from station.queries.aggregates import Aggregates
from station.readers.polygons import cells_inside, read_polygons
from station.scan_names import scan_id

UNITS = {"mean_change": "m", "median_change": "m", "volume_change": "m3"}
COLUMN_SUFFIXES = {"": "", "_uncertainty": "_sigma", "_low": "_low95", "_high": "_high95"}
REFERENCE, PREVIOUS = "reference", "previous"


@dataclass(frozen=True)
class AreaRecord:
    """The change of one area in one scan; `statistics` by the variable names of `areas.nc`."""

    start: datetime
    end: datetime
    area: str
    size_m2: float
    verdict: str  # of the epoch; for a pair, the worse of the two
    statistics: dict[str, float]


@dataclass(frozen=True)
class Span:
    """A time span, both ends included."""

    first: datetime
    last: datetime

    @classmethod
    def parse(cls, first: str | None, last: str | None) -> Span:
        """Return the span between two times (UTC); a date without time covers the whole day."""
        return cls(
            parse_time(first) if first else datetime.min.replace(tzinfo=UTC),
            parse_time(last, end_of_day=True) if last else datetime.max.replace(tzinfo=UTC),
        )

    def __contains__(self, start: datetime) -> bool:
        return self.first <= start <= self.last


def parse_time(text: str, *, end_of_day: bool = False) -> datetime:
    """Return a time such as 2026-03-01 or 2026-03-01T06:00 (UTC unless it has a zone)."""
    try:
        if len(text) == len("2026-03-01") and end_of_day:
            day = date.fromisoformat(text)
            return datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(days=1, microseconds=-1)
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise StationError(f"{text}: is not a time; write 2026-03-01 or 2026-03-01T06:00 (UTC)") from error
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def find_epoch(series: Series, text: str) -> EpochRef:
    """Return the epoch of a scan name, or the nearest one within 12 h of a time (UTC).

    Raises StationError if there is none.
    """
    epochs = list_epochs(series)
    if not epochs:
        raise StationError(f"{series.folder}: nothing is stored yet")
    if text == "last":
        return epochs[-1]
    table = read_epoch_table(series)
    name = text if text in table.texts["scan_id"] else scan_id(text)
    if name in table.texts["scan_id"]:
        epoch_file = table.texts["epoch_file"][table.texts["scan_id"].index(name)]
        return next(epoch for epoch in epochs if epoch.epoch_file == epoch_file)
    try:
        time_s = parse_time(text).timestamp()
    except StationError as error:
        newest = table.texts["scan_id"][-1]
        raise StationError(f"{text}: neither a stored scan (the newest is {newest}) nor a time") from error
    return nearest_epoch(epochs, time_s)


def describe_epoch(site: Site, text: str) -> str:
    """Return which epoch a scan name or time stands for, '' for the reference and the previous epoch."""
    if text in {REFERENCE, PREVIOUS}:
        return ""
    return f"{text}: epoch of {find_epoch(series_in(site.station.data), text).start:%Y-%m-%d %H:%M:%S} UTC"


def area_records(
    site: Site,
    polygons: Path | None,
    span: Span,
    against: str,
    track: Callable[[list[EpochRef]], Iterable[EpochRef]] = iter,
) -> Iterator[AreaRecord]:
    """Yield the change of areas in each epoch of a span, against the reference, the previous or one epoch.

    The areas are those of a GeoJSON file or of the site. `track` iterates over the epochs to compute, as a
    progress bar does. Raises ConfigError if there are no areas, StationError if an epoch does not exist.
    """
    series, areas = series_in(site.station.data), area_cells(site, polygons)
    if (
        against == REFERENCE
        and matches(series.folder / "areas.nc", series, areas)
        and (stored := read_area_series(series))
    ):
        yield from _from_file(stored, span, read_epoch_table(series))
    else:
        yield from computed_records(series, areas, span, against, track)


def area_cells(site: Site, polygons: Path | None) -> dict[str, Bools]:
    """Return the cells (ny, nx) of the areas of a GeoJSON file, or of the site.

    Raises ConfigError if there are none.
    """
    file = polygons or (site.areas.file if site.areas else None)
    if file is None:
        raise ConfigError(
            "no areas: give a GeoJSON file of polygons, or name one as [areas] file in the site file"
        )
    grid = series_in(site.station.data).grid
    return {name: cells_inside(polygon, grid) for name, polygon in read_polygons(file, site.grid_crs).items()}


def _from_file(stored: list[AreaSeries], span: Span, table: EpochTable) -> Iterator[AreaRecord]:
    """Yield the records stored in `areas.nc`."""
    verdicts = dict(zip(table.start_s.tolist(), table.verdict, strict=True))
    for index, start_s in enumerate(stored[0].start_s):
        start, end = (
            datetime.fromtimestamp(float(time_s), UTC) for time_s in (start_s, stored[0].end_s[index])
        )
        if start not in span:
            continue
        for area in stored:
            statistics = {name: float(column[index]) for name, column in area.columns.items()}
            if np.isfinite(statistics["mean_change"]):
                verdict = verdicts.get(float(start_s), "")
                yield AreaRecord(start, end, area.name, area.size_m2, verdict, statistics)


def computed_records(
    series: Series,
    areas: dict[str, Bools],
    span: Span,
    against: str,
    track: Callable[[list[EpochRef]], Iterable[EpochRef]],
) -> Iterator[AreaRecord]:
    """Yield the change of areas, masks (ny, nx) by name, as `area_records` does, from the epochs.

    Raises StationError if `against` is no epoch.
    """
    table = read_epoch_table(series)
    versions = dict(zip(table.texts["epoch_file"], table.texts["reference_version"], strict=True))
    verdicts = dict(zip(table.texts["epoch_file"], table.verdict, strict=True))
    bounds_s = dict(zip(table.texts["epoch_file"], zip(table.start_s, table.end_s, strict=True), strict=True))
    measured = [epoch for epoch in list_epochs(series) if versions.get(epoch.epoch_file)]
    fixed_epoch = None if against in {REFERENCE, PREVIOUS} else find_epoch(series, against)
    previous = dict(zip(measured[1:], measured, strict=False)) if against == PREVIOUS else {}
    aggregates = Aggregates(series)
    for epoch in track([epoch for epoch in measured if epoch.start in span]):
        other = fixed_epoch or previous.get(epoch)
        if epoch == fixed_epoch or (against == PREVIOUS and other is None):
            continue
        verdict = max((verdicts[ref.epoch_file] for ref in (epoch, other) if ref), key=VERDICTS.index)
        start, end = (datetime.fromtimestamp(float(time_s), UTC) for time_s in bounds_s[epoch.epoch_file])
        for name, cells in areas.items():
            size_m2 = float(np.count_nonzero(cells)) * series.grid.cell_m**2
            if size_m2:
                statistics = area_statistics(aggregates.area(cells, epoch, other), size_m2)
                yield AreaRecord(start, end, name, size_m2, verdict, statistics)


def as_csv(records: Iterable[AreaRecord]) -> str:
    """Return a CSV table; a missing value is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    names = [f"{quantity}{suffix}" for quantity in UNITS for suffix in COLUMN_SUFFIXES]
    headings = [
        f"{quantity}{COLUMN_SUFFIXES[suffix]}_{UNITS[quantity]}"
        for quantity in UNITS
        for suffix in COLUMN_SUFFIXES
    ]
    writer.writerow(
        ["time_utc", "start_utc", "end_utc", "area", "area_size_m2", *headings, "coverage", "verdict"]
    )
    for record in records:
        values = [record.statistics[name] for name in (*names, "coverage")]
        texts = [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
        times = csv_times(record.start.timestamp(), record.end.timestamp()).values()
        writer.writerow([*times, record.area, f"{record.size_m2:g}", *texts, record.verdict])
    return stream.getvalue()


def as_text(records: Iterable[AreaRecord]) -> str:
    """Return a text table."""
    header = (
        "time, UTC",
        "area",
        "mean, m",
        "95 %",
        "median, m",
        "volume, m³",
        "95 %",
        "observed",
        "verdict",
    )
    body = [
        (
            f"{record.start:%Y-%m-%d %H:%M}",
            record.area,
            f"{statistics['mean_change']:+z.4f}",
            f"±{statistics['mean_change_high'] - statistics['mean_change']:.4f}",
            f"{statistics['median_change']:+z.4f}",
            f"{statistics['volume_change']:+z.1f}",
            f"±{statistics['volume_change_high'] - statistics['volume_change']:.1f}",
            f"{100 * statistics['coverage']:.0f} %",
            record.verdict,
        )
        for record in records
        for statistics in [record.statistics]
    ]
    if not body:
        return "no epoch with a change in this span"
    return text_table(header, body, left_aligned=(0, 1, len(header) - 1))


def text_table(header: Sequence[str], body: Sequence[Sequence[str]], left_aligned: Collection[int]) -> str:
    """Return rows of a header and a body as aligned text, without characters that a terminal acts on."""
    rows = [
        ["".join(character if character.isprintable() else "�" for character in cell) for cell in row]
        for row in (header, *body)
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column in left_aligned else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )
