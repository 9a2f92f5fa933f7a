"""Inputs of a scan other than its shots: SOP, tilt, air; and warnings about what is missing."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

import numpy as np

from station.archive.tilt_offsets import read_tilt_offset, stored_tilt_offsets, write_tilt_offset
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.processing.pipeline import AdjustmentInputs, Pose, to_map
from station.processing.scan_air import air_of_scan
from station.processing.scanner_pose import (
    map_position,
    scan_geometry,
    scanner_to_map,
    sop_identity,
)
from station.processing.scans.open_scans import OpenScan, PositionScan, open_files
from station.processing.scans.registration import (
    CovarianceOf,
    is_given,
    registered_covariance,
    registration,
)
from station.processing.scans.scan_files import find_in_inbox
from station.quantities import (
    Air,
    AzimuthTrack,
    Floats,
    InclinationLog,
    IntensityScale,
    ScanGeometry,
    SharedParameters,
    Shots,
    VarianceComponents,
)
from station.readers.inclination import align_gps_week, read_inclination
from station.readers.scan import ScanReader
from station.scan_names import scan_stem
from station.science.adjustment import prior
from station.science.geometry import inclination
from station.science.geometry.air import air_correction
from station.science.geometry.inclination import NO_CYCLIC_ERROR, CyclicError, TiltRecord
from station.science.uncertainty import parameters
from station.science.uncertainty.propagation import with_errors_of_positions
from station.sections.inputs import SopSection

MEAN_TILT = "one mean tilt for the whole scan"
MIN_LOG_COVERAGE = 0.97  # of the scan duration that a complete log covers
MIN_LOG_ROWS = 20  # a shorter log is not filtered
MIN_ABSOLUTE_LOG_S = 60.0  # of a scan whose static tilt is known from its log alone
MAX_SATURATED = 0.1  # of the rows of a log, at the limit of the sensor's range
MIN_CLOCK_OFFSET_S = 4.0  # clock offset of a log, and its significance, that lead to a warning
MIN_CLOCK_OFFSET_SIGMAS = 3.0


@dataclass(frozen=True)
class ScanInputs:
    """Inputs of a scan that are known before its shots are read."""

    geometry: ScanGeometry
    pose: Pose
    log_only_covariance: CovarianceOf | None
    adjustment_inputs: AdjustmentInputs | None
    tilt_record: TiltRecord | None
    air: Air | None
    warnings: tuple[str, ...]
    provenance: dict[str, str]
    faults: tuple[str, ...] = ()  # that make the scan unusable
    position_poses: tuple[Pose, ...] = ()  # of several positions, whose shots come on the map
    is_given: bool = False  # by the owner's registration, which is not to be changed

    def shots(self, scan: OpenScan, intensity: IntensityScale) -> Iterator[Shots]:
        """Yield the shots of a scan, to be placed by `pose`; decoding starts with this call."""
        if not self.position_poses:
            return scan.positions[0].reader.blocks(intensity=intensity)
        return self._shots_on_map(scan, intensity)

    def _shots_on_map(self, scan: OpenScan, intensity: IntensityScale) -> Iterator[Shots]:
        for number, (position, pose) in enumerate(zip(scan.positions, self.position_poses, strict=True)):
            for shots in position.reader.blocks(intensity=intensity):
                yield Shots(to_map(shots, pose), shots.time_s, shots.intensity, number)

    @property
    def can_rotate(self) -> bool:
        """True if all points have the same pose, which an adjustment may change."""
        return self.pose.frame is not None and not self.position_poses and not self.is_given

    def rotated(self, rotation_rad: Floats) -> ScanInputs:
        """Return the inputs with a further rotation (3,) of all points about east, north and up [rad]."""
        assert self.adjustment_inputs is not None  # noqa: S101 - the scan was adjusted
        assumed_rad = self.adjustment_inputs.assumed_rad + rotation_rad[:, None]
        return replace(
            self,
            pose=self.pose.rotated(rotation_rad),
            adjustment_inputs=replace(self.adjustment_inputs, assumed_rad=assumed_rad),
        )

    def with_errors_of_positions(
        self, shared: SharedParameters, components: VarianceComponents
    ) -> SharedParameters:
        """Return adjusted parameters with what several positions do not have in common, if there are any."""
        positions_m = [pose.frame.position_m for pose in self.position_poses if pose.frame is not None]
        if len(positions_m) < 2:
            return shared
        usual_motion = prior.globals_sigma(components, weather_known=True)[:7]
        return with_errors_of_positions(shared, usual_motion, np.array(positions_m))

    def log_only_shared(self, components: VarianceComponents) -> SharedParameters | None:
        """Return the systematic errors of all points without an adjustment, from SOP and log."""
        return self.log_only_covariance(components) if self.log_only_covariance else None


def position_inputs(
    site: Site,
    position: PositionScan,
    *,
    save_tilt_offset: bool,
    wait_for_weather: bool,
    waiting_before: str,
) -> ScanInputs:
    """Return the inputs of what was scanned from one position; raises as `load_scan_inputs`."""
    reader, start, end, sop = position.reader, position.start, position.end, position.sop
    site = site.with_scanner_of(sop)
    transform, sop_id = scanner_to_map(site, sop), sop_identity(sop)
    warnings: list[str] = []
    registered = registration(site, position, warnings)
    track = reader.azimuth_track() if site.scans.point_time == "auto" else None
    if track is None and site.scans.point_time == "auto":
        has_time = reader.time_range_s() is not None
        cause = "azimuth does not follow time" if has_time else "no time per point"
        warnings.append(f"{cause}: {MEAN_TILT}")
    rotation = transform.to_local[:3, :3]
    log = _load_log(site, position.logs, reader, track, rotation, warnings)
    faults = _static_tilt_faults(site, log) if registered is None else ()
    if registered is not None:  # it contains the mean tilt of the scan
        tilt_offset = _own_tilt_offset(site, log, track)
    else:
        tilt_offset = read_tilt_offset(site, sop_id)
    if tilt_offset is None and registered is None:
        tilt_offset = stored_tilt_offsets(site).get(sop_id)
        if tilt_offset is None:
            tilt_offset = _find_tilt_offset(site, position, log, track, warnings, waiting_before)
        # That of an absolute sensor is zero and need not be saved.
        if save_tilt_offset and tilt_offset is not None and tilt_offset != NO_CYCLIC_ERROR:
            write_tilt_offset(site, sop_id, tilt_offset)
    tilt_record = _tilt_record(site, log, track, tilt_offset, warnings)
    air, weather_known = air_of_scan(site, start + (end - start) / 2, transform.position_m[2], warnings)
    axis = (float(rotation[0, 2]), float(rotation[1, 2]), float(rotation[2, 2]))
    geometry = scan_geometry(site, transform.position_m, axis)
    if wait_for_weather and site.weather is not None and not weather_known:
        raise NotReadyError(next(warning for warning in warnings if warning.startswith("weather")))
    params = parameters.parameter_layout(geometry.grid, transform.position_m, axis)
    lines = prior.line_times(params, rotation, track)
    assumed_rad, line_inclination = np.zeros((3, params.line_groups)), None
    if tilt_record is not None:
        assumed_rad = prior.tilt_rotation(tilt_record.tilt, rotation, lines.time_s)
        if track is not None and registered is None:
            line_inclination = prior.line_inclination(
                params, lines, tilt_record, tilt_offset or NO_CYCLIC_ERROR, rotation
            )
    placed = transform if registered is None else registered
    if site.air is not None:
        setting = site.air.scanner_setting
        assumed_air = air if setting == "weather" else setting.air
        correction = air_correction(
            air, assumed_air if site.air.scanner_corrects else None, site.instrument.wavelength_um
        )
        placed = placed.with_correction(correction.apply, site.scanner.range_max_m)
    sop_offset = tilt_offset if registered is None else None
    provenance = {"sop_id": sop_id, "sop_tilt_offset": json.dumps(asdict(sop_offset)) if sop_offset else ""}
    tilt = tilt_record.tilt if tilt_record is not None else None
    covariance = partial(
        prior.log_only_covariance,
        params,
        lines,
        tilt_record,
        tilt_offset or NO_CYCLIC_ERROR,
        weather_known=weather_known,
    )
    return ScanInputs(
        geometry,
        Pose(placed, tilt),
        covariance if registered is None else registered_covariance(site, covariance),
        AdjustmentInputs(
            params, lines, assumed_rad, line_inclination, start.timestamp(), weather_known=weather_known
        ),
        tilt_record,
        air if weather_known else None,
        tuple(warnings),
        provenance,
        faults,
        is_given=registered is not None and is_given(site),
    )


def _own_tilt_offset(
    site: Site, log: InclinationLog | None, track: AzimuthTrack | None
) -> CyclicError | None:
    """Return the tilt of the scan itself, None without a log."""
    return None if log is None else _fit_tilt_offset(log, track, site.instrument.inclination_sigma_rad)


def inputs_in_map_frame(site: Site, start_s: float) -> ScanInputs:
    """Return the inputs of a scan that is already on the map."""
    position_m = map_position(site)
    geometry, adjustment_inputs = scan_geometry(site, position_m), None
    log_only_covariance: CovarianceOf | None = None
    if position_m is not None:  # registered elsewhere, with unknown accuracy
        params = parameters.parameter_layout(geometry.grid, position_m)
        lines = prior.line_times(params, np.eye(3), None)
        adjustment_inputs = AdjustmentInputs(
            params, lines, np.zeros((3, params.line_groups)), None, start_s, weather_known=False
        )
        log_only_covariance = partial(
            prior.log_only_covariance,
            params,
            lines,
            None,
            NO_CYCLIC_ERROR,
            weather_known=False,
        )
        if site.registration is not None:
            log_only_covariance = registered_covariance(site, log_only_covariance)
    return ScanInputs(
        geometry,
        Pose(None, None),
        log_only_covariance,
        adjustment_inputs,
        None,
        None,
        (),
        {},
        is_given=is_given(site),
    )


def _converted_log(site: Site, reader: ScanReader) -> tuple[Path, ...]:
    """Return the inclination log that the command which converted a scan wrote next to it; () without."""
    if site.scans.convert is None or site.inclination is None:
        return ()
    path = reader.path.with_name(scan_stem(reader.path) + site.inclination.suffix)
    return (path,) if path.is_file() else ()


def _load_log(
    site: Site,
    paths: Sequence[Path],
    reader: ScanReader,
    track: AzimuthTrack | None,
    rotation: Floats,
    warnings: list[str],
) -> InclinationLog | None:
    """Return the cleaned inclination log of a scan, or None; append what is wrong with it to `warnings`.

    `rotation` (3, 3) of the SOP contains the tilt of the mount, which shows whether the axes are right.
    """
    if site.inclination is None:
        return None
    try:
        raw = _raw_log(site, paths, reader)
        if raw is None:
            if site.inclination.required:
                warnings.append("inclination log missing")
            return None
        log = _clean_log(site, raw, warnings)
    except ScanError as error:
        warnings.append(f"inclination log unusable: {error}")
        return None
    if log is None:
        return None
    warnings += inclination.axes_warnings(log, rotation)
    if track is None:
        return log
    log = align_gps_week(log, float(track.time_s[0]))
    return log if _overlaps(site, log, track, warnings) else None


def _raw_log(site: Site, paths: Sequence[Path], reader: ScanReader) -> InclinationLog | None:
    """Return the log of files, in order of their times, else the one that the points carry; None without."""
    paths = paths or _converted_log(site, reader)
    return inclination.joined([read_inclination(path) for path in paths]) if paths else reader.inclination()


def _clean_log(site: Site, raw: InclinationLog, warnings: list[str]) -> InclinationLog | None:
    """Return the valid rows of a log; None if they are too few or the sensor was saturated."""
    assert site.inclination is not None  # noqa: S101 - checked by the caller
    range_rad = site.instrument.inclination_range_rad
    log, dropped = inclination.clean(raw, range_rad)
    saturated = inclination.saturated_fraction(raw, range_rad)
    if saturated > MAX_SATURATED:
        if site.inclination.required:
            warnings.append(
                f"tilt out of the inclination sensor's range of {math.degrees(range_rad):g} degree in"
                f" {saturated:.0%} of its log, which is not used"
            )
        return None
    rows = len(log.time_s)
    if rows < MIN_LOG_ROWS:
        warnings.append(f"inclination log has {rows} valid rows")
        return None
    if dropped > 0.1 * (dropped + rows):
        warnings.append(f"inclination log bad: {dropped} of {dropped + rows} rows rejected")
    return log


def _overlaps(site: Site, log: InclinationLog, track: AzimuthTrack, warnings: list[str]) -> bool:
    """Return True if a log can be used for a scan by its times; warn if it does not cover the whole scan."""
    first_s, last_s = float(track.time_s[0]), float(track.time_s[-1])
    late_s, early_s = log.time_s[0] - first_s, last_s - log.time_s[-1]
    duration_s = last_s - first_s
    if max(late_s, early_s) >= duration_s:
        side = "begins {:,.0f} s after" if late_s >= duration_s else "ends {:,.0f} s before"
        side = side.format(max(late_s, early_s) - duration_s)
        warnings.append(f"inclination log is of another time: it {side} the scan")
        return False
    overlap_s = duration_s - max(late_s, 0.0) - max(early_s, 0.0)
    if overlap_s < MIN_LOG_COVERAGE * duration_s:
        lacking = [f"begins {late_s:,.0f} s after the start"] if late_s > 0 else []
        lacking += [f"ends {early_s:,.0f} s before the end"] if early_s > 0 else []
        warnings.append(f"inclination log {' and '.join(lacking)} of the scan")
    is_absolute = site.inclination is not None and site.inclination.mode == "absolute"
    return not is_absolute or overlap_s >= min(MIN_ABSOLUTE_LOG_S, MIN_LOG_COVERAGE * duration_s)


def _static_tilt_faults(site: Site, log: InclinationLog | None) -> tuple[str, ...]:
    """Return a message if the tilt of the mount itself is unknown: an absolute log is its only source."""
    if log is not None or site.inclination is None or site.inclination.mode == "relative":
        return ()
    message = (
        'tilt of the scanner unknown: with inclination.mode = "absolute" the SOP does not contain it, and'
        " there is no inclination log of at least a minute of the scan"
    )
    return (message,)


def _tilt_record(
    site: Site,
    log: InclinationLog | None,
    track: AzimuthTrack | None,
    tilt_offset: CyclicError | None,
    warnings: list[str],
) -> TiltRecord | None:
    """Return the tilt to apply, None if it is unknown."""
    if log is None or tilt_offset is None or site.inclination is None:
        return None
    cutoff_hz = None if site.inclination.cutoff_hz == "auto" else site.inclination.cutoff_hz
    if cutoff_hz is None and site.adjustment.method == "joint":
        cutoff_hz = inclination.JOINT_CUTOFF_HZ
    sigma_rad = site.instrument.inclination_sigma_rad
    filtered = site.inclination.filter == "blackman"
    tilt_record = inclination.relative_tilt(log, track, tilt_offset, sigma_rad, cutoff_hz, filtered=filtered)
    gap_s = float(np.ptp(tilt_record.gaps_s, axis=1).max(initial=0.0))
    if gap_s > 2 * tilt_record.correlation_time_s:
        warnings.append(f"inclination log has a gap of {gap_s:,.0f} s")
    if abs(tilt_record.offset_s) > max(
        MIN_CLOCK_OFFSET_S, MIN_CLOCK_OFFSET_SIGMAS * tilt_record.offset_sigma_s
    ):
        warnings.append(
            f"clock of the inclination log {tilt_record.offset_s:+z.1f} s off,"
            f" sigma {tilt_record.offset_sigma_s:.1f} s"
        )
    if track is None:
        return inclination.mean_tilt(tilt_record)
    return tilt_record


def _find_tilt_offset(
    site: Site,
    position: PositionScan,
    log: InclinationLog | None,
    track: AzimuthTrack | None,
    warnings: list[str],
    waiting_before: str,
) -> CyclicError | None:
    """Return the tilt offset contained in an SOP: the tilt of the scan from which the SOP was determined.

    Without `sop.scan`, that is the scan at hand, the first one under the SOP. Raises NotReadyError if an
    earlier one, `waiting_before`, is still to be processed.
    """
    sop = position.sop
    if site.inclination is None:
        return None
    if site.inclination.mode == "absolute":
        return NO_CYCLIC_ERROR
    if (sop is None or sop.scan is None) and waiting_before:
        raise NotReadyError(
            f"waits for {waiting_before}: the first scan under an SOP defines its tilt offset"
        )
    if sop is not None and sop.scan not in {None, position.scan, scan_stem(position.scan)}:
        try:
            log, track = _load_earlier_log(site, sop)
            problem = "not found" if log is None else ""
        except ScanError as error:
            log, track, problem = None, None, f"not usable: {error}"
        if problem:
            warnings.append(f"log of {sop.scan}, the scan of the SOP, {problem}: tilt not corrected")
    if log is None:
        return None
    return _fit_tilt_offset(log, track, site.instrument.inclination_sigma_rad)


def _load_earlier_log(site: Site, sop: SopSection) -> tuple[InclinationLog | None, AzimuthTrack | None]:
    """Return log and azimuth track of the scan of an SOP in the inbox, (None, None) if they are missing.

    `sop.scan` is its name without suffix, with or without its folders.
    """
    scan = find_in_inbox(site, sop.scan or "")
    files = [
        file
        for file in (scan.files if scan else ())
        if sop.files is None or fnmatchcase(file.name, sop.files)
    ]
    logs = list(dict.fromkeys(file.log for file in files if file.log is not None))
    if not files:
        return None, None
    with open_files(site, files) as reader:
        track, raw = reader.azimuth_track(), _raw_log(site, logs, reader)
    if raw is None:
        return None, None
    log, _ = inclination.clean(raw, site.instrument.inclination_range_rad)
    if track is not None and len(log.time_s):
        log = align_gps_week(log, float(track.time_s[0]))
    return log, track


def _fit_tilt_offset(log: InclinationLog, track: AzimuthTrack | None, sigma_rad: float) -> CyclicError:
    if track is not None:
        return inclination.fit_cyclic_error(log, track, sigma_rad)
    return CyclicError((float(log.roll_rad.mean()), 0.0, 0.0), (float(log.pitch_rad.mean()), 0.0, 0.0))
