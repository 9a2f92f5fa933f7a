"""Tables of events: as CSV and as text."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime

from station.archive.derived.event_table import EVENT_COLUMNS, Event, read_events
from station.archive.series.index import series_in
from station.config import Site
from station.products.area_tables import Span, text_table
from station.science.geometry.robust_statistics import NORMAL_95


def select_events(site: Site, span: Span, kind: str | None = None) -> list[Event]:
    """Return the events of a station that began in a span, of one kind or all, the oldest first.

    Raises StoreError if there is no series, or the table is damaged.
    """
    return [
        event
        for event in read_events(series_in(site.station.data).folder)
        if kind in {None, event.kind} and datetime.fromisoformat(event.begin) in span
    ]


def as_csv(events: Iterable[Event]) -> str:
    """Return a CSV table with one sigma of each volume; a missing value is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(EVENT_COLUMNS)
    writer.writerows(["" if value is None else value for value in asdict(event).values()] for event in events)
    return stream.getvalue()


def as_text(events: Iterable[Event]) -> str:
    """Return a text table with 95 % intervals."""
    header = (
        "begin, UTC", "end, UTC", "kind", "state", "east, m", "north, m", "area, m²", "depth, m",
        "volume, m³", "95 %", "balance, m³",
    )  # fmt: skip
    body = [
        (
            _minute(event.begin),
            _minute(event.end),
            event.kind.replace("_", " "),
            event.state,
            f"{event.east_m:.0f}",
            f"{event.north_m:.0f}",
            f"{event.area_m2:.0f}",
            f"{event.mean_depth_m:+z.2f}",
            f"{event.volume_m3:+z.0f}",
            f"±{NORMAL_95 * event.volume_sigma_m3:.0f}",
            _balance(event),
        )
        for event in events
    ]  # fmt: skip
    return text_table(header, body, left_aligned=(0, 1, 2, 3)) if body else "no events"


def _balance(event: Event) -> str:
    if event.balance_m3 is None or event.balance_sigma_m3 is None:
        return ""
    return f"{event.balance_m3:+z.0f} ±{NORMAL_95 * event.balance_sigma_m3:.0f}"


def _minute(time: str) -> str:
    return time[:16].replace("T", " ")
