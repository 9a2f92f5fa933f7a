"""Processing of one scan, from the inbox into the archive; the tasks run in a worker process.

The last argument of a task is `progress()`, which reports to the parent process that the worker is alive.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from station._version import __version__
from station.archive import epochs
from station.archive.netcdf_layout import Series, roundtrip_text
from station.archive.reference_files import open_reference, valid_versions, write_reference
from station.config import Site
from station.errors import ScanError
from station.inbox.file_hash import hash_if_unchanged, sha256_file, sha256_files
from station.inbox.journal_reader import JournalReader
from station.inbox.listing import ScanFile
from station.processing.epoch_recorder import EpochRecorder
from station.processing.epoch_scalars import air_key, log_metrics, scalar_variables
from station.processing.pipeline import holdout_statistics, measure, no_brightness, usual_motion
from station.processing.scans.adjusted_scan import grid_and_adjust, is_usable, load_viewing_geometry
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import open_scan_for
from station.processing.scans.registration import registration_difference
from station.processing.scans.scan_errors import scan_errors
from station.processing.site_files import (
    exclusion_reason,
    file_version,
    series_for,
    sha256_log,
)
from station.processing.usable_inputs import usable_site
from station.processing.workers.worker_process import Progress, trim_heap
from station.products.overview import Overview
from station.quantities import Reference, VarianceComponents
from station.queries.epoch_cells import LEVERAGE_VARIABLES
from station.readers.raster import read_geotiff
from station.readers.scan import reject_future
from station.scan_names import scan_id
from station.science.adjustment import ground_classes
from station.science.analysis import verdict
from station.science.geometry.terrain import nodes_from_means


@dataclass(frozen=True)
class StoredResult:
    """Result of a scan that was stored."""

    start_utc_s: float
    sha256: str
    epoch: str  # relative to the data folder
    revision: int
    verdict: str
    reason: str
    reference: str | None
    metrics: dict[str, float | str]
    log_sha256: str
    epoch_sha256: str  # of the epoch file
    overview: Overview | None = None  # for the page; if None, the page reads it from the store


@dataclass(frozen=True)
class ScanHistory:
    """What the journal knows about a scan from earlier processing and about other scans, and the time."""

    reference: str | None = None  # version the scan was processed with
    revision: int = 0
    last_content: tuple[str, str] | None = None  # SHA-256 of scan and log last assessed under its name
    stored_scans: Mapping[str, str] = field(default_factory=dict)  # names of other stored scans by SHA-256
    wait_for_weather: bool = False  # if the weather log is not up to date yet
    waiting_before: str = ""  # name of an earlier scan that will be processed soon
    now_s: float = field(default_factory=time.time)  # a scan that begins later is in the future


@dataclass(frozen=True)
class Duplicate:
    """A scan whose content was already assessed under `name`."""

    name: str
    sha256: str


@dataclass(frozen=True)
class Rejected:
    """A scan that cannot be used."""

    reason: str
    sha256: str
    log_sha256: str


def process_new(
    site: Site, scan: ScanFile, history: ScanHistory, progress: Progress
) -> StoredResult | Duplicate | Rejected:
    """Process a new scan unless its content was already assessed; raises as `process`."""
    sha256 = sha256_files(scan.paths) if history.last_content or history.stored_scans else ""
    if history.last_content == (sha256, sha256_log(scan)):
        return Duplicate(scan.name, sha256)
    if sha256 in history.stored_scans:
        return Duplicate(history.stored_scans[sha256], sha256)
    progress()
    return reprocess_scan(site, scan, history, progress, with_preview=site.products.page)


def reprocess_scan(
    site: Site, scan: ScanFile, history: ScanHistory, progress: Progress, *, with_preview: bool = False
) -> StoredResult | Rejected:
    """Process a scan even if its content is known, with the reference version used before."""
    try:
        return process(site, scan, progress, history=history, with_preview=with_preview)
    except ScanError as error:
        are_files = all(path.is_file() and not path.is_symlink() for path in scan.paths)
        return Rejected(
            str(error), sha256_files(scan.paths) if are_files else "", sha256_log(scan) if are_files else ""
        )


def process(
    site: Site,
    scan: ScanFile,
    progress: Progress,
    *,
    history: ScanHistory | None = None,
    with_preview: bool = False,
) -> StoredResult:
    """Process a scan and store its epoch, unless an identical one is stored; record a preview if asked to.

    Raises ScanError if the scan cannot be used. Raises NotReadyError if it changes meanwhile, begins in the
    future, or has no weather yet and is to wait for it.
    """
    began_s, history = time.monotonic(), history or ScanHistory()
    series = series_for(site)
    with hash_if_unchanged(scan.paths) as scan_sha256:
        progress()
        reference = load_reference(site, history.reference)
        epoch = _compute_epoch(site, scan, scan_sha256, reference, history, progress)
    del reference
    trim_heap()
    if not history.revision:
        _require_new_start(site, epoch.start_s)
    version, epoch_file = epoch.provenance["reference_version"], _identical_epoch(series, epoch)
    recorder = EpochRecorder(site, series, "" if epoch_file else version, with_preview=with_preview)
    if epoch_file is None:
        epoch_file = epochs.write_epoch(series, epoch, history.revision, recorder.add)
        recorder.keep(epoch_file.path)
    return StoredResult(
        start_utc_s=epoch.start_s,
        sha256=scan_sha256,
        epoch=str(epoch_file.path.relative_to(series.folder)),
        revision=epoch_file.revision,
        verdict=epoch.verdict,
        reason=epoch.verdict_reason,
        reference=version or None,
        metrics=log_metrics(epoch, time.monotonic() - began_s),
        log_sha256=epoch.provenance["log_sha256"],
        epoch_sha256=sha256_file(epoch_file.path),
        overview=recorder.overview,
    )


def _require_new_start(site: Site, start_utc_s: float) -> None:
    """Raise ScanError if a scan of another name with the same start is stored: it would be replaced."""
    with JournalReader(site.station.data / "journal.sqlite") as journal:
        stored = journal.starting_at(start_utc_s)
    if stored:
        start = datetime.fromtimestamp(start_utc_s, UTC)
        raise ScanError(
            f"begins at {start:%Y-%m-%d %H:%M:%S} UTC, as {stored[0]} does, which is stored: a series has one"
            f" scan per start; to replace that one, copy this file over it"
        )


def check_header(site: Site, scan: ScanFile, progress: Progress) -> None:
    """Raise ScanError if the headers of a scan show that it cannot be used."""
    progress()
    with open_scan_for(site, scan):
        return


def dry_run(site: Site, scan: ScanFile, progress: Progress) -> tuple[str, str, dict[str, float | str]]:
    """Return verdict, reason and metrics of a scan; nothing is stored."""
    began_s, site = time.monotonic(), usable_site(site)
    reference = None if isinstance(site.reference.scans, Path) else load_reference(site)
    epoch = _compute_epoch(site, scan, "", reference, ScanHistory(), progress, is_dry_run=True)
    return epoch.verdict, epoch.verdict_reason, log_metrics(epoch, time.monotonic() - began_s)


def _compute_epoch(
    site: Site,
    scan: ScanFile,
    scan_sha256: str,
    reference: Reference | None,
    history: ScanHistory,
    progress: Progress,
    *,
    is_dry_run: bool = False,
) -> epochs.Epoch:
    with open_scan_for(site, scan) as opened:
        start, end = opened.start, opened.end
        reject_future(start, history.now_s)
        inputs = load_scan_inputs(
            site,
            opened,
            save_tilt_offset=not is_dry_run,
            wait_for_weather=history.wait_for_weather,
            waiting_before=history.waiting_before,
        )
        viewing = load_viewing_geometry(site, inputs.geometry, reference) if reference else None
        progress()
        scan_on_grid = grid_and_adjust(site, opened, inputs, viewing, progress)
        inputs, viewing, gridder = scan_on_grid.inputs, scan_on_grid.viewing, scan_on_grid.gridder
        point_counts, adjustment = (opened.point_count, scan_on_grid.point_count), scan_on_grid.adjustment
    brightness_fault = no_brightness(gridder, inputs.geometry, viewing) if site.adjusts else ""
    flag = exclusion_reason(site, start.timestamp(), end.timestamp())
    attempt = adjustment.state if adjustment else None
    registration, registration_warnings = registration_difference(site, scan, attempt)
    if adjustment is not None and (inputs.is_given or not is_usable(adjustment)):
        adjustment = None
    components = usual_motion(reference, start.timestamp()) if reference else VarianceComponents()
    errors = scan_errors(inputs, gridder, viewing, adjustment, components)
    stored_parameters = errors.stored_parameters(viewing)
    log_check = scan_on_grid.log_check
    measurement = measure(
        gridder, inputs.geometry, errors.shared, viewing, adjustment, errors.factors, errors.positions
    )
    progress()
    scalars = scalar_variables(measurement, inputs, *point_counts)
    scalars["rejected_echo_share"] = gridder.rejected_echo_share
    scalars["airborne_echo_share"] = gridder.airborne_echo_share
    if adjustment is not None and viewing is not None:
        scalars |= holdout_statistics(measurement, viewing) | {"change_step": adjustment.state.change_size_m}
        scalars |= {
            "random_variance_factor": errors.factors.median_random,
            "systematic_variance_factor": errors.factors.systematic,
        }
        scalars |= dict(zip(LEVERAGE_VARIABLES, adjustment.state.leverage_m2, strict=True))
    if log_check is not None and log_check.clock_offset is not None:
        scalars["log_clock_offset"] = log_check.clock_offset.offset_s
        scalars["log_clock_offset_uncertainty"] = log_check.clock_offset.sigma_s
    if errors.positions is not None:
        scalars["position_count"] = float(len(errors.positions.baseline_m))
    verdict_name, reason = verdict.assess(
        flag,
        [*inputs.warnings, *(log_check.warnings if log_check else ()), *registration_warnings],
        measurement,
        viewing,
        attempt,
        scalars.get("stable_z_std", 0.0) if adjustment else None,
        inputs.faults,
        no_brightness=brightness_fault,
        airborne_echo_share=gridder.airborne_echo_share,
        usual=components,
    )
    return epochs.Epoch(
        start_s=start.timestamp(),
        end_s=end.timestamp(),
        scan_id=scan_id(scan.name),
        measurement=measurement,
        shared=stored_parameters,
        redundancy=adjustment.state.redundancy if adjustment else None,
        verdict=verdict_name,
        verdict_reason=reason,
        scalars=scalars | registration,
        provenance={
            "scan_sha256": scan_sha256,
            "log_sha256": sha256_log(scan),
            "registration_sha256": sha256_files(scan.matrices),
            "flag": flag,
            "science_hash": site.science_hash,
            "reference_version": reference.version if reference else "",
            "adjustment": "joint" if adjustment else "none",
            "software_version": __version__,
            **inputs.provenance,
        },
    )


def _identical_epoch(series: Series, epoch: epochs.Epoch) -> epochs.EpochFile | None:
    """Return the stored epoch of this start if it has the same inputs and settings, else None.

    A scan whose epoch was written just before a power cut is therefore not stored twice.
    """
    revisions = epochs.revisions(series, datetime.fromtimestamp(epoch.start_s, UTC))
    if not revisions:
        return None
    provenance = epochs.read_provenance(revisions[-1].path)
    expected = {
        **epoch.provenance,
        "scan_id": epoch.scan_id,
        "verdict": epoch.verdict,
        "verdict_reason": roundtrip_text(epoch.verdict_reason, "sentence"),
    }
    is_same = all(provenance.get(key) == value for key, value in expected.items() if key in provenance)
    return (
        revisions[-1] if is_same and epochs.read_air(revisions[-1].path) == air_key(epoch.scalars) else None
    )


def load_reference(site: Site, version: str | None = None) -> Reference | None:
    """Return the reference surface: `version` if it is still valid, else the newest.

    A reference given as a file is imported into the store on first use.
    """
    series = series_for(site)
    setting = site.reference.scans
    if not isinstance(setting, Path):
        versions = valid_versions(series)
        newest = list(versions)[-1] if versions else None
        return open_reference(series, version if version in versions else newest)
    reference = open_reference(series)
    version = file_version(setting)
    if reference is None or reference.version != version:
        elevation_m = nodes_from_means(read_geotiff(setting, series.grid, series.crs))
        snow_free = ground_classes.holds_no_snow(elevation_m, series.grid)
        write_reference(series, Reference.from_elevation(series.grid, version, elevation_m, snow_free))
        reference = open_reference(series)
    return reference
