"""Daily summary of the station in at most 10 kB of plain text, for slow and expensive links."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from statistics import median

import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.derived.product_files import read_products
from station.config import Site
from station.inbox.journal_reader import Entry, JournalReader, State
from station.monitoring.alarm_rules import DAY_S
from station.monitoring.alarm_state import active
from station.monitoring.area_curves import AreaCurve, read_curves
from station.processing.workers.worker_process import Progress
from station.products.site_products.product_tables import newest_rows, value_and_interval
from station.products.web.page_text import PageText
from station.science.gridding.significance import SIGNIFICANT_SIGMAS

MAX_BYTES = 10_000
MAX_REASONS = 10  # per kind; equal reasons are counted, not repeated
MAX_REASON_CHARS = 160  # per reason


def write_digest(site: Site, day: date, progress: Progress) -> bool:
    """Write `digest/<day>.txt`; return False if it already exists. Raises StoreError."""
    path = site.station.data / "digest" / f"{day:%Y-%m-%d}.txt"
    if path.exists():
        return False
    progress()
    text = format_digest(site, day)
    with atomic_write(path) as tmp_path:
        tmp_path.write_text(text, encoding="utf-8")
    return True


def newest_digest(data: Path) -> Path | None:
    """Return the newest digest file; None without one."""
    return max((data / "digest").glob("????-??-??.txt"), default=None)


def format_digest(site: Site, day: date) -> str:
    """Return the digest of a day (UTC): scans, state of the station, changes of the areas, products.

    At most 10 kB in UTF-8: the most important comes first, the rest is cut. Raises StoreError.
    """
    begin_s = datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()
    data = site.station.data
    with JournalReader(data / "journal.sqlite") as journal:
        entries = [
            entry for entry in journal.changed_since(begin_s) if entry.first_seen_utc_s < begin_s + DAY_S
        ]
        arrived = [entry for entry in entries if entry.first_seen_utc_s >= begin_s]
        counts = journal.counts()
    waiting = counts[State.WAITING] + counts[State.LATER]
    lines = [
        f"{site.station.name or site.station.id} ({site.station.id}), {day:%Y-%m-%d} UTC",
        *_arrivals(arrived),
        *_station_state(site, arrived),
        f"all: {counts['stored']} stored, {counts['set_aside']} set aside, {waiting} waiting",
        "",
        *_area_changes(read_curves(site, begin_s - 7 * DAY_S), begin_s),
        *_product_values(site, begin_s + DAY_S),
    ]
    return _truncate(lines)


def yesterday(now_s: float) -> date:
    """Return the last complete day (UTC)."""
    return (datetime.fromtimestamp(now_s, UTC) - timedelta(days=1)).date()


def _arrivals(arrived: list[Entry]) -> Iterator[str]:
    stored = [entry for entry in arrived if entry.state is State.STORED]
    verdicts = Counter(entry.verdict for entry in stored)
    set_aside = [entry for entry in arrived if entry.state is State.SET_ASIDE]
    kinds = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
    waiting = len(arrived) - len(stored) - len(set_aside)
    yield f"arrived {len(arrived)}: {kinds or 'none stored'}, {len(set_aside)} set aside, {waiting} waiting"
    for kind, entries in (
        ("not good", [entry for entry in stored if entry.verdict != "good"]),
        ("set aside", set_aside),
    ):
        reasons = Counter(entry.reason[:MAX_REASON_CHARS] for entry in entries).most_common()
        yield from (f"{kind} {count}x: {reason}" for reason, count in reasons[:MAX_REASONS])
        if len(reasons) > MAX_REASONS:
            yield f"{kind}: {len(reasons) - MAX_REASONS} more reasons"


def _station_state(site: Site, arrived: list[Entry]) -> Iterator[str]:
    for name, template in (
        ("sigma_median_m", "sigma {:.3g} m"),
        ("stable_z_std", "stable ground scatters by {:.2f} sigma"),
        ("roll_deg", "roll {:.3f} deg"),
        ("pitch_deg", "pitch {:.3f} deg"),
        ("seconds", "{:.0f} s per scan"),
    ):
        values = [float(entry.metrics[name]) for entry in arrived if entry.metrics.get(name) is not None]
        if values:
            yield f"{template.format(median(values))} (median; {min(values):.4g} to {max(values):.4g})"
    yield f"disk {shutil.disk_usage(site.station.data).free / 1e9:.1f} GB free"
    yield from (f"alarm: {text[:MAX_REASON_CHARS]}" for text in active(site.station.data).values())


def _area_changes(curves: list[AreaCurve], begin_s: float) -> Iterator[str]:
    """Yield the change of each area over the day and against the reference [m], with 95 % intervals.

    Errors of the two epochs count as independent.
    """
    if curves:
        yield "area: change over the day, change against the reference [m], each with its 95 % interval"
    for curve in curves:
        end = int(np.searchsorted(curve.time_s, begin_s + DAY_S)) - 1
        start = int(np.searchsorted(curve.time_s, begin_s)) - 1
        if end < 0 or curve.time_s[end] < begin_s:
            yield f"{curve.name}: not observed"
            continue
        since_reference = f"{curve.change_m[end]:+z.3f} ± {SIGNIFICANT_SIGMAS * curve.sigma_m[end]:.3f}"
        start = max(start, 0)
        day_change_m = curve.change_m[end] - curve.change_m[start]
        sigma_m = np.hypot(curve.sigma_m[end], curve.sigma_m[start])
        yield f"{curve.name}: {day_change_m:+z.3f} ± {SIGNIFICANT_SIGMAS * sigma_m:.3f}, {since_reference}"


def _product_values(site: Site, end_s: float) -> Iterator[str]:
    """Yield the newest value of each product at the end of the day, with its 95 % interval.

    Quantities have the names that they have on the page in English.
    """
    words = PageText.of("en", on_map=site.grid_cells.plane.is_map).page
    products = [product.until(end_s) for product in read_products(site.station.data)]
    for row in newest_rows(products):
        value, half = value_and_interval(row["value"], row["sigma"], row["unit"])
        when = f"{datetime.fromtimestamp(row['start_s'], UTC):%Y-%m-%d %H:%M}"
        quantity = words[f"quantity_{row['quantity']}"]
        yield f"{row['product']}, {row['place']}: {quantity} {value} {half} {row['unit']} at {when}"


def _truncate(lines: list[str]) -> str:
    """Join as many lines as fit into the limit."""
    text, limit = "", MAX_BYTES - 40
    for index, line in enumerate(lines):
        if len((text + line).encode()) + 1 > limit:
            return f"{text}... and {len(lines) - index} more lines\n"
        text += f"{line}\n"
    return text
