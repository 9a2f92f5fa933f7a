"""`station calibrate`: what a station's own data say of its sigma, its ranges and its angles."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.boxes import box_statistics
from station.archive.layout import written_whole
from station.archive.observed import observe
from station.config import Site
from station.errors import ScanError, StoreError
from station.quantities import Floats
from station.readers.scan import open_scan, suffixes
from station.science.precision import (
    AnglePrecision,
    RangeModel,
    angle_precision,
    by_class,
    find_planes,
    fit_range_model,
    is_rough,
    window_for,
)
from station.service import child
from station.service.tasks import series_of

Told = dict[str, Any]
Progress = Callable[[], None]
REPEATS = 2  # scans that are compared
MOST_SHOTS = 2_000_000  # of a scan, from its beginning; more say nothing new of its noise
WIDER = 1.7  # windows, to see whether the ground is rough
TRUSTED = 1 / 3  # relative error of a range noise that is worth a key
TABLES = ("overall", "epochs", "variogram", "boxes")


def calibrate(site: Site, scans: Sequence[Path], most_epochs: int, progress: Progress) -> Told:
    """Return stated against observed sigma, boxes beside the lean, and the precision of ranges and angles.

    Ranges are of the newest of `scans`, angles of the two newest; where none is given, of those in the inbox.
    Raises StoreError where there is neither a series nor a scan, ScanError where a named scan cannot be read.
    """
    series = series_of(site)
    memory_gb, timeout_s = site.service.memory_gb, site.scans.timeout_s
    told: Told = {}
    if series.path.is_file():
        told |= child.run(
            series_told, site, most_epochs, memory_gb=memory_gb, timeout_s=timeout_s, on_progress=progress
        )
    chosen = sorted(scans)[-REPEATS:] or _newest(site)
    if site.scans.frame == "scanner" and chosen:
        try:
            told["precision"] = child.run(
                precision_of, site, chosen, memory_gb=memory_gb, timeout_s=timeout_s
            )
        except ScanError as error:
            if scans:
                raise
            told["precision"] = {"scans": [path.name for path in chosen], "fault": str(error)}
    if not told:
        raise StoreError(f"{series.folder}: nothing is stored yet, and there is no scan to look at")
    return told


def series_told(site: Site, most_epochs: int, progress: Progress) -> Told:
    """Return what the series says: sigma on stable ground, and boxes; runs in a child process."""
    series = series_of(site)
    found = asdict(observe(series, most_epochs, progress))
    found["epochs"] = [{k: v for k, v in row.items() if k != "z"} for row in found["epochs"]]
    return found | {"boxes": box_statistics(series, most_epochs, progress)}


def _newest(site: Site) -> list[Path]:
    inbox = site.scans.inbox
    found = sorted(p for p in inbox.iterdir() if p.suffix.lower() in suffixes()) if inbox.is_dir() else []
    return found[-REPEATS:]


def precision_of(site: Site, scans: Sequence[Path], progress: Progress) -> Told:
    """Return what the shots of one or two scans say of the scanner; runs in a child process."""
    shots = []
    for path in scans:
        shots.append(_shots(site, path))
        progress()
    xyz_m, intensity = shots[-1]
    again = angle_precision(xyz_m, shots[0][0]) if len(shots) > 1 else None
    width_rad = window_for(xyz_m)
    planes, wide = (find_planes(xyz_m, intensity, width * width_rad) for width in (1.0, WIDER))
    model, wider = fit_range_model(planes), fit_range_model(wide)
    rough = model is not None and wider is not None and is_rough(model, wider)
    return {
        "scans": [path.name for path in scans],
        "planes": by_class(planes) if model is not None else [],
        "range": None if model is None else asdict(model) | {"rough": rough},
        "angles": None if again is None else {"elevation": asdict(again[0]), "azimuth": asdict(again[1])},
        "site_file": _keys(None if rough else model, again),
    }  # fmt: skip


def _shots(site: Site, path: Path) -> tuple[Floats, Floats]:
    """Read the first shots of a scan: coordinates (n, 3) [m], intensity (n,), ones where it has none."""
    points: list[Floats] = []
    bright: list[Floats] = []
    count = 0
    with open_scan(path, range_max_m=site.scanner.range_max_m) as reader:
        for block in reader.blocks():
            points.append(block.xyz_m.T)
            bright.append(np.ones(len(block)) if block.intensity is None else block.intensity)
            count += len(block)
            if count >= MOST_SHOTS:
                break
    if not count:
        raise ScanError(f"{path.name}: holds no point")
    return np.concatenate(points), np.concatenate(bright)


def _keys(model: RangeModel | None, again: tuple[AnglePrecision, AnglePrecision] | None) -> Told:
    """Return what the [scanner] table of the site file can take, as far as it was found."""
    keys: Told = {}
    if model is not None and model.typical_error < TRUSTED:
        keys["range_sigma_m"] = float(f"{model.typical_m:.2g}")
    if again is not None:  # the key is the width of a uniform error
        worse_rad = max(one.precision_rad for one in again)
        keys["angle_resolution_deg"] = float(f"{math.degrees(worse_rad) * math.sqrt(12):.2g}")
    return keys


def write_tables(told: Told, folder: Path) -> list[Path]:
    """Write what was found as CSV files, and the keys for the site file; raise StoreError where it cannot."""
    tables = {name: told[name] for name in TABLES if told.get(name)}
    precision = told.get("precision") or {}
    if precision.get("planes"):
        tables["planes"] = precision["planes"]
    written = []
    for name, rows in tables.items():
        path = folder / f"{name}.csv"
        with written_whole(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)
        written.append(path)
    if precision.get("site_file"):
        path = folder / "scanner.toml"
        with written_whole(path) as beside:
            beside.write_text(_toml(precision["site_file"]), encoding="utf-8")
        written.append(path)
    return written


def _toml(keys: Told) -> str:
    return "\n".join(["[scanner]", *(f"{key} = {value:g}" for key, value in keys.items()), ""])


def describe(told: Told) -> str:
    """Return what was found as lines for a person."""
    lines: list[str] = []
    if "overall" in told:
        lines += (
            _stated(told)
            if told["overall"]
            else ["no epoch has stable ground withheld from its adjustment yet"]
        )
    if precision := told.get("precision"):
        lines += ["", *_measured(precision)]
    return "\n".join(lines).strip()


def _stated(told: Told) -> list[str]:
    lines = [
        "Error over stated sigma on stable ground that no fit has seen; 1 and 95 % are right",
        "scale            range  epochs   errors     sd  robust  in 95 %  factor  95 % of it",
    ]
    for row in told["overall"]:
        interval = f"{row['low']:.2f}-{row['high']:.2f}" if math.isfinite(row["factor"]) else ""
        lines.append(
            f"{row['scale']:8}{row['band']:>14}{row['epochs']:8}{row['count']:9}{_number(row['z_std'], 7)}"
            f"{_number(row['z_robust'], 8)}{_number(100 * row['inside_95'], 9, 0)}"
            f"{_number(row['factor'], 8)}  {interval}"
            f"{'  multiply sigma by it' if row['advised'] else ''}"
        )
    lines += [
        "",
        "Semivariogram of the same errors",
        f"{'lag, m':>9}{'pairs':>9}{'observed, m2':>14}{'stated, m2':>12}",
    ]
    lines += [
        f"{row['lag_m']:9.0f}{row['pairs']:9}{row['observed_m2']:14.2e}{row['stated_m2']:12.2e}"
        for row in told["variogram"]
    ]
    return lines


def _number(value: float, width: int, digits: int = 2) -> str:
    return f"{value:{width}.{digits}f}" if math.isfinite(value) else " " * (width - 1) + "-"


def _measured(found: Told) -> list[str]:
    lines = [f"Precision of the scanner, from {' and '.join(found['scans'])}"]
    if "fault" in found:
        return [*lines, f"  {found['fault']}: name other scans"]
    if model := found["range"]:
        told = f"{model['typical_m'] * 1e3:.1f} mm ± {100 * model['typical_error']:.0f} %"
        if model["typical_error"] >= TRUSTED:
            told = "not told apart from that of the angles: every plane is seen too aslant or too far"
        elif model["rough"]:
            told = f"at most {told}: the ground is rough, scan walls or slabs more densely"
        lines.append(f"  range, {model['planes']} planes: {told}")
        if model["a_m"] > 0 and model["typical_error"] < TRUSTED:
            lines.append(f"    by intensity I: {model['a_m']:.2g} I^{model['b']:.2f} + {model['c_m']:.2g} m")
        angle_urad = model["sigma_angle_rad"] * 1e6
        lines.append(f"  angle on planes, with beam and roughness: {angle_urad:.1f} µrad")
    else:
        lines.append("  range: too few planes")
    for name, angle in (found["angles"] or {}).items():
        lines.append(
            f"  {name}, {angle['shots']} shots twice: {angle['precision_rad'] * 1e6:.2f} µrad; repeats differ"
            f" by {angle['observed_rad'] * 1e6:.1f}, of which sampling {angle['sampling_rad'] * 1e6:.1f}"
        )
    if found["angles"] is None:
        lines.append("  angles: no two scans with lines in common")
    if found["site_file"]:
        lines += ["", "For the site file:", _toml(found["site_file"]).strip()]
    return lines
