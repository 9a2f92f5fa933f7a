"""Gridding of one scan and its adjustment to the reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from station.archive.geometry_cache import cached_viewing_geometry
from station.config import Site
from station.errors import ScanError
from station.processing.pipeline import (
    ScanAdjustment,
    adjust_to_reference,
    grid_scan,
    new_gridder,
    reference_viewing_geometry,
)
from station.processing.scans.open_scans import OpenScan
from station.processing.scans.scan_inputs import ScanInputs
from station.processing.site_files import polygon_cells, series_for, site_file_sha256
from station.processing.workers.worker_process import Progress, trim_heap
from station.quantities import Bools, Reference, ScanGeometry
from station.science.analysis.inclination_check import LogCheck, check_log
from station.science.gridding.gridder import Gridder
from station.science.gridding.viewing_geometry import ViewingGeometry
from station.science.gridding.viewpoints import seen_from_viewpoints

# Estimated rotation that the points of a scan may lack, 0.35 m at 1 km; beyond, they are gridded again.
MAX_UNAPPLIED_RAD = np.radians(0.02)
UNUSABLE_REJECTED_SHARE = 0.6  # of the stable ground; above it the filtered log alone is safer


@dataclass(frozen=True)
class AdjustedScan:
    """A gridded scan with its adjustment to the reference, if there is one.

    `inputs` have the pose, and `viewing` the variances of shots, with which it was gridded and adjusted.
    `log_check` is None without a log, and without a usable adjustment.
    """

    inputs: ScanInputs
    viewing: ViewingGeometry | None
    gridder: Gridder
    point_count: int
    adjustment: ScanAdjustment | None
    log_check: LogCheck | None = None


def grid_and_adjust(
    site: Site, opened: OpenScan, inputs: ScanInputs, viewing: ViewingGeometry | None, progress: Progress
) -> AdjustedScan:
    """Return a scan on the grid, adjusted to the reference as `viewing` shows it.

    If the ground shows that the clock of the inclination log is off, the log is corrected, and the scan
    adjusted again. If the ground contradicts the log, it is gridded and adjusted again as if there were none:
    its tilt, where the SOP contains that of the mount, is not applied.
    Raises ScanError if no point falls on the grid.
    """
    scan = _with_log_checked(_adjusted(site, opened, inputs, viewing, progress))
    check = scan.log_check
    if check is not None and check.clock_offset is not None and check.clock_offset.warnings():
        offset_s, sigma_s = check.clock_offset.offset_s, check.clock_offset.sigma_s
        corrected = scan.inputs.with_clock_offset(offset_s, sigma_s)
        adjustment = adjust_scan(site, scan.gridder, corrected, scan.viewing)
        second = _with_log_checked(replace(scan, inputs=corrected, adjustment=adjustment, log_check=None))
        if second.log_check is not None and not second.log_check.warnings:
            return second
    if check is not None and check.warnings:
        del scan  # the memory of a worker does not hold two gridded scans
        keep_tilt = site.inclination is not None and site.inclination.mode == "absolute"
        scan = _adjusted(site, opened, inputs.without_log(keep_tilt=keep_tilt), viewing, progress)
        trim_heap()
        return replace(scan, log_check=check)
    return scan


def _with_log_checked(scan: AdjustedScan) -> AdjustedScan:
    """Return a scan with the check of its log, if it was adjusted with one."""
    if scan.adjustment is None or scan.viewing is None or scan.inputs.is_given:
        return scan
    if not is_usable(scan.adjustment):
        return scan
    check = check_log(scan.adjustment.inputs.lines, scan.adjustment.state, scan.viewing.reference)
    trim_heap()
    return replace(scan, log_check=check)


def _adjusted(
    site: Site, opened: OpenScan, inputs: ScanInputs, viewing: ViewingGeometry | None, progress: Progress
) -> AdjustedScan:
    """Return a scan on the grid, adjusted to the reference with the inclination log of its inputs, if any.

    If the scanner turned so far that its points lie beside the ground they hit, as after a season, they are
    gridded a second time, at the estimated pose: ground does not respond to a motion of the beams as the
    slope of the reference tells, so that the first estimate is off.
    """

    def gridded(inputs: ScanInputs) -> tuple[Gridder, int]:
        blocks = inputs.shots(opened, site.scans.intensity if site.adjusts else "none")  # decodes
        gridder = new_gridder(inputs.geometry, viewing)
        return gridder, grid_scan(gridder, blocks, inputs.pose, progress)

    gridder, count = gridded(inputs)
    if gridder.is_empty():
        raise ScanError("no point falls on the grid: wrong scans.frame, SOP, CRS or units?")
    progress()
    if viewing is not None:
        viewing = seen_from_viewpoints(viewing, gridder, inputs.geometry)
    first = adjust_scan(site, gridder, inputs, viewing, even_if_given=True)
    if first is None or not inputs.can_rotate or not is_usable(first):
        return AdjustedScan(inputs, viewing, gridder, count, first)
    unapplied_rad = first.state.unapplied_rad
    if np.linalg.norm(unapplied_rad) <= MAX_UNAPPLIED_RAD:
        return AdjustedScan(inputs, viewing, gridder, count, first)
    del gridder  # as above
    rotated = inputs.rotated(unapplied_rad)
    gridder, count = gridded(rotated)
    second = adjust_scan(site, gridder, rotated, viewing)
    if second is not None and is_usable(second):
        return AdjustedScan(rotated, viewing, gridder, count, second)
    del gridder
    return AdjustedScan(inputs, viewing, *gridded(inputs), first)


def is_usable(adjustment: ScanAdjustment) -> bool:
    """Return True unless so much stable ground was rejected that the filtered log alone is safer."""
    return adjustment.state.rejected_share <= UNUSABLE_REJECTED_SHARE


def adjust_scan(
    site: Site,
    gridder: Gridder,
    inputs: ScanInputs,
    viewing: ViewingGeometry | None,
    *,
    even_if_given: bool = False,
) -> ScanAdjustment | None:
    """Return the adjustment of a scan to the reference; None if it is disabled or there is no reference.

    Also None if its registration is given, unless `even_if_given`.
    """
    if inputs.is_given and not even_if_given:
        return None
    if not site.adjusts or inputs.adjustment_inputs is None or viewing is None:
        return None
    adjustment = adjust_to_reference(gridder, inputs.geometry, inputs.adjustment_inputs, viewing)
    trim_heap()
    return adjustment


def load_viewing_geometry(site: Site, geometry: ScanGeometry, reference: Reference) -> ViewingGeometry:
    """Return the viewing geometry of a stored reference version, cached for one scan geometry."""
    setting = site.adjustment.stable
    polygon_hash = site_file_sha256(setting) if isinstance(setting, Path) and setting.is_file() else ""
    return cached_viewing_geometry(
        series_for(site),
        reference,
        (geometry.position_m, geometry.axis),
        repr((geometry.grid, geometry.scanner, geometry.published_budget, site.grid_crs, polygon_hash)),
        lambda: reference_viewing_geometry(reference, geometry, stable_cells(site, reference)),
    )


def stable_cells(site: Site, reference: Reference) -> Bools:
    """Return the stable cells (ny, nx): those in the polygons of the site, else those of the reference."""
    setting = site.adjustment.stable
    return polygon_cells(setting, site) if isinstance(setting, Path) else reference.stable
