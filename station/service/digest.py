"""A day of the station in at most 10 kB of plain text, for a link that is slow and dear."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from statistics import median

import numpy as np

from station.archive.layout import written_whole
from station.config import Site
from station.service.alarm_memory import firing
from station.service.alarm_rules import DAY_S, TOLD_SIGMAS
from station.service.area_series import Curve, read_curves
from station.service.journal import Entry, Journal, State
from station.service.tasks import Progress

MOST_BYTES = 10_000
MOST_REASONS = 10  # of one kind; the same words are counted, not repeated
MOST_LETTERS = 160  # of one reason


def write_digest(site: Site, day: date, progress: Progress) -> bool:
    """Write `digest/<day>.txt` unless it is there; tell whether it was. Raises StoreError."""
    path = site.station.data / "digest" / f"{day:%Y-%m-%d}.txt"
    if path.exists():
        return False
    progress()
    text = digest(site, day)
    with written_whole(path) as beside:
        beside.write_text(text, encoding="utf-8")
    return True


def newest_digest(data: Path) -> Path | None:
    """Return the newest digest there is."""
    return max((data / "digest").glob("????-??-??.txt"), default=None)


def digest(site: Site, day: date) -> str:
    """Say what arrived on a day (UTC), what became of it, how areas changed, how the station is.

    At most 10 kB in UTF-8: what is most important comes first, the rest is cut. Raises StoreError.
    """
    begin_s = datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()
    data = site.station.data
    with Journal(data / "journal.sqlite", read_only=True) as journal:
        rows = [row for row in journal.changed_since(begin_s) if row.seen_utc_s < begin_s + DAY_S]
        arrived = [row for row in rows if row.seen_utc_s >= begin_s]
        counts = journal.counts()
    waits = counts[State.WAITING] + counts[State.LATER]
    lines = [
        f"{site.station.name or site.station.id} ({site.station.id}), {day:%Y-%m-%d} UTC",
        *_told(arrived),
        *_health(site, arrived),
        f"all: {counts['stored']} stored, {counts['set_aside']} set aside, {waits} waiting",
        "",
        *_areas(read_curves(site, begin_s - 7 * DAY_S), begin_s),
    ]
    return _cut(lines)


def yesterday(now_s: float) -> date:
    """Return the last day that is over."""
    return (datetime.fromtimestamp(now_s, UTC) - timedelta(days=1)).date()


def _told(arrived: list[Entry]) -> Iterator[str]:
    stored = [row for row in arrived if row.state is State.STORED]
    verdicts = Counter(row.verdict for row in stored)
    aside = [row for row in arrived if row.state is State.SET_ASIDE]
    kinds = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
    waits = len(arrived) - len(stored) - len(aside)
    yield f"arrived {len(arrived)}: {kinds or 'none stored'}, {len(aside)} set aside, {waits} waiting"
    for kind, rows in (("not good", [row for row in stored if row.verdict != "good"]), ("aside", aside)):
        reasons = Counter(row.reason[:MOST_LETTERS] for row in rows).most_common()
        yield from (f"{kind} {count}x: {reason}" for reason, count in reasons[:MOST_REASONS])
        if len(reasons) > MOST_REASONS:
            yield f"{kind}: {len(reasons) - MOST_REASONS} more reasons"


def _health(site: Site, arrived: list[Entry]) -> Iterator[str]:
    for name, words in (
        ("sigma_median_m", "sigma {:.3g} m"),
        ("stable_z_std", "stable ground scatters by {:.2f} sigma"),
        ("roll_deg", "roll {:.3f} deg"),
        ("pitch_deg", "pitch {:.3f} deg"),
        ("seconds", "{:.0f} s a scan"),
    ):
        found = [float(row.figures[name]) for row in arrived if row.figures.get(name) is not None]
        if found:
            yield f"{words.format(median(found))} (median; {min(found):.4g} to {max(found):.4g})"
    yield f"disk {shutil.disk_usage(site.station.data).free / 1e9:.1f} GB free"
    yield from (f"alarm: {text[:MOST_LETTERS]}" for text in firing(site.station.data).values())


def _areas(curves: list[Curve], begin_s: float) -> Iterator[str]:
    """Say how each area changed from before the day to its end, with 95 % as if nothing were shared."""
    if curves:
        yield "area: change of the day, against the reference [m], each with its 95 %"
    for curve in curves:
        end = int(np.searchsorted(curve.time_s, begin_s + DAY_S)) - 1
        start = int(np.searchsorted(curve.time_s, begin_s)) - 1
        if end < 0 or curve.time_s[end] < begin_s:
            yield f"{curve.name}: not seen"
            continue
        whole = f"{curve.change_m[end]:+.3f} ± {TOLD_SIGMAS * curve.sigma_m[end]:.3f}"
        start = max(start, 0)
        of_day_m = curve.change_m[end] - curve.change_m[start]
        sigma_m = np.hypot(curve.sigma_m[end], curve.sigma_m[start])
        yield f"{curve.name}: {of_day_m:+.3f} ± {TOLD_SIGMAS * sigma_m:.3f}, {whole}"


def _cut(lines: list[str]) -> str:
    """Join the lines as far as they fit."""
    text, room = "", MOST_BYTES - 40
    for index, line in enumerate(lines):
        if len((text + line).encode()) + 1 > room:
            return f"{text}... and {len(lines) - index} more lines\n"
        text += f"{line}\n"
    return text
