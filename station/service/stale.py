"""What an epoch was made from, against what the site would make it from today.

Nothing here opens a scan: what an epoch was made from is written in it (`archive.variables`).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.layout import Series, kept_of, strings
from station.archive.reference import current
from station.archive.sources import read_source, runs
from station.archive.store import AIR, Row, rows
from station.archive.variables import FILL, VERDICTS
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.quantities import Air
from station.readers.flags import flag_on, read_flags
from station.readers.sop import sop_for
from station.sections import WeatherSection
from station.service.content import sha256_of
from station.service.gather import kept_zero, sop_identity, weather_at
from station.service.inbox import Arrival
from station.service.journal import Entry, State
from station.service.places import find_scan
from station.service.tasks import Progress, series_of, version_of_given

LATE = {"inclination log came later", "weather came later"}  # what the service does again by itself
LOST = "epoch damaged or missing"
REFERENCE = "reference made with other settings or inputs"
AIR_MOVED = 1e-4  # °C, hPa, %: an instant in floating point interpolates to less


@dataclass(frozen=True)
class Made:
    """What a scan's part in an epoch, or in a reference, was made from."""

    scan_id: str
    start_s: float  # seconds since 1970
    end_s: float
    scan_sha256: str
    log_sha256: str
    sop_id: str
    lean_zero: str
    flag: str
    air: tuple[float, ...]  # () where it was not known

    def told(self) -> dict[str, str]:
        """Return it as text that `of_told` reads."""
        return {key: json.dumps(value) for key, value in asdict(self).items()}

    @classmethod
    def of_told(cls, told: Mapping[str, str]) -> Made:
        """Return what `told` wrote."""
        values = {key: json.loads(value) for key, value in told.items()}
        return cls(**{**values, "air": tuple(values["air"])})


@dataclass(frozen=True)
class Held:
    """An epoch of the series: where it is, and what it was made from."""

    row: Row
    made: Made
    science_hash: str
    reference: str
    verdict_reason: str
    verdict: int


@dataclass(frozen=True)
class Task:
    """An epoch to be done again, why, and the scan to do it from: None where that is gone."""

    name: str
    start_utc_s: float
    reasons: tuple[str, ...]
    arrival: Arrival | None
    reference: str | None
    revision: int


@dataclass(frozen=True)
class Plan:
    """What is to be done again, and the versions of the reference that have to be made anew first."""

    tasks: tuple[Task, ...]
    references: tuple[str, ...]

    def there(self) -> list[Task]:
        """Return what can be done: the tasks whose scan is there."""
        return [task for task in self.tasks if task.arrival is not None]

    def why(self) -> dict[str, int]:
        """Return how many epochs each reason holds for."""
        return dict(Counter(reason for task in self.tasks for reason in task.reasons).most_common())


def held(series: Series, found: list[Row] | None = None) -> list[Held]:
    """Return the epochs of the series and what each was made from; raise StoreError where one is damaged."""
    found = rows(series) if found is None else found
    told = []
    for path, first, at, count in runs(found):
        words = read_source(path, first, at, count).words
        texts = {name: strings(values) for name, values in words.items() if values.dtype.kind == "S"}
        told += [_held(found[at + index], index, words, texts) for index in range(count)]
    return told


def _held(
    row: Row, index: int, words: Mapping[str, np.ndarray[Any, Any]], texts: Mapping[str, list[str]]
) -> Held:
    def text(name: str) -> str:
        return texts[name][index] if name in texts else ""

    air = [float(words[name][index]) for name in AIR if name in words]
    known = len(air) == len(AIR) and max(air) < FILL / 2
    start_s, end_s = (float(bound) for bound in words["time_bnds"][index])
    made = Made(
        scan_id=text("scan_id"),
        start_s=start_s,
        end_s=end_s,
        scan_sha256=text("scan_sha256"),
        log_sha256=text("log_sha256"),
        sop_id=text("sop_id"),
        lean_zero=text("lean_zero"),
        flag=text("flag"),
        air=tuple(air) if known else (),
    )
    verdict = int(words["verdict"][index]) if "verdict" in words else 0
    return Held(row, made, text("science_hash"), text("reference_version"), text("verdict_reason"), verdict)


class Today:
    """What the site says now, of any moment."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._flags = read_flags(site.flags.file) if site.flags else []
        self._sop_id = cache(sop_identity)
        self._zero = cache(lambda sop_id: kept_zero(site, sop_id))

    def settings(self, made: Made) -> list[str]:
        """Say what of the settings is another now."""
        return [
            *(["other SOP"] if made.sop_id and self._sop_id_at(made.start_s) != made.sop_id else []),
            *(["other zero of lean"] if made.log_sha256 and self._has_other_zero(made) else []),
            *(["flag set or lifted"] if self.flag(made) != made.flag else []),
        ]

    def flag(self, made: Made) -> str:
        """Return the flag on a scan's time, as the store keeps it."""
        return kept_of(flag_on(self._flags, made.start_s, made.end_s), "sentence")

    def inputs(self, made: Made, arrival: Arrival | None, entry: Entry | None) -> list[str]:
        """Say which of the files that go into an epoch came later or are others now.

        One that has gone since is no reason: an epoch is not made worse.
        """
        found = self._weather_moved(made)
        if arrival is None:
            return found
        if arrival.log is not None and sha256_of(arrival.log) != made.log_sha256:
            found.append("other inclination log" if made.log_sha256 else "inclination log came later")
        seen = entry is not None and (entry.size, entry.mtime_ns) == (arrival.size, arrival.mtime_ns)
        told = entry.sha256 if entry is not None and seen and entry.sha256 else None
        if (told or sha256_of(arrival.path)) != made.scan_sha256:
            found.append("other bytes")
        return found

    def _sop_id_at(self, start_s: float) -> str:
        try:
            sop = sop_for(self._site.sop, datetime.fromtimestamp(start_s, UTC))
        except ScanError:
            return ""
        return kept_of(self._sop_id(sop), "text")

    def _has_other_zero(self, made: Made) -> bool:
        zero = self._zero(made.sop_id)
        return zero is not None and json.dumps(asdict(zero)) != made.lean_zero

    def _weather_moved(self, made: Made) -> list[str]:
        if self._site.weather is None or not made.sop_id:
            return []
        now = _weather_at(self._site.weather, (made.start_s + made.end_s) / 2)
        if now is None:
            return []
        if not made.air:
            return ["weather came later"]
        values = (now.temperature_c, now.pressure_hpa, now.humidity_pct)
        return ["other weather"] if np.abs(np.subtract(values, made.air)).max() > AIR_MOVED else []


def _weather_at(given: WeatherSection, moment_s: float) -> Air | None:
    """Return the air at a moment; None where the log does not tell, or cannot be used."""
    try:
        return weather_at(given, moment_s)
    except (ScanError, NotReadyError):
        return None


def plan(
    site: Site, entries: list[Entry], lost: set[str], between_s: tuple[float, float], progress: Progress
) -> Plan:
    """Return which epochs are stale and why, from the rows of the journal and the store.

    `lost` are names of journal rows whose epoch cannot be read; `between_s` bounds the starts. Raises
    StoreError where an epoch is damaged.
    """
    series = series_of(site)
    today = Today(site)
    by_epoch = {Path(entry.epoch).name: entry for entry in entries if entry.epoch}
    stored = held(series)
    stale = stale_versions(site, series, today, entries)
    sound = _current(site, series, stored)
    if sound is not None:
        sound -= set(stale)
        stale = stale or (() if sound else tuple(sorted({one.reference for one in stored} - {""})))
    tasks = [_lost(site, entry) for entry in entries if entry.name in lost]
    for one in stored:
        progress()
        entry = by_epoch.get(one.row.epoch_file)
        if entry is None or entry.name in lost or entry.outcome is State.SET_ASIDE:
            continue  # set aside: the bytes it was made from are gone
        arrival = find_scan(site, entry.name, one.made.start_s)
        reasons = [
            *(["waits to be done again"] if entry.outcome is None else []),
            *(["other settings"] if one.science_hash != site.science_hash else []),
            *([REFERENCE] if sound is not None and one.reference not in sound else []),
            *today.settings(one.made),
            *today.inputs(one.made, arrival, entry),
        ]
        if reasons:
            revision = max(one.row.revision, entry.revision or 0)
            tasks.append(Task(entry.name, one.made.start_s, tuple(reasons), arrival, one.reference, revision))
    inside = [task for task in tasks if between_s[0] <= task.start_utc_s < between_s[1]]
    return Plan(tuple(sorted(inside, key=lambda task: (task.start_utc_s, task.name))), stale)


def _lost(site: Site, entry: Entry) -> Task:
    start_s = entry.start_utc_s or 0.0
    arrival = find_scan(site, entry.name, start_s)
    return Task(entry.name, start_s, (LOST,), arrival, entry.reference, entry.revision or 0)


def usable(site: Site, entries: list[Entry], progress: Progress) -> list[str]:
    """Return the scans that a reference may be made of today, by their time: good, and without a flag."""
    progress()
    today = Today(site)
    by_epoch = {Path(entry.epoch).name: entry for entry in entries if entry.epoch}
    return [
        by_epoch[one.row.epoch_file].name
        for one in held(series_of(site))
        if one.row.epoch_file in by_epoch and VERDICTS[one.verdict] == "good" and not today.flag(one.made)
    ]


def late(site: Site, entries: list[Entry], progress: Progress) -> list[str]:
    """Return the names of scans whose log or weather came after they were stored without."""
    today = Today(site)
    by_epoch = {Path(entry.epoch).name: entry for entry in entries if entry.epoch}
    names = []
    for one in held(series_of(site)):
        progress()
        entry = by_epoch.get(one.row.epoch_file)
        if entry is None or (one.made.log_sha256 and one.made.air):
            continue
        arrival = find_scan(site, entry.name, one.made.start_s)
        if arrival is not None and LATE & set(today.inputs(one.made, arrival, entry)):
            names.append(entry.name)
    return names


def count_by_settings(site: Site) -> int:
    """Return how many epochs were made with another SOP, setting, flag or reference; opens no input."""
    series, today = series_of(site), Today(site)
    if not series.path.is_file():
        return 0
    stored = held(series)
    sound = _current(site, series, stored)
    return sum(
        one.science_hash != site.science_hash
        or bool(today.settings(one.made))
        or (sound is not None and one.reference not in sound)
        for one in stored
    )


def _current(site: Site, series: Series, stored: list[Held]) -> set[str] | None:
    """Return the versions that epochs may be measured from; None where there never was one."""
    if isinstance(site.reference.scans, Path):
        return {version_of_given(site.reference.scans)}
    made = set(current(series))
    return made if made or any(one.reference for one in stored) else None


def stale_versions(site: Site, series: Series, today: Today, entries: Iterable[Entry]) -> tuple[str, ...]:
    """Return the versions made with other settings or of other inputs, and those laid on them."""
    if isinstance(site.reference.scans, Path):
        return ()
    by_stem = {Path(entry.name).stem: entry for entry in entries}
    made = current(series)
    for at, lineage in enumerate(made.values()):
        is_stale = lineage.science_hash not in {"", site.science_hash}
        for one in map(Made.of_told, lineage.made_from):
            entry = by_stem.get(one.scan_id)
            arrival = find_scan(site, entry.name, one.start_s) if entry else None
            is_stale = is_stale or bool(today.settings(one) or today.inputs(one, arrival, entry))
        if is_stale:
            return tuple(made)[at:]
    return ()
