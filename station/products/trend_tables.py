"""Rates of areas over a span or its days and months: as CSV and as text."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import astuple, dataclass
from datetime import datetime
from itertools import groupby
from pathlib import Path

import numpy as np

from station.archive.epochs import EpochRef
from station.archive.series.index import list_epochs, series_in
from station.config import Site
from station.errors import StationError
from station.products.area_tables import REFERENCE, AreaRecord, Span, area_cells, area_records, text_table
from station.products.exports.selection import PERIODS
from station.queries.aggregates import Aggregates
from station.queries.common_errors import common_error_share
from station.science.geometry.robust_statistics import NORMAL_95
from station.science.time_series.trend import MIN_EPOCHS, Trend, fit_trend

SIGNIFICANT = NORMAL_95  # an acceleration, or a rate whose inverse is given, is at least so many sigma


@dataclass(frozen=True)
class TrendRecord:
    """The trend of the mean change of an area [m/d, m/d²] between the middles of its first and last scan."""

    area: str
    first: datetime
    last: datetime
    epochs: int
    trend: Trend

    @property
    def inverse_velocity_d_m(self) -> tuple[float, float]:
        """Inverse of the speed and its sigma [d/m]; NaN unless the rate is significant.

        Before a slope fails it falls in a straight line to zero (Fukuzono, 1985).
        """
        speed_m_d, sigma_m_d = abs(self.trend.rate_m_d), self.trend.rate_sigma_m_d
        if speed_m_d <= SIGNIFICANT * sigma_m_d:
            return np.nan, np.nan
        return 1 / speed_m_d, sigma_m_d / speed_m_d**2


def trend_records(
    site: Site,
    polygons: Path | None,
    span: Span,
    area: str | None = None,
    period: str | None = None,
    track: Callable[[list[EpochRef]], Iterable[EpochRef]] = iter,
) -> Iterator[TrendRecord]:
    """Yield the trend of areas over a span, or over each day or month (UTC) of it.

    Unusable epochs are left out, and periods with fewer than `MIN_EPOCHS`. Raises StationError if there is no
    such area, or no period with enough epochs.
    """
    series, cells = series_in(site.station.data), area_cells(site, polygons)
    records: dict[str, list[AreaRecord]] = {name: [] for name in cells}
    if area is not None and area not in cells:
        raise StationError(f"no area {area!r}; areas: {', '.join(cells)}")
    for record in area_records(site, polygons, span, REFERENCE, track):
        if record.verdict != "unusable" and np.isfinite(record.statistics["mean_change_uncertainty"]):
            records[record.area].append(record)
    aggregates = Aggregates(series)
    by_start = {round(epoch.start.timestamp()): epoch for epoch in list_epochs(series)}
    found = False
    for name in cells if area is None else [area]:
        observed = sorted(records[name], key=lambda record: record.start)
        if len(observed) < MIN_EPOCHS:
            continue
        epochs = [by_start[round(record.start.timestamp())] for record in observed]
        common_share = common_error_share(aggregates, cells[name], epochs)
        for _, group in groupby(
            observed, lambda record: f"{record.start:{PERIODS[period]}}" if period else ""
        ):
            members = list(group)
            if len(members) >= MIN_EPOCHS:
                found = True
                yield _trend_record(name, members, common_share)
    if not found:
        raise StationError(f"a rate needs {MIN_EPOCHS} usable epochs: there are fewer in this span")


def _by_period(records: list[AreaRecord], period_format: str) -> Iterator[list[AreaRecord]]:
    """Yield the records of each period, which a time format tells apart."""
    for _, members in groupby(records, lambda record: record.start.strftime(period_format)):
        yield list(members)


def _trend_record(name: str, records: list[AreaRecord], common_share: float) -> TrendRecord:
    middles = [record.start + (record.end - record.start) / 2 for record in records]
    time_s = np.array([middle.timestamp() for middle in middles])
    change_m, sigma_m = (
        np.array([record.statistics[variable] for record in records])
        for variable in ("mean_change", "mean_change_uncertainty")
    )
    trend = fit_trend(time_s, change_m, sigma_m, common_share)
    return TrendRecord(name, middles[0], middles[-1], len(records), trend)


def as_csv(records: Iterable[TrendRecord]) -> str:
    """Return a CSV table with one sigma of each value; a missing value is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(
        ["area", "first_utc", "last_utc", "epochs", "rate_m_d", "rate_sigma_m_d", "acceleration_m_d2",
         "acceleration_sigma_m_d2", "inverse_velocity_d_m", "inverse_velocity_sigma_d_m"]
    )  # fmt: skip
    for record in records:
        values = (*astuple(record.trend), *record.inverse_velocity_d_m)
        texts = [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
        times = [f"{time:%Y-%m-%dT%H:%M:%SZ}" for time in (record.first, record.last)]
        writer.writerow([record.area, *times, record.epochs, *texts])
    return stream.getvalue()


def as_text(records: Iterable[TrendRecord]) -> str:
    """Return a text table with 95 % intervals."""
    header = ("area", "from, UTC", "to, UTC", "epochs", "rate, m/d", "95 %", "acceleration, m/d²", "95 %", "")
    body = []
    for record in records:
        trend, accelerates = record.trend, ""
        has_acceleration = np.isfinite(trend.acceleration_m_d2)
        moves = abs(trend.rate_m_d) > SIGNIFICANT * trend.rate_sigma_m_d
        if moves and abs(trend.acceleration_m_d2) > SIGNIFICANT * trend.acceleration_sigma_m_d2:
            accelerates = "speeds up" if trend.acceleration_m_d2 * trend.rate_m_d > 0 else "slows down"
        body.append(
            (
                record.area,
                f"{record.first:%Y-%m-%d %H:%M}",
                f"{record.last:%Y-%m-%d %H:%M}",
                str(record.epochs),
                f"{trend.rate_m_d:+z.4f}",
                f"±{NORMAL_95 * trend.rate_sigma_m_d:.4f}",
                f"{trend.acceleration_m_d2:+z.4f}" if has_acceleration else "",
                f"±{NORMAL_95 * trend.acceleration_sigma_m_d2:.4f}" if has_acceleration else "",
                accelerates,
            )
        )
    return text_table(header, body, left_aligned=(0, 1, 2, len(header) - 1))
