"""Health of the station in words: is sigma right at every distance, what was not good and why, the log.

The texts of the page explain each reason.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from station.archive.netcdf_layout import Series
from station.archive.reference_files import read_reference_provenance, version_path, versions
from station.archive.schema import VERDICTS
from station.archive.series.index import SeriesIndex
from station.products.epoch_table import EpochTable
from station.products.gallery import replace_if_changed
from station.products.web.page_text import format_utc
from station.quantities import Floats
from station.queries.stable_ground import z_by_range

CALIBRATED_Z_STD = (0.8, 1.25)  # limits of the standard deviation of change / sigma on stable ground
RECENT_SCANS = 24  # scans used for it
READ_EVERY_S = 43_200.0  # of their stable ground, as reading costs half of a decoding on a large grid
READ_SCANS = 1  # per page: older scans are read over several pages
MIN_CELLS = 20  # of stable ground, for a distance to be judged
DAYS, DAY_S, DAY_MIN = 10, 86_400.0, 1440.0
MAX_LOG = 20
MAX_REFERENCES = 5
REASONS = {  # explanations in page.*.json by what a reason contains; the first that matches counts
    "flagged": r"^flagged: ",
    "sweep": r"^partial sweep",
    "fog": r"usually visible cells observed",
    "clock": r"^clock of the inclination log|^inclination log .* (late|early) ",
    "log": r"^inclination log|no time per point|azimuth does not follow time",
    "tilt": r"tilt of the scanner unknown|tilt out of|sensor|tilt not corrected",
    "moved": r"moved\?$",
    "scatter": r"^hold-out stable ground scatters|^stable ground is off",
    "brightness": r"^no brightness",
    "stable": r"stable ground",
    "airborne": r"echoes are not from the ground",
    "weather": r"^weather|air ",
    "registration": r"^registration",
}


@dataclass(frozen=True)
class RangeCalibration:
    """Change of hold-out stable ground over its sigma, at some distance from the scanner."""

    range: str  # in words
    scans: int
    cells: float  # in a scan
    z: float
    status: str  # right, too_large or too_small (sigma)

    @property
    def factor(self) -> float:
        """By how much sigma is too large or too small, at least 1."""
        return max(self.z, 1 / max(self.z, 1e-2))


@dataclass(frozen=True)
class Run:
    """Scans of one verdict without a gap between them, through a day [min]."""

    verdict: str
    begin_min: int
    length_min: int


@dataclass(frozen=True)
class Day:
    """The scans of a day (UTC); `counts` by verdict, with those that are missing."""

    date: str
    counts: dict[str, int]
    runs: list[Run]


@dataclass(frozen=True)
class Reason:
    """Why scans were not good: a kind of reason, with its newest message."""

    key: str
    verdict: str
    message: str
    newest_s: float
    count: int


def sigma_status(z_std: float) -> str:
    """Return whether sigma is right, too_large or too_small, from the scatter of change over sigma."""
    low, high = CALIBRATED_Z_STD
    return "right" if low <= z_std <= high else "too_large" if z_std < low else "too_small"


def calibration_by_range(
    series: Series, table: EpochTable, folder: Path, text: dict[str, str]
) -> list[RangeCalibration]:
    """Return the calibration of sigma by distance, from two scans a day that are not of the reference.

    What was read of a scan is kept in `folder`. Raises StoreError if an epoch cannot be read.
    """
    path = folder / ".calibration.json"
    try:
        known = json.loads(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        known = {}
    epochs = SeriesIndex(series)
    usable = [
        position
        for position, z_std in enumerate(table.scalars["stable_z_std"])
        if np.isfinite(z_std) and table.texts["reference_version"][position]
    ]
    windows = table.start_s[usable] // READ_EVERY_S
    usable = [usable[index] for index in np.flatnonzero(np.diff(windows, prepend=-1.0))]
    by_scan: dict[str, Any] = {}
    reads = 0
    for position in usable[: -RECENT_SCANS - 1 : -1]:
        name = table.texts["epoch_file"][position]
        if name not in known:
            if reads == READ_SCANS:
                continue
            known[name], reads = z_by_range(series, epochs[position]), reads + 1
        by_scan[name] = known[name]
    replace_if_changed(path, json.dumps(by_scan).encode("ascii"))
    of_reference = _scans_of_references(series)
    bands: dict[tuple[float, float | None], list[tuple[int, float]]] = {}
    for name, rows in by_scan.items():
        if table.texts["scan_id"][table.texts["epoch_file"].index(name)] not in of_reference:
            for low_m, high_m, cells, z_std in rows:
                if cells >= MIN_CELLS:
                    bands.setdefault((low_m, high_m), []).append((cells, z_std))
    return [_range_calibration(band, values, text) for band, values in sorted(bands.items(), key=_low)]


def _low(item: tuple[tuple[float, float | None], object]) -> float:
    return item[0][0]


def _range_calibration(
    band: tuple[float, float | None], values: list[tuple[int, float]], text: dict[str, str]
) -> RangeCalibration:
    low_m, high_m = band
    key = "range_beyond" if high_m is None else "range_between" if low_m else "range_to"
    words = text[key].format(low=f"{low_m:g}", high=f"{high_m:g}" if high_m else "")
    z = median(z_std for _, z_std in values)
    return RangeCalibration(words, len(values), median(cells for cells, _ in values), z, sigma_status(z))


def summary_of_sigma(table: EpochTable | None, by_range: list[RangeCalibration]) -> dict[str, Any] | None:
    """Return how sigma compares with stable ground: at the worst distance, or over all; None if unknown."""
    if by_range:
        worst = max(by_range, key=lambda row: row.factor)
        return {"z": worst.z, "status": worst.status, "scans": worst.scans, "range": worst.range}
    z = table.scalars["stable_z_std"] if table is not None else np.empty(0)
    z = z[np.isfinite(z)][-RECENT_SCANS:]
    if not len(z):
        return None
    z_std = float(np.median(z))
    return {"z": z_std, "status": sigma_status(z_std), "scans": len(z), "range": ""}


def timeline(table: EpochTable, expected_every_s: float, now_s: float) -> list[Day]:
    """Return the newest days with a scan or without, the newest first, each with its verdicts.

    Scans are missing from a day if it has fewer than expected since the first scan, until now.
    """
    if not len(table):
        return []
    newest = math.floor(table.start_s[-1] / DAY_S)
    first = max(newest - DAYS + 1, math.floor(table.start_s[0] / DAY_S))
    days = []
    for number in range(newest, first - 1, -1):
        begin_s, end_s = number * DAY_S, (number + 1) * DAY_S
        here = slice(*np.searchsorted(table.start_s, [begin_s, end_s]))
        start_s, verdicts = table.start_s[here], table.verdict[here]
        counted = Counter(verdicts)
        span_s = min(end_s, now_s) - max(begin_s, float(table.start_s[0]))
        missing = math.floor(span_s / expected_every_s) - len(verdicts)
        counts = {verdict: counted[verdict] for verdict in VERDICTS if counted[verdict]}
        days.append(
            Day(
                f"{datetime.fromtimestamp(begin_s, UTC):%Y-%m-%d}",
                counts | ({"missing": missing} if missing > 0 else {}),
                _runs((start_s - begin_s) / 60, verdicts, expected_every_s / 60),
            )
        )
    return days


def _runs(start_min: Floats, verdicts: list[str], every_min: float) -> list[Run]:
    """Return the runs of scans that began at these minutes of a day (n,)."""
    runs: list[Run] = []
    for begin, verdict in zip(start_min.tolist(), verdicts, strict=True):
        end = min(begin + 0.9 * every_min, DAY_MIN)  # a narrow gap shows where the verdict changes
        last = runs[-1] if runs else None
        if last and last.verdict == verdict and begin <= last.begin_min + last.length_min + every_min * 0.6:
            runs[-1] = Run(verdict, last.begin_min, round(end - last.begin_min))
        else:
            runs.append(Run(verdict, round(begin), max(round(end - begin), 1)))
    return runs


def reasons(table: EpochTable) -> list[Reason]:
    """Return why scans of the newest days were not good, the most frequent reason first."""
    if not len(table):
        return []
    begin_s = (math.floor(table.start_s[-1] / DAY_S) - DAYS + 1) * DAY_S
    found: dict[str, Reason] = {}
    for position in range(int(np.searchsorted(table.start_s, begin_s)), len(table)):
        verdict = table.verdict[position]
        if verdict == VERDICTS[0]:
            continue
        for message in table.texts["verdict_reason"][position].split("; "):
            key = explanation(message)
            group = key if key != "other" else re.sub(r"[\d.,]+", "…", message)
            count = found[group].count if group in found else 0
            found[group] = Reason(key, verdict, message, float(table.start_s[position]), count + 1)
    return sorted(found.values(), key=lambda reason: -reason.count)


def explanation(message: str) -> str:
    """Return the key of the explanation of a reason of a verdict; "other" if there is none."""
    return next((key for key, pattern in REASONS.items() if re.search(pattern, message)), "other")


def _scans_of_references(series: Series) -> set[str]:
    return {
        scan
        for version in versions(series)[-MAX_REFERENCES:]
        for scan in read_reference_provenance(series, version).scan_ids
    }


def log_entries(
    series: Series,
    measured_again: list[tuple[float, int, float, float]],
    alarms: list[tuple[float, str]],
    text: dict[str, str],
) -> list[dict[str, Any]]:
    """Return what happened to the station, the newest first: references, scans measured again, alarms.

    `measured_again` are time, count, first and last scan [s]; `alarms` time [s] and message.
    """
    entries = [(time_s, message) for time_s, message in alarms]
    entries += [
        (
            time_s,
            text["log_again"].format(count=count, first=format_utc(first_s), last=format_utc(last_s)),
        )
        for time_s, count, first_s, last_s in measured_again
    ]
    for version in versions(series)[-MAX_REFERENCES:]:
        count = len(read_reference_provenance(series, version).scan_ids)
        built_s = version_path(series, version).stat().st_mtime
        entries.append((built_s, text["log_reference"].format(version=version, count=count)))
    newest_first = sorted(entries, reverse=True)[:MAX_LOG]
    return [{"time_s": time_s, "text": message} for time_s, message in newest_first]
