"""How areas changed, asked for any polygons, any span and against any epoch; as CSV and as lines."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np

from station.archive.aggregate import Aggregates
from station.archive.areas import figures, is_of
from station.archive.layout import Series
from station.archive.store import Row, rows, series_in
from station.archive.variables import VERDICTS
from station.config import Site
from station.errors import ConfigError, StationError
from station.products.record import AreaRecord, Record, read_areas, read_record
from station.quantities import Bools
from station.readers.polygons import mask, read_polygons

UNITS = {"mean_change": "m", "median_change": "m", "volume_change": "m3"}
ENDS = {"": "", "_uncertainty": "_sigma", "_low": "_low95", "_high": "_high95"}
REFERENCE, PREVIOUS = "reference", "previous"


@dataclass(frozen=True)
class AreaLine:
    """One area at one time; `figures` by the names of `areas.nc`."""

    start: datetime
    area: str
    size_m2: float
    verdict: str  # of the epoch; of a pair the worse
    figures: dict[str, float]


@dataclass(frozen=True)
class Span:
    """Epochs from one moment to another."""

    first: datetime
    last: datetime

    @classmethod
    def of(cls, first: str | None, last: str | None) -> Span:
        """Read two moments (UTC); a day without time is meant from its begin to its end."""
        return cls(
            moment(first) if first else datetime.min.replace(tzinfo=UTC),
            moment(last, ends=True) if last else datetime.max.replace(tzinfo=UTC),
        )

    def __contains__(self, start: datetime) -> bool:
        return self.first <= start <= self.last


def moment(text: str, *, ends: bool = False) -> datetime:
    """Read a time like 2026-03-01 or 2026-03-01T06:00 (UTC unless it says otherwise)."""
    try:
        if len(text) == len("2026-03-01") and ends:
            day = date.fromisoformat(text)
            return datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(days=1, microseconds=-1)
        told = datetime.fromisoformat(text)
    except ValueError as error:
        raise StationError(f"{text}: is no time; write 2026-03-01 or 2026-03-01T06:00 (UTC)") from error
    return told.replace(tzinfo=UTC) if told.tzinfo is None else told.astimezone(UTC)


def epoch(series: Series, told: str) -> Row:
    """Find the epoch of a scan's name, or nearest to a time (UTC); raise StationError where there is none."""
    found = rows(series)
    if not found:
        raise StationError(f"{series.folder}: nothing is stored yet")
    if told == "last":
        return found[-1]
    record = read_record(series)
    name = told.removesuffix(".laz").removesuffix(".las")
    if name in record.words["scan_id"]:
        file = record.words["epoch_file"][record.words["scan_id"].index(name)]
        return next(row for row in found if row.epoch_file == file)
    try:
        wanted_s = moment(told).timestamp()
    except StationError as error:
        newest = record.words["scan_id"][-1]
        raise StationError(f"{told}: neither a stored scan (the newest is {newest}) nor a time") from error
    return min(found, key=lambda row: abs(row.start.timestamp() - wanted_s))


def area_lines(
    site: Site,
    polygons: Path | None,
    span: Span,
    against: str,
    each: Callable[[list[Row]], Iterable[Row]] = iter,
) -> Iterator[AreaLine]:
    """Tell how areas changed in each epoch of a span, against the reference, the previous or one epoch.

    The areas are those of a GeoJSON file or of the site. `each` goes through the epochs that are computed,
    as a progress bar does. Raises ConfigError where there are no areas, StationError where an epoch is not
    found.
    """
    series = series_in(site.station.data)
    file = polygons or (site.areas.file if site.areas else None)
    if file is None:
        raise ConfigError("no areas: name a GeoJSON of polygons, or give [areas] file in the site file")
    areas = {name: mask(one, series.grid) for name, one in read_polygons(file, site.map.crs).items()}
    if (
        against == REFERENCE
        and is_of(series.folder / "areas.nc", series, areas)
        and (kept := read_areas(series))
    ):
        yield from _kept(kept, span, read_record(series))
    else:
        yield from _computed(series, areas, span, against, each)


def _kept(kept: list[AreaRecord], span: Span, record: Record) -> Iterator[AreaLine]:
    """What `areas.nc` holds."""
    verdicts = dict(zip(record.start_s.tolist(), record.verdict, strict=True))
    for index, start_s in enumerate(kept[0].start_s):
        start = datetime.fromtimestamp(float(start_s), UTC)
        if start not in span:
            continue
        for area in kept:
            told = {name: float(column[index]) for name, column in area.columns.items()}
            if np.isfinite(told["mean_change"]):
                verdict = verdicts.get(float(start_s), "")
                yield AreaLine(start, area.name, area.size_m2, verdict, told)


def _computed(
    series: Series,
    areas: dict[str, Bools],
    span: Span,
    against: str,
    each: Callable[[list[Row]], Iterable[Row]],
) -> Iterator[AreaLine]:
    record = read_record(series)
    versions = dict(zip(record.words["epoch_file"], record.words["reference_version"], strict=True))
    verdicts = dict(zip(record.words["epoch_file"], record.verdict, strict=True))
    measured = [row for row in rows(series) if versions.get(row.epoch_file)]
    fixed = None if against in {REFERENCE, PREVIOUS} else epoch(series, against)
    before = dict(zip(measured[1:], measured, strict=False)) if against == PREVIOUS else {}
    aggregates = Aggregates(series)
    for row in each([row for row in measured if row.start in span]):
        other = fixed or before.get(row)
        if row == fixed or (against == PREVIOUS and other is None):
            continue
        verdict = max((verdicts[one.epoch_file] for one in (row, other) if one), key=VERDICTS.index)
        for name, cells in areas.items():
            size_m2 = float(np.count_nonzero(cells)) * series.grid.cell_m**2
            if size_m2:
                found = figures(aggregates.area(cells, row, other), size_m2)
                yield AreaLine(row.start, name, size_m2, verdict, found)


def as_csv(lines: Iterable[AreaLine]) -> str:
    """Return a table for other programs; empty where there is no value."""
    told = io.StringIO()
    writer = csv.writer(told, lineterminator="\n")
    names = [f"{quantity}{end}" for quantity in UNITS for end in ENDS]
    heads = [f"{quantity}{ENDS[end]}_{UNITS[quantity]}" for quantity in UNITS for end in ENDS]
    writer.writerow(["time_utc", "area", "area_size_m2", *heads, "coverage", "verdict"])
    for line in lines:
        values = [line.figures[name] for name in (*names, "coverage")]
        shown = [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
        writer.writerow(
            [f"{line.start:%Y-%m-%dT%H:%M:%SZ}", line.area, f"{line.size_m2:g}", *shown, line.verdict]
        )
    return told.getvalue()


def as_text(lines: Iterable[AreaLine]) -> str:
    """Return a table for a person."""
    head = ("time, UTC", "area", "mean, m", "95 %", "median, m", "volume, m³", "95 %", "seen", "verdict")
    body = [
        (
            f"{line.start:%Y-%m-%d %H:%M}",
            line.area,
            f"{told['mean_change']:+.4f}",
            f"±{told['mean_change_high'] - told['mean_change']:.4f}",
            f"{told['median_change']:+.4f}",
            f"{told['volume_change']:+.1f}",
            f"±{told['volume_change_high'] - told['volume_change']:.1f}",
            f"{100 * told['coverage']:.0f} %",
            line.verdict,
        )
        for line in lines
        for told in [line.figures]
    ]
    if not body:
        return "no epoch has a change there"
    wide = [max(len(row[column]) for row in (head, *body)) for column in range(len(head))]
    left = (0, 1, len(head) - 1)
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column in left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, wide, strict=True))
        ).rstrip()
        for row in (head, *body)
    )
