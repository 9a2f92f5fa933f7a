"""`station score`: how good the results of an archive of scans are, on one page without a point of them."""

from __future__ import annotations

import json
import re
import resource
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from station._version import __version__
from station.archive.atomic_files import atomic_write
from station.archive.derived.computed_rasters import CHANGE
from station.archive.derived.event_table import read_events
from station.archive.netcdf_layout import Series
from station.archive.reference_files import read_reference
from station.archive.small_variables import read_text
from station.config import Site
from station.errors import StoreError
from station.inbox.journal_reader import Entry, State
from station.monitoring.alarm_rules import change_alarms
from station.monitoring.area_curves import read_curves
from station.operations.batch import process_scans
from station.operations.reports.calibration_report import sigma_report
from station.operations.reports.report_pages import write_page
from station.processing.scans.scan_files import inbox_scans
from station.processing.site_files import series_for
from station.processing.workers import fork_server, isolation
from station.quantities import Floats, Grid, Ints, Quality
from station.queries.epoch_cells import read_window
from station.queries.stable_ground import sample_epochs
from station.science.adjustment import ground_classes
from station.science.analysis import calibration
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL
from station.sections.results import ChangeAlarm, ProductsSection, RetentionSection

Score = dict[str, Any]
Errors = Mapping[str, tuple[Ints, Floats]]  # cells and their change [m], by scan
Report = Callable[[Entry], None]

FIGURE, FOLDER = re.compile(r"[-+−]?\d+([.,]\d+)*"), re.compile(r"(?<!\S)/\S*/")  # in a reason
MAX_REASONS = 5
OWN, OTHER = "own", "registration"  # folders of the two stores


def score(site: Site, out: Path, max_epochs: int, report: Report) -> Score:
    """Process all scans of an archive in the folder `out`, twice; return what the results are worth.

    Once as the site file says, once with the owner's registration of each scan as it is, or without one by
    the SOP and the log alone. Nothing is written to the archive. Raises StoreError if there is no scan, or
    none could be stored.
    """
    files = dict.fromkeys(
        path for scan in inbox_scans(site) for path in (scan.path, *(part.path for part in scan.parts))
    )
    if not files:
        raise StoreError(f"{site.scans.inbox}: no scan in it: scans.inbox is the folder of the archive")
    own, other = _scored_site(site, out / OWN), _unadjusted_site(site, out / OTHER)
    entries, cpu_s = _processed(own, list(files), report)
    series, other_series = series_for(own), series_for(other)
    if not series.path.is_file():
        reasons = {entry.reason or entry.waiting_reason for entry in entries}
        raise StoreError(f"{out}: no scan could be stored: {'; '.join(sorted(reasons)[:3])}")
    _processed(other, list(files), report)
    gain: list[Score] = []
    if other_series.path.is_file():
        errors = withheld_errors(series, max_epochs)
        other_errors = withheld_errors(other_series, max_epochs, adjusted=False)
        gain = gain_by_scale(errors, other_errors, series.grid)
    return {
        "station": site.station.name or site.station.id,
        "version": __version__,
        "written": f"{datetime.now(UTC):%Y-%m-%d %H:%M}",
        "registration": "owner" if site.registration else "SOP and log",
        "cells": list(series.grid.shape),
        "cell_m": series.grid.cell_m,
        "scans": _verdicts(entries),
        "reasons": _reasons(entries),
        "after_reference": _scans_after_reference(site, entries),
        "cpu_s_per_scan": cpu_s,
        **_sigma(own, max_epochs),
        "gain": gain,
        "alarms": replayed_alarms(own),
        "events": _events(own),
    }


def _sigma(site: Site, max_epochs: int) -> Score:
    """Return z by scale and range, and sigma stated and found by distance [m], of withheld ground."""
    memory_gb, timeout_s = site.service.memory_gb, site.scans.timeout_s
    report = isolation.TaskRunner().run(
        sigma_report, site, max_epochs, memory_gb=memory_gb, timeout_s=timeout_s
    )
    lags = [
        {
            "lag_m": row["lag_m"],
            "pairs": row["pairs"],
            "found_m": row["observed_m2"] ** 0.5,
            "stated_m": row["stated_m2"] ** 0.5,
        }
        for row in report["variogram"]
    ]
    return {"z": report["overall"], "sigma": lags}


def _events(site: Site) -> list[Score]:
    """Return kind, begin and volume of the events."""
    return [
        {
            "kind": event.kind,
            "begin": event.begin,
            "volume_m3": event.volume_m3,
            "sigma_m3": event.volume_sigma_m3,
        }
        for event in read_events(site.station.data)
    ]


def _scored_site(site: Site, data: Path) -> Site:
    """Return the site with another data folder, and without what the score does not show."""
    return site.model_copy(
        update={
            "station": site.station.model_copy(update={"data": data.absolute()}),
            "products": ProductsSection(page=False),
            "retention": RetentionSection(),
            "mirror": None,
            "publish": None,
        }
    )


def _unadjusted_site(site: Site, data: Path) -> Site:
    """Return the site with the owner's registration as given; without one, by the SOP and the log alone."""
    site = _scored_site(site, data)
    if site.registration is not None:
        return site.model_copy(update={"registration": site.registration.model_copy(update={"use": "given"})})
    return site.model_copy(update={"adjustment": site.adjustment.model_copy(update={"method": "none"})})


def _processed(site: Site, files: list[Path], report: Report) -> tuple[list[Entry], float]:
    """Process the files; return the last journal row of each scan, and the CPU time of a scan [s].

    That is the time of all processes, by the number of scans.
    """
    fork_server.stop()  # its processes count once it has ended
    before_s = _cpu_s()
    entries: dict[str, Entry] = {}

    def record(entry: Entry) -> None:
        entries[entry.name] = entry
        report(entry)

    process_scans(site, files, record)
    fork_server.stop()
    return list(entries.values()), (_cpu_s() - before_s) / max(1, len(entries))


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def _verdicts(entries: Iterable[Entry]) -> dict[str, int]:
    """Return the number of scans by verdict, or by state if they are not stored."""
    words = [
        (entry.verdict or "") if entry.state is State.STORED else entry.state.value.replace("_", " ")
        for entry in entries
    ]
    return dict(Counter(words))


def _reasons(entries: Iterable[Entry]) -> dict[str, int]:
    """Return the number of scans by why they are not good, without figures and folders; the most common."""
    reasons = Counter(FIGURE.sub("…", FOLDER.sub("", entry.reason)) for entry in entries if entry.reason)
    return dict(reasons.most_common(MAX_REASONS))


def _scans_after_reference(site: Site, entries: Iterable[Entry]) -> int:
    """Return the number of stored scans that the reference is not made of."""
    taken = site.reference.scans if isinstance(site.reference.scans, int) else 0
    return max(sum(entry.state is State.STORED for entry in entries) - taken, 0)


def withheld_errors(
    series: Series, max_epochs: int, *, adjusted: bool = True
) -> dict[str, tuple[Ints, Floats]]:
    """Return the change of withheld ground in the scans after the reference: cells, change [m].

    Only of stable ground if the scans are `adjusted`; others do not tell which ground is stable.
    """
    grid, reference = series.grid, read_reference(series)
    holdout = ground_classes.is_holdout(grid.x_m[None, :], grid.y_m[:, None])
    errors = {}
    for epoch in sample_epochs(series, max_epochs):
        with h5py.File(epoch.path, "r") as file:
            scan_id = read_text(file, "scan_id", epoch.index)
            if reference is not None and scan_id in reference.scan_ids:
                continue
            withheld = holdout
            if adjusted:
                withheld = holdout & ((file["quality"][epoch.index] & Quality.STABLE_GROUND) > 0)
            change_m = read_window(file, CHANGE, epoch.index, (slice(None), slice(None)))
        cell = np.flatnonzero(withheld & np.isfinite(change_m))
        errors[scan_id] = cell, change_m.ravel()[cell].astype(np.float64)
    return errors


def gain_by_scale(own: Errors, other: Errors, grid: Grid) -> list[dict[str, Any]]:
    """Return the size of the errors of withheld ground in both results, on the cells of both, and the gain.

    By scale: a cell, blocks of 10 m and 100 m, all of it. The size is the median of the absolute errors, as
    the standard deviation of normal ones: a few cells at edges have gross errors in both.
    """
    pairs: dict[str, list[Floats]] = {}
    for scan in own.keys() & other.keys():
        cell, first, second = np.intersect1d(own[scan][0], other[scan][0], return_indices=True)
        if not len(cell):
            continue
        errors_m = np.stack([own[scan][1][first], other[scan][1][second]], axis=1)
        row, column = grid.row_and_column(cell.astype(np.int32))
        pairs.setdefault("cell", []).append(errors_m)
        for size_m in calibration.SCALES_M:
            if size_m > grid.cell_m:
                means = calibration.block_means(grid.x_m[column], grid.y_m[row], size_m)
                pairs.setdefault(f"{size_m:g} m", []).append(means @ errors_m)
        pairs.setdefault("all", []).append(errors_m.mean(axis=0, keepdims=True))
    table = []
    for scale, errors in pairs.items():
        own_m, other_m = (np.median(np.abs(np.concatenate(errors)), axis=0) / MEDIAN_ABSOLUTE_NORMAL).tolist()
        values = sum(len(part) for part in errors)
        table.append(
            {"scale": scale, "values": values, "own_m": own_m, "other_m": other_m, "gain": other_m / own_m}
        )
    return table


def replayed_alarms(site: Site) -> list[dict[str, Any]]:
    """Return the alarms of areas that the rule of the site file, or the default, would have raised."""
    rule = (site.alarms and site.alarms.change) or ChangeAlarm()
    curves = [curve for curve in read_curves(site, -np.inf) if not rule.areas or curve.name in rule.areas]
    alarms = []
    for curve in curves:
        found = change_alarms(curve, rule, areas=len(curves), expected_every_s=site.scans.expected_every_s)
        begins = [
            index
            for index, (before, now) in enumerate(pairwise([False, *found.detected.tolist()]))
            if now and not before
        ]
        alarms += [
            {
                "area": curve.name,
                "time": f"{datetime.fromtimestamp(curve.time_s[index], UTC):%Y-%m-%d %H:%M}",
                "change_m": float(found.change_m[index]),
                "sigma_m": float(found.sigma_m[index]),
            }
            for index in begins
        ]
    return sorted(alarms, key=lambda alarm: str(alarm["time"]))


def write_score(result: object, out: Path) -> list[Path]:
    """Write a score without NaN as `score.html`, self-contained, and as `score.json`; return the paths.

    Raises StoreError if they cannot be written.
    """
    paths = [out / "score.html", out / "score.json"]
    write_page(paths[0], "score.html", score=result)
    with atomic_write(paths[1]) as tmp_path:
        tmp_path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return paths
