"""Level and rate of cells at the end of each day and month: as products of the store, and of an area.

Days depend on those before them since the newest state of the filter that is kept, and on nothing else: live,
late and rebuilt stores contain the same bits. Source: equations.md, 6.12.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from station.archive.derived.level_files import (
    LEVEL_NAMES,
    LEVEL_VARIABLES,
    LevelPeriod,
    decoded,
    delete_other_files,
    delete_states,
    encoded,
    has_state,
    is_current,
    level_path,
    level_raster,
    read_state,
    write_levels,
    write_state,
)
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series, attributes
from station.archive.series.index import SeriesIndex, references_and_usable
from station.errors import StoreError
from station.quantities import Bools, Floats32
from station.queries.blocks import BlockQueries
from station.queries.epoch_cells import EpochReader, bounding_box
from station.queries.level_filter import DAY_S, LevelFilter

if TYPE_CHECKING:
    import xarray as xr

FORMAT = 4  # of the filter: another one computes all files again
RECENT_DAYS = 3  # whose states are kept, besides those of the last days of months
Progress = Callable[[], None]


@dataclass(frozen=True)
class LevelDay:
    """A day with usable epochs, and those epochs, which have one reference."""

    period: LevelPeriod
    epochs: list[EpochRef]
    is_first: bool  # of its reference


def level_days(series: Series) -> list[LevelDay]:
    """Return the days of a series that have usable epochs, the last one included, which may not be over.

    The epochs of a day are those of the reference of its last one, as in `daily.nc`.
    """
    index = SeriesIndex(series)
    if not len(index):
        return []
    versions, usable = references_and_usable(series)
    chosen = np.flatnonzero(usable & (versions != b"")).tolist()
    days: list[LevelDay] = []
    for number, positions in groupby(chosen, lambda position: index.start_s[position] // DAY_S):
        day = list(positions)
        version = versions[day[-1]]
        day = [position for position in day if versions[position] == version]
        before = days[-1].period if days else None
        is_first = before is None or before.version != version.decode()
        names = b"\n".join(index.epoch_file[day].tolist())
        key = b"" if before is None or is_first else before.key.encode()
        text = b"\n".join([str(FORMAT).encode(), key, version, names])
        first, last = index.start_s[day[0]], index.time_s[day[-1]]
        period = LevelPeriod(
            name=f"{datetime.fromtimestamp(number * DAY_S, UTC):%Y%m%d}",
            key=hashlib.sha256(text).hexdigest(),
            version=version.decode(),
            start_s=float(first),
            end_s=float(2 * last - index.start_s[day[-1]]),
            time_s=float(last),
            epoch_count=len(day),
        )
        days.append(LevelDay(period, [index[position] for position in day], is_first))
    return days


class _Passage:
    """A filter that goes through days in their order, and begins at the newest state that helps."""

    def __init__(self, series: Series, days: list[LevelDay], area: Bools | None, progress: Progress) -> None:
        self._series, self._days, self._area, self._progress = series, days, area, progress
        self._blocks, self._reader = BlockQueries(series), EpochReader(series)
        self._filter: LevelFilter | None = None
        self._next = 0  # day that the filter takes next

    def reach(
        self, number: int, on_day: Callable[[LevelDay, LevelFilter], None] | None = None
    ) -> LevelFilter:
        """Return the filter at the end of a day; `on_day` is called at the end of each day on the way."""
        first = self._start(number)
        for day in self._days[first : number + 1]:
            if day.is_first:
                self._filter = self._empty(day)
            assert self._filter is not None  # noqa: S101 - the first day of a reference made one
            self._filter.take_day(day.epochs, self._progress)
            if on_day is not None:
                on_day(day, self._filter)
        self._next = number + 1
        assert self._filter is not None  # noqa: S101
        return self._filter

    def _empty(self, day: LevelDay) -> LevelFilter:
        return LevelFilter(self._reader.reference(day.period.version), self._blocks, self._area)

    def _start(self, number: int) -> int:
        """Return the day to begin with, on the way to another one, and restore the state before it."""
        for first in range(number, -1, -1):
            if self._days[first].is_first or (first == self._next and self._filter is not None):
                return first
            before = self._days[first - 1].period
            arrays = read_state(self._series, before) if has_state(self._series, before) else None
            if arrays is not None:
                self._filter = self._empty(self._days[first])
                self._filter.restore(arrays)
                return first
        return 0


def update_levels(series: Series, progress: Progress) -> int:
    """Bring the files of levels up to date with the epochs; return the number of files written.

    A day is written when a later one has begun, a month likewise. A late or changed epoch changes the days
    after it, which are written again from the newest state before it. `progress` is called after each epoch
    read. Raises StoreError if an epoch is damaged or a file cannot be written.
    """
    days = level_days(series)
    closed = [day for day in days if day.period.name < days[-1].period.name]
    passage = _Passage(series, closed, None, progress)
    kept = _with_kept_state([day.period for day in closed])
    written = 0

    def keep_state(day: LevelDay, level_filter: LevelFilter) -> None:
        if day.period in kept and not has_state(series, day.period):
            write_state(series, day.period, level_filter.to_arrays())

    for number, day in enumerate(closed):
        if not is_current(series, day.period):
            _write_day(series, day.period, passage.reach(number, keep_state))
            written += 1
    months = _closed_months([day.period for day in days])
    for month, parts, before in months:
        if not is_current(series, month):
            _write_month(series, month, parts, before)
            written += 1
            progress()
    delete_other_files(series, [*(day.period for day in closed), *(month for month, _, _ in months)])
    delete_states(series, kept)
    return written


def _write_day(series: Series, period: LevelPeriod, level_filter: LevelFilter) -> None:
    write_levels(series, period, lambda rows: encoded(level_filter.rasters(rows)))


def _with_kept_state(periods: list[LevelPeriod]) -> list[LevelPeriod]:
    """Return the days whose states are kept: the newest, and the last of each month."""
    month_ends = [list(group)[-1] for _, group in groupby(periods, lambda period: period.name[:6])]
    return [period for period in periods if period in month_ends or period in periods[-RECENT_DAYS:]]


def _closed_months(
    periods: list[LevelPeriod],
) -> list[tuple[LevelPeriod, list[LevelPeriod], LevelPeriod | None]]:
    """Return the months that are over, the days of each that have its reference, and the day before them."""
    months = []
    newest = periods[-1].name[:6] if periods else ""
    for name, group in groupby(periods, lambda period: period.name[:6]):
        if name == newest:
            continue
        days = list(group)
        days = [day for day in days if day.version == days[-1].version]
        position = periods.index(days[0])
        before = periods[position - 1] if position else None
        if before is not None and before.version != days[-1].version:
            before = None
        keys = "\n".join([before.key if before else "", *(day.key for day in days)])
        month = replace(
            days[-1],
            name=name,
            key=hashlib.sha256(keys.encode()).hexdigest(),
            start_s=days[0].start_s,
            epoch_count=sum(day.epoch_count for day in days),
        )
        months.append((month, days, before))
    return months


def _write_month(
    series: Series, month: LevelPeriod, days: list[LevelPeriod], before: LevelPeriod | None
) -> None:
    """Write a month: the level at its end, and the mean rate since the end of the month before.

    Without one, the rate is that since its first day. Source: equations.md, 6.12.
    """
    start, end = before or days[0], days[-1]
    first, last = (
        {name: level_raster(level_path(series, day), name) for name in LEVEL_NAMES} for day in (start, end)
    )
    coverage = [level_raster(level_path(series, day), "coverage") for day in days]
    reference = EpochReader(series).reference(month.version)
    elapsed_d = (end.time_s - start.time_s) / DAY_S

    def get_rows(rows: slice) -> dict[str, Floats32]:
        begin, rasters = (
            {name: np.asarray(raster[rows]) for name, raster in source.items()} for source in (first, last)
        )
        reference_m2 = np.asarray(reference.random_variance_m2[rows])
        observed = sum(
            np.nan_to_num(np.asarray(part[rows])) * day.epoch_count
            for part, day in zip(coverage, days, strict=True)
        )
        if elapsed_d > 0:
            random, systematic = (f"level_{kind}_uncertainty" for kind in ("random", "systematic"))
            own_m2 = (np.maximum(part[random] ** 2 - reference_m2, 0) for part in (begin, rasters))
            rasters["rate"] = (rasters["level"] - begin["level"]) / elapsed_d
            rasters["rate_random_uncertainty"] = np.sqrt(sum(own_m2)) / elapsed_d
            rasters["rate_systematic_uncertainty"] = (
                np.hypot(begin[systematic], rasters[systematic]) / elapsed_d
            )
        never = np.isnan(rasters["level"])
        rasters["coverage"] = np.where(never, np.nan, observed / month.epoch_count)
        return encoded(rasters)

    write_levels(series, month, get_rows)


def filter_levels(series: Series, cells: Bools, progress: Progress, *, monthly: bool = False) -> xr.Dataset:
    """Return level and rate of the cells (ny, nx) of an area at the end of each day, or of each stored month.

    Stored days are read; others are filtered from the epochs, with the same result. `progress` is called
    after each epoch read. Raises StoreError if there is no usable epoch with a reference, or no stored month.
    """
    days = level_days(series)
    if not days:
        raise StoreError(f"{series.folder}: no usable epoch with a reference yet: no levels")
    window = bounding_box(cells, 0)
    if monthly:
        months = [month for month, _, _ in _closed_months([day.period for day in days])]
        months = [month for month in months if is_current(series, month)]
        if not months:
            raise StoreError(f"{series.folder}: no month of levels is stored: see products.levels")
        return _to_dataset(
            series, cells, months, (_read_window(level_path(series, month), window) for month in months)
        )
    passage = _Passage(series, days, cells, progress)

    def rasters_of_days() -> Iterator[dict[str, Floats32]]:
        for number, day in enumerate(days):
            if is_current(series, day.period):
                yield _read_window(level_path(series, day.period), window)
                continue
            rasters = encoded(passage.reach(number).rasters(window[0]))
            yield {name: decoded(values[:, window[1]]) for name, values in rasters.items()}

    return _to_dataset(series, cells, [day.period for day in days], rasters_of_days())


def _read_window(path: Path, window: tuple[slice, slice]) -> dict[str, Floats32]:
    return {name: np.asarray(level_raster(path, name)[window]) for name in LEVEL_NAMES}


def _to_dataset(
    series: Series, cells: Bools, periods: list[LevelPeriod], rasters: Iterator[dict[str, Floats32]]
) -> xr.Dataset:
    import xarray as xr  # noqa: PLC0415 - the service does not need it

    rows, columns = bounds = bounding_box(cells, 0)
    inside = cells[bounds]
    time = np.array([round(period.time_s * 1000) for period in periods], "M8[ms]").astype("M8[ns]")
    dataset = xr.Dataset(coords={"time": time, "y": series.grid.y_m[rows], "x": series.grid.x_m[columns]})
    stacked = {name: np.full((len(periods), *inside.shape), np.nan, np.float32) for name in LEVEL_NAMES}
    for number, values in enumerate(rasters):
        for name, raster in stacked.items():
            raster[number][inside] = values[name][inside]
    for spec in LEVEL_VARIABLES:
        kept = ("long_name", "units", "comment")
        attrs = {key: value for key, value in attributes(spec, series).items() if key in kept}
        dataset[spec.name] = ("time", "y", "x"), stacked[spec.name], attrs
    return dataset
