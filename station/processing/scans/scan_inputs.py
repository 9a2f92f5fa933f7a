"""Inputs of a scan other than its shots: SOP, tilt, air; and warnings about what is missing."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np

from station.config import Site
from station.errors import NotReadyError
from station.processing.pipeline import AdjustmentInputs, Pose, to_map
from station.processing.scanner_pose import (
    map_position,
    scan_geometry,
    scanner_to_map,
    sop_identity,
)
from station.processing.scans.open_scans import OpenScan, PositionScan
from station.processing.scans.registration import (
    CovarianceOf,
    is_given,
    registered_covariance,
    registration,
)
from station.processing.scans.scan_air import air_of_scan
from station.processing.scans.scan_tilt import (
    clock_warnings,
    log_of_scan,
    own_tilt_offset,
    sop_tilt_offset,
    static_tilt_faults,
    tilt_of_scan,
)
from station.quantities import (
    Air,
    Floats,
    IntensityScale,
    ScanGeometry,
    SharedParameters,
    Shots,
    VarianceComponents,
)
from station.science.adjustment import prior
from station.science.adjustment.normal_equations import LineInclination
from station.science.geometry.air import air_correction
from station.science.geometry.cyclic_error import NO_CYCLIC_ERROR
from station.science.geometry.inclination import TiltRecord
from station.science.uncertainty import parameters

MEAN_TILT = "one mean tilt for the whole scan"


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
    log_by_line: Callable[[TiltRecord], LineInclination] | None = None  # of a tilt record, if there is a log

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

    def with_clock_offset(self, offset_s: float, sigma_s: float) -> ScanInputs:
        """Return the inputs with the inclination log corrected for a further offset of its clock [s].

        The points keep the tilt that they have, which an adjustment knows.
        """
        if self.adjustment_inputs is None or self.tilt_record is None or self.log_by_line is None:
            return self  # there is no log
        tilt_record = self.tilt_record.with_clock_offset(offset_s, sigma_s)
        return replace(
            self,
            adjustment_inputs=replace(self.adjustment_inputs, log=self.log_by_line(tilt_record)),
            tilt_record=tilt_record,
            warnings=(*self.warnings, *clock_warnings(tilt_record)),
        )

    def without_log(self, *, keep_tilt: bool) -> ScanInputs:
        """Return the inputs without a wrong inclination log, and without its tilt unless `keep_tilt`."""
        assert self.adjustment_inputs is not None  # noqa: S101 - the scan was adjusted
        adjustment_inputs = replace(self.adjustment_inputs, log=None)
        if keep_tilt:
            return replace(self, adjustment_inputs=adjustment_inputs)
        params, lines = adjustment_inputs.params, adjustment_inputs.lines
        return replace(
            self,
            pose=replace(self.pose, tilt=None),
            log_only_covariance=partial(
                prior.log_only_covariance,
                params,
                lines,
                None,
                NO_CYCLIC_ERROR,
                weather_known=self.air is not None,
            ),
            adjustment_inputs=replace(adjustment_inputs, assumed_rad=np.zeros((3, params.line_groups))),
        )

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
    log = log_of_scan(site, position.logs, reader, track, rotation, warnings)
    if registered is not None:  # it contains the mean tilt of the scan
        faults: tuple[str, ...] = ()
        tilt_offset = own_tilt_offset(site, log, track)
    else:
        faults = static_tilt_faults(site, log)
        tilt_offset = sop_tilt_offset(
            site,
            position,
            log,
            track,
            warnings,
            waiting_before=waiting_before,
            save=save_tilt_offset,
        )
    tilt_record = tilt_of_scan(site, log, track, tilt_offset, warnings)
    air, weather_known = air_of_scan(site, start + (end - start) / 2, transform.position_m[2], warnings)
    axis = (float(rotation[0, 2]), float(rotation[1, 2]), float(rotation[2, 2]))
    geometry = scan_geometry(site, transform.position_m, axis)
    if wait_for_weather and site.weather is not None and not weather_known:
        raise NotReadyError(next(warning for warning in warnings if warning.startswith("weather")))
    assert geometry.position_m is not None  # noqa: S101 - that of the SOP
    params = parameters.parameter_layout(geometry.grid, geometry.position_m, axis)
    lines = prior.line_times(params, rotation, track)
    assumed_rad, log_by_line = np.zeros((3, params.line_groups)), None
    if tilt_record is not None:
        assumed_rad = prior.tilt_rotation(tilt_record.tilt, rotation, lines.time_s)
        if track is not None and registered is None:
            log_by_line = partial(
                prior.line_inclination,
                params,
                lines,
                tilt_offset=tilt_offset or NO_CYCLIC_ERROR,
                to_local=rotation,
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
            params,
            lines,
            assumed_rad,
            log_by_line(tilt_record) if log_by_line and tilt_record else None,
            start.timestamp(),
            air if weather_known else None,
        ),
        tilt_record,
        air if weather_known else None,
        tuple(warnings),
        provenance,
        faults,
        is_given=registered is not None and is_given(site),
        log_by_line=log_by_line,
    )


def inputs_in_map_frame(site: Site, start_s: float) -> ScanInputs:
    """Return the inputs of a scan that is already on the map."""
    geometry, adjustment_inputs = scan_geometry(site, map_position(site)), None
    log_only_covariance: CovarianceOf | None = None
    if geometry.position_m is not None:  # registered elsewhere, with unknown accuracy
        params = parameters.parameter_layout(geometry.grid, geometry.position_m)
        lines = prior.line_times(params, np.eye(3), None)
        adjustment_inputs = AdjustmentInputs(
            params, lines, np.zeros((3, params.line_groups)), None, start_s, None
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
