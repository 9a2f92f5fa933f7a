"""Versions of the reference: when one is due, and the tasks that build it in a worker process."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from station.archive.netcdf_layout import Series, roundtrip_text
from station.archive.reference_files import (
    ReferenceProvenance,
    open_reference,
    read_reference,
    read_reference_provenance,
    versions,
    write_reference,
)
from station.config import Site
from station.errors import StoreError
from station.inbox.file_hash import sha256_files
from station.inbox.listing import ScanFile
from station.processing.epoch_scalars import air_key, air_scalars
from station.processing.pipeline import (
    ScanAdjustment,
    add_blocks,
    grid_scan,
    mean_correction,
    new_gridder,
    reference_viewing_geometry,
    stacking_inputs,
)
from station.processing.provenance import ScanProvenance
from station.processing.scans.adjusted_scan import adjust_scan, load_viewing_geometry, stable_cells
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import open_scan_for
from station.processing.scans.scan_inputs import ScanInputs
from station.processing.site_files import exclusion_reason, series_for, sha256_log
from station.processing.workers.worker_process import Progress
from station.quantities import Floats, Reference, ScanGeometry, SharedParameters, VarianceComponents
from station.scan_names import scan_id, scan_stem
from station.science.adjustment.variance_components import estimate_variance_components
from station.science.gridding.gridder import Gridder
from station.science.gridding.reference_surface import (
    build_surface,
    centre_reference,
    mean_of_scans,
    update_reference,
)
from station.science.gridding.scan_stack import ScanStack
from station.science.gridding.viewing_geometry import ViewingGeometry
from station.science.gridding.viewpoints import seen_from_viewpoints
from station.science.uncertainty.propagation import condense_rows

UPDATE_FACTOR = 4  # each version needs four times the scans of the previous one
MAX_UPDATE_SCANS = 32  # scans read for one update
SURFACE_PASSES = 2  # the first from plain means, the second from residuals


def next_version(series: Series, referenced: Iterable[str | None]) -> str:
    """Return the next version number, above the existing ones and those that epochs refer to."""
    known = [*versions(series), *(version for version in referenced if version and version.isdigit())]
    return str(max((int(version) for version in known), default=0) + 1)


def scans_for_version(site: Site, usable: list[str], version_count: int) -> list[str]:
    """Return the names of the scans for the next version, as far as they are stored yet.

    `usable` are the usable scans in order of time, `version_count` is the number of versions on one base. The
    first version is built from the first scans. Later versions change it on stable ground only, so that
    epochs processed with an older version stay valid.
    """
    setting = site.reference.scans
    if isinstance(setting, Path) or (version_count and not site.adjusts):
        return []
    if not version_count:
        return usable[:setting]
    needed = scans_needed(site, version_count)
    return usable[:needed][:: max(1, needed // MAX_UPDATE_SCANS)][:MAX_UPDATE_SCANS]


def scans_needed(site: Site, version_count: int) -> int:
    """Return the number of usable scans required for the next version."""
    setting = site.reference.scans
    return 0 if isinstance(setting, Path) else setting * UPDATE_FACTOR**version_count


def build_reference_version(site: Site, scans: list[ScanFile], version: str, progress: Progress) -> str:
    """Build the reference surface from jointly adjusted scans and store it; return its version.

    The scans are processed in three passes. The first takes their plain means. The second adjusts each scan
    to that surface, and its mean residuals improve it. The third finds the mean residual in every cell, from
    which change is counted, and its variance. Each pass also re-estimates the variance components of the
    station.
    """
    _warm_cache(site, version, _build_and_store(site, scans, version, progress))
    return version


def _build_and_store(site: Site, scans: list[ScanFile], version: str, progress: Progress) -> ScanGeometry:
    """Build and store the reference; return the geometry of its scans."""
    surface: Reference | None = None
    for _ in range(SURFACE_PASSES):
        surface = _surface_pass(site, scans, surface, version, progress)
    assert surface is not None  # noqa: S101 - there is at least one pass
    stack, stacked = _stack_scans(site, scans, surface, progress, centred=True)
    geometry = stacked[-1].inputs.geometry
    components = _estimate_components(surface.components, stacked)
    reference = replace(
        centre_reference(surface, stack, geometry.position_m, components),
        shared=_errors_of_mean(stacked, components),
        sop_scan_count=_sop_scan_count(site, scans),
    )
    scan_provenance = tuple(scan.provenance.to_attrs() for scan in stacked)
    write_reference(
        series_for(site),
        _with_mean_state(reference, stacked),
        ReferenceProvenance(version, site.science_hash, scan_provenance=scan_provenance),
    )
    return geometry


def _surface_pass(
    site: Site, scans: list[ScanFile], surface: Reference | None, version: str, progress: Progress
) -> Reference:
    """Return the surface after one pass over the scans."""
    stack, stacked = _stack_scans(site, scans, surface, progress, centred=True)
    scan_ids = tuple(scan.provenance.scan_id for scan in stacked)
    components = _estimate_components(surface.components if surface else VarianceComponents(), stacked)
    shared, times_s = _errors_of_mean(stacked, components), _start_times(stacked)
    position_m = stacked[0].inputs.geometry.position_m
    built = build_surface(stack, surface, shared, position_m, version, scan_ids, times_s, components)
    return _with_mean_state(built, stacked)


def update_reference_version(
    site: Site,
    scans: list[ScanFile],
    version: str,
    base_version: str,
    replaces: tuple[str, ...],
    progress: Progress,
) -> str:
    """Store a version with stable ground and variance components estimated from more scans; return its name.

    It builds on `base_version` and supersedes the versions in `replaces`.
    """
    _warm_cache(site, version, _update_and_store(site, scans, version, base_version, replaces, progress))
    return version


def _update_and_store(
    site: Site,
    scans: list[ScanFile],
    version: str,
    base_version: str,
    replaces: tuple[str, ...],
    progress: Progress,
) -> ScanGeometry:
    """Compute and store the update; return the geometry of its scans."""
    series = series_for(site)
    base = read_reference(series, base_version)
    if base is None:
        raise StoreError(f"{series.folder}: no reference to update")
    stack, stacked = _stack_scans(site, scans, base, progress)
    components = _estimate_components(base.components, stacked)
    position_m = stacked[0].inputs.geometry.position_m
    if position_m is None:
        raise StoreError(f"{series.folder}: a reference without scanner position cannot be updated")
    provenance = ReferenceProvenance(
        base=read_reference_provenance(series, base_version).base,
        science_hash=site.science_hash,
        replaces=replaces,
        scan_provenance=tuple(scan.provenance.to_attrs() for scan in stacked),
    )
    updated = update_reference(base, stack, position_m, version, components)
    write_reference(series, _with_mean_state(updated, stacked), provenance)
    return stacked[-1].inputs.geometry


@dataclass(frozen=True)
class _StackedScan:
    """Inputs, adjustment and provenance of a scan that was added to a stack."""

    inputs: ScanInputs
    adjustment: ScanAdjustment | None
    provenance: ScanProvenance


def _stack_scans(
    site: Site, scans: list[ScanFile], surface: Reference | None, progress: Progress, *, centred: bool = False
) -> tuple[ScanStack, list[_StackedScan]]:
    """Return a stack of scans, adjusted to a surface if there is one, and the scans in it.

    With `centred` the mean of their corrections is not applied: what scans that define the surface have in
    common is not an error of any. Without a surface all scans are gridded as one: only together they tell
    ground from echoes of the air.
    """
    stack, geometry_cache, shared = ScanStack(site.grid_cells), _GeometryCache(site, surface), list[Gridder]()
    stacked = [_add_scan(stack, site, scan, geometry_cache, shared, progress) for scan in scans]
    for gridder in shared:
        gridder.finish()
        stack.add(gridder)
    viewing = geometry_cache(stacked[-1].inputs.geometry)
    if centred and viewing is not None:
        stack.shift(mean_correction(viewing, [scan.adjustment for scan in stacked if scan.adjustment]))
    return stack, stacked


def _warm_cache(site: Site, version: str, geometry: ScanGeometry) -> None:
    """Compute and cache the viewing geometry of the new version before the next scan needs it."""
    reference = open_reference(series_for(site), version)
    if reference is not None:
        load_viewing_geometry(site, geometry, reference)


def _start_times(stacked: list[_StackedScan]) -> Floats:
    """Return the starts of scans (n,) [s since 1970]."""
    return np.array([scan.provenance.start_s for scan in stacked])


def _errors_of_mean(stacked: list[_StackedScan], components: VarianceComponents) -> SharedParameters | None:
    """Return the errors that all cells of a reference share, by the variance components of its scans."""
    posteriors = (scan.inputs.log_only_shared(components) for scan in stacked)
    return mean_of_scans(posteriors, _start_times(stacked))


def _with_mean_state(reference: Reference, stacked: list[_StackedScan]) -> Reference:
    """Return a reference with the mean state of the scanner in its scans, from where beams are said to move.

    The same reference without adjustments, and if the scanner was relocated between the scans.
    """
    shared, adjustments = reference.shared, [scan.adjustment.state for scan in stacked if scan.adjustment]
    if shared is None or not adjustments or any(a.params.names != shared.names for a in adjustments):
        return reference
    estimate = np.mean([adjustment.estimate for adjustment in adjustments], axis=0)
    estimate = condense_rows(adjustments[0].params, estimate[:, None])[:, 0]
    return replace(reference, shared=replace(shared, estimate=estimate))


def _sop_scan_count(site: Site, scans: list[ScanFile]) -> int | None:
    """Return how many scans an SOP was determined from; None if tilt does not count from that of a scan."""
    if site.inclination is None or site.inclination.mode == "absolute" or site.registration is not None:
        return None
    named = {sop.scan for sop in site.sop if sop.scan is not None}
    if not named:
        return 1  # the first one
    return sum(bool(named & {scan.name, scan_stem(scan.name)}) for scan in scans)


def _estimate_components(components: VarianceComponents, stacked: list[_StackedScan]) -> VarianceComponents:
    """Return the variance components estimated from the adjusted scans."""
    adjusted = (
        (adjustment.inputs.lines, adjustment.state.estimate, adjustment.state.covariance)
        for adjustment in (scan.adjustment for scan in stacked)
        if adjustment is not None
    )
    adjustment_inputs = stacked[0].inputs.adjustment_inputs
    return (
        components
        if adjustment_inputs is None
        else estimate_variance_components(components, adjustment_inputs.params, adjusted)
    )


class _GeometryCache:
    """Viewing geometry of a surface, recomputed only if the scanner moved."""

    def __init__(self, site: Site, surface: Reference | None) -> None:
        self._site = site
        self._surface = surface
        self._last: tuple[ScanGeometry, ViewingGeometry] | None = None

    def __call__(self, geometry: ScanGeometry) -> ViewingGeometry | None:
        """Return the viewing geometry for a scan geometry, None if there is no surface yet."""
        if self._surface is None:
            return None
        geometry = replace(geometry, viewpoints=())  # one is missing in some scans
        if self._last is None or self._last[0] != geometry:
            stable = stable_cells(self._site, self._surface)
            self._last = geometry, reference_viewing_geometry(self._surface, geometry, stable)
        return self._last[1]


def _add_scan(
    stack: ScanStack,
    site: Site,
    scan: ScanFile,
    geometry_cache: _GeometryCache,
    shared: list[Gridder],
    progress: Progress,
) -> _StackedScan:
    """Add a scan, adjusted to the surface, to a stack; the grid of the scan is released.

    Without a surface, add it to the grid in `shared`, which its first scan creates.
    """
    with open_scan_for(site, scan) as opened:
        start, end = opened.start, opened.end
        inputs = load_scan_inputs(site, opened)
        viewing = geometry_cache(inputs.geometry)
        geometry = inputs.geometry if viewing else replace(inputs.geometry, viewpoints=())  # any number
        gridder = shared[0] if shared else new_gridder(geometry, viewing)
        blocks = inputs.shots(opened, site.scans.intensity)
        (add_blocks if viewing is None else grid_scan)(gridder, blocks, inputs.pose, progress)
    if viewing is not None:
        viewing = seen_from_viewpoints(viewing, gridder, inputs.geometry)
    adjustment = adjust_scan(site, gridder, inputs, viewing)
    if viewing is None:
        shared[:] = [gridder]
    else:
        stack.add(gridder, stacking_inputs(gridder, viewing, adjustment), viewing.reference.roughness_m2)
    progress()
    provenance = ScanProvenance(
        scan_id=scan_id(scan.name),
        start_s=start.timestamp(),
        end_s=end.timestamp(),
        scan_sha256=sha256_files(scan.paths),
        log_sha256=sha256_log(scan),
        sop_id=roundtrip_text(inputs.provenance.get("sop_id", ""), "text"),
        sop_tilt_offset=inputs.provenance.get("sop_tilt_offset", ""),
        flag=exclusion_reason(site, start.timestamp(), end.timestamp()),
        air=air_key(air_scalars(inputs)),
        registration_sha256=sha256_files(scan.matrices),
    )
    return _StackedScan(inputs, adjustment, provenance)
