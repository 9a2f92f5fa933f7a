"""`station calibrate`: calibration of sigma, and precision of ranges and angles, from a station's data."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.atomic_files import atomic_write
from station.config import Site
from station.errors import ScanError, StoreError
from station.processing.scans.scan_files import inbox_scans
from station.processing.site_files import series_for
from station.processing.workers import isolation
from station.quantities import Floats
from station.queries.box_series import box_statistics
from station.queries.stable_ground import validate_sigma
from station.readers.formats.conversion import open_site_scan
from station.science.analysis.precision import (
    AnglePrecision,
    RangeModel,
    angle_precision,
    find_planes,
    fit_range_model,
    is_surface_rough,
    sigma_by_class,
    window_width,
)

CalibrationReport = dict[str, Any]
Progress = Callable[[], None]
COMPARED_SCANS = 2  # number of scans compared
MAX_SHOTS = 2_000_000  # from the beginning of a scan; more add nothing about its noise
WIDER_WINDOW = 1.7  # factor of the wider window that reveals rough ground
MAX_RELATIVE_ERROR = 1 / 3  # of the range noise, for a key in the site file
TABLES = ("overall", "epochs", "variogram", "boxes")


def calibration_report(
    site: Site, scans: Sequence[Path], max_epochs: int, progress: Progress
) -> CalibrationReport:
    """Return stated and observed sigma, box statistics, and the precision of ranges and angles.

    Ranges come from the newest of `scans`, angles from the two newest; without `scans`, from the inbox.
    Raises StoreError without series and scan, ScanError if a named scan cannot be read.
    """
    series = series_for(site)
    memory_gb, timeout_s = site.service.memory_gb, site.scans.timeout_s
    report: CalibrationReport = {}
    if series.path.is_file():
        report |= isolation.TaskRunner().run(
            sigma_report, site, max_epochs, memory_gb=memory_gb, timeout_s=timeout_s, on_progress=progress
        )
    chosen = sorted(scans)[-COMPARED_SCANS:] or _newest_scans(site)
    if site.scans.frame == "scanner" and chosen:
        try:
            report["precision"] = isolation.TaskRunner().run(
                precision_report, site, chosen, memory_gb=memory_gb, timeout_s=timeout_s
            )
        except ScanError as error:
            if scans:
                raise
            report["precision"] = {"scans": [path.name for path in chosen], "fault": str(error)}
    if not report:
        raise StoreError(f"{series.folder}: nothing is stored yet, and there is no scan to measure")
    return report


def sigma_report(site: Site, max_epochs: int, progress: Progress) -> CalibrationReport:
    """Return sigma on stable ground and box statistics of the series; runs in a worker process."""
    series = series_for(site)
    report = asdict(validate_sigma(series, max_epochs, progress))
    report["epochs"] = [{k: v for k, v in row.items() if k != "z"} for row in report["epochs"]]
    return report | {"boxes": box_statistics(series, max_epochs, progress)}


def _newest_scans(site: Site) -> list[Path]:
    """Return the first files of the newest scans in the inbox."""
    scans = inbox_scans(site) if site.scans.inbox.is_dir() else []
    return [scan.path for scan in scans[-COMPARED_SCANS:]]


def precision_report(site: Site, scans: Sequence[Path], progress: Progress) -> CalibrationReport:
    """Return the scanner's precision from the shots of one or two scans; runs in a worker process."""
    shots = []
    for path in scans:
        shots.append(_read_shots(site, path))
        progress()
    xyz_m, intensity = shots[-1]
    angles = angle_precision(xyz_m, shots[0][0]) if len(shots) > 1 else None
    width_rad = window_width(xyz_m)
    planes, wide = (find_planes(xyz_m, intensity, factor * width_rad) for factor in (1.0, WIDER_WINDOW))
    model, wider = fit_range_model(planes), fit_range_model(wide)
    rough = model is not None and wider is not None and is_surface_rough(model, wider)
    return {
        "scans": [path.name for path in scans],
        "planes": sigma_by_class(planes) if model is not None else [],
        "range": None if model is None else asdict(model) | {"rough": rough},
        "angles": None if angles is None else {"elevation": asdict(angles[0]), "azimuth": asdict(angles[1])},
        "site_file": _site_file_keys(None if rough else model, angles),
    }  # fmt: skip


def _read_shots(site: Site, path: Path) -> tuple[Floats, Floats]:
    """Return the first shots of a scan: coordinates (n, 3) [m]; intensity (n,), ones if it has none."""
    points: list[Floats] = []
    intensity: list[Floats] = []
    count = 0
    with open_site_scan(
        path, site.scans, range_max_m=site.scanner.range_max_m, work_folder=site.station.data
    ) as reader:
        for block in reader.blocks(intensity=site.scans.intensity):
            points.append(block.xyz_m.T)
            intensity.append(np.ones(len(block)) if block.intensity is None else block.intensity)
            count += len(block)
            if count >= MAX_SHOTS:
                break
    if not count:
        raise ScanError(f"{path.name}: contains no points")
    return np.concatenate(points), np.concatenate(intensity)


def _site_file_keys(
    model: RangeModel | None, angles: tuple[AnglePrecision, AnglePrecision] | None
) -> CalibrationReport:
    """Return the keys for the [scanner] table of the site file that could be determined."""
    keys: CalibrationReport = {}
    if model is not None and model.typical_error < MAX_RELATIVE_ERROR:
        keys["range_sigma_m"] = float(f"{model.typical_m:.2g}")
    if angles is not None:  # the key is the full width of a uniform error
        worse_rad = max(angle.precision_rad for angle in angles)
        keys["angle_resolution_deg"] = float(f"{math.degrees(worse_rad) * math.sqrt(12):.2g}")
    return keys


def write_tables(report: CalibrationReport, folder: Path) -> list[Path]:
    """Write the report as CSV files and [scanner] keys; return the paths, raise StoreError on failure."""
    tables = {name: report[name] for name in TABLES if report.get(name)}
    precision = report.get("precision") or {}
    if precision.get("planes"):
        tables["planes"] = precision["planes"]
    written = []
    for name, rows in tables.items():
        path = folder / f"{name}.csv"
        with atomic_write(path) as tmp_path, tmp_path.open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)
        written.append(path)
    if precision.get("site_file"):
        path = folder / "scanner.toml"
        with atomic_write(path) as tmp_path:
            tmp_path.write_text(_toml(precision["site_file"]), encoding="utf-8")
        written.append(path)
    return written


def _toml(keys: CalibrationReport) -> str:
    return "\n".join(["[scanner]", *(f"{key} = {value:g}" for key, value in keys.items()), ""])


def format_report(report: CalibrationReport) -> str:
    """Return the report as text."""
    lines: list[str] = []
    if "overall" in report:
        lines += _format_sigma(report) if report["overall"] else ["no epoch has hold-out stable ground yet"]
    if precision := report.get("precision"):
        lines += ["", *_format_precision(precision)]
    return "\n".join(lines).strip()


def _format_sigma(report: CalibrationReport) -> list[str]:
    lines = [
        "Error over stated sigma on hold-out stable ground; ideally 1 and 95 %",
        "scale            range  epochs   errors     sd  robust  in 95 %  factor  95 % of it",
    ]
    for row in report["overall"]:
        interval = f"{row['low']:.2f}-{row['high']:.2f}" if math.isfinite(row["factor"]) else ""
        columns = (
            f"{row['scale']:8}{row['band']:>14}{row['epochs']:8}{row['count']:9}",
            _format_number(row["z_std"], 7),
            _format_number(row["z_robust"], 8),
            _format_number(100 * row["inside_95"], 9, 0),
            _format_number(row["factor"], 8),
            f"  {interval}",
            "  multiply sigma by the factor" if row["advised"] else "",
        )
        lines.append("".join(columns))
    lines += [
        "",
        "Semivariogram of the same errors",
        f"{'lag, m':>9}{'pairs':>9}{'observed, m2':>14}{'stated, m2':>12}",
    ]
    lines += [
        f"{row['lag_m']:9.0f}{row['pairs']:9}{row['observed_m2']:14.2e}{row['stated_m2']:12.2e}"
        for row in report["variogram"]
    ]
    return lines


def _format_number(value: float, width: int, digits: int = 2) -> str:
    return f"{value:{width}.{digits}f}" if math.isfinite(value) else " " * (width - 1) + "-"


def _format_precision(precision: CalibrationReport) -> list[str]:
    lines = [f"Precision of the scanner, from {' and '.join(precision['scans'])}"]
    if "fault" in precision:
        return [*lines, f"  {precision['fault']}: choose other scans"]
    if model := precision["range"]:
        text = f"{model['typical_m'] * 1e3:.1f} mm ± {100 * model['typical_error']:.0f} %"
        if model["typical_error"] >= MAX_RELATIVE_ERROR:
            text = "not separable from angle noise: every plane is seen too obliquely or too far away"
        elif model["rough"]:
            text = f"at most {text}: the ground is rough; scan walls or slabs more densely"
        lines.append(f"  range, {model['planes']} planes: {text}")
        if model["a_m"] > 0 and model["typical_error"] < MAX_RELATIVE_ERROR:
            lines.append(f"    by intensity I: {model['a_m']:.2g} I^{model['b']:.2f} + {model['c_m']:.2g} m")
        angle_urad = model["sigma_angle_rad"] * 1e6
        lines.append(f"  angle on planes, including beam and roughness: {angle_urad:.1f} µrad")
    else:
        lines.append("  range: too few planes")
    for name, angle in (precision["angles"] or {}).items():
        lines.append(
            f"  {name}, {angle['shots']} shots twice: {angle['precision_rad'] * 1e6:.2f} µrad; repeats differ"
            f" by {angle['observed_rad'] * 1e6:.1f}, sampling contributes {angle['sampling_rad'] * 1e6:.1f}"
        )
    if precision["angles"] is None:
        lines.append("  angles: no two scans with common lines")
    if precision["site_file"]:
        lines += ["", "For the site file:", _toml(precision["site_file"]).strip()]
    return lines
