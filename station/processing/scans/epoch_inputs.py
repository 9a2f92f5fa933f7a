"""Inputs of a scan from one position or from several.

Scans from several positions are placed by the inputs of each, and are one cloud on the map from there on.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from station.config import Site
from station.processing.pipeline import AdjustmentInputs, Pose
from station.processing.scanner_pose import scan_geometry, scanner_to_map, sop_identity_at
from station.processing.scans.open_scans import OpenScan
from station.processing.scans.registration import registered_covariance
from station.processing.scans.scan_air import air_of_scan
from station.processing.scans.scan_inputs import MEAN_TILT, ScanInputs, inputs_in_map_frame, position_inputs
from station.quantities import Viewpoint
from station.readers.sop import valid_sop
from station.science.adjustment import prior
from station.science.geometry.cyclic_error import NO_CYCLIC_ERROR
from station.science.uncertainty import parameters


def load_scan_inputs(
    site: Site,
    scan: OpenScan,
    *,
    save_tilt_offset: bool = True,
    wait_for_weather: bool = False,
    waiting_before: str = "",
) -> ScanInputs:
    """Return the inputs of a scan; raise ScanError or ConfigError if it cannot be georeferenced.

    With `save_tilt_offset`, a tilt offset estimated here is saved for later scans. NotReadyError is raised if
    that offset is to be of an earlier scan, the one in `waiting_before`; and, with `wait_for_weather`, if
    there is no weather yet.
    """
    inputs = _inputs_by_frame(
        site,
        scan,
        save_tilt_offset=save_tilt_offset,
        wait_for_weather=wait_for_weather,
        waiting_before=waiting_before,
    )
    if site.epoch is None or site.epoch.files is None or scan.file_count >= site.epoch.files:
        return inputs
    warning = f"{scan.file_count} of {site.epoch.files} files of the epoch"
    return replace(inputs, warnings=(warning, *inputs.warnings))


def _inputs_by_frame(
    site: Site, scan: OpenScan, *, save_tilt_offset: bool, wait_for_weather: bool, waiting_before: str
) -> ScanInputs:
    if site.scans.frame == "map":
        return inputs_in_map_frame(site, scan.start.timestamp())
    inputs = [
        position_inputs(
            site,
            position,
            save_tilt_offset=save_tilt_offset,
            wait_for_weather=wait_for_weather,
            waiting_before=waiting_before,
        )
        for position in scan.positions
    ]
    return inputs[0] if len(inputs) == 1 else _inputs_of_positions(site, scan, inputs)


def _inputs_of_positions(site: Site, scan: OpenScan, each: list[ScanInputs]) -> ScanInputs:
    """Return the inputs of scans from several positions, which are adjusted as one rigid cloud.

    The first position of the site file is that of the adjustment, whichever positions a scan has.
    """
    sop = valid_sop(site.sop, scan.start)
    site = site.with_scanner_of(sop)
    transform = scanner_to_map(site, sop)
    rotation = transform.to_local[:3, :3]
    axis = (float(rotation[0, 2]), float(rotation[1, 2]), float(rotation[2, 2]))
    warnings = [
        f"{position.name}: {warning}"
        for position, inputs in zip(scan.positions, each, strict=True)
        for warning in inputs.warnings
        if not warning.startswith("weather")  # that of all of them follows
        if site.inclination is not None or not warning.endswith(MEAN_TILT)  # their tilt is not adjusted
    ]
    air, weather_known = air_of_scan(
        site, scan.start + (scan.end - scan.start) / 2, transform.position_m[2], warnings
    )
    viewpoints = tuple(
        Viewpoint(inputs.geometry.scanner, site.grid_cells.plane.place_from_map(inputs.pose.frame.position_m))
        for inputs in each
        if inputs.pose.frame is not None
    )
    geometry = replace(scan_geometry(site, transform.position_m, axis), viewpoints=viewpoints)
    assert geometry.position_m is not None  # noqa: S101 - that of the SOP
    params = parameters.parameter_layout(geometry.grid, geometry.position_m, axis)
    lines = prior.line_times(params, rotation, None)
    covariance = partial(
        prior.log_only_covariance, params, lines, None, NO_CYCLIC_ERROR, weather_known=weather_known
    )
    are_given = all(inputs.is_given for inputs in each)
    return ScanInputs(
        geometry,
        Pose(None, None),
        registered_covariance(site, covariance) if are_given else covariance,
        AdjustmentInputs(
            params,
            lines,
            np.zeros((3, params.line_groups)),
            None,
            scan.start.timestamp(),
            air if weather_known else None,
        ),
        None,
        air if weather_known else None,
        tuple(warnings),
        {"sop_id": sop_identity_at(site, scan.start), "sop_tilt_offset": ""},
        tuple(dict.fromkeys(fault for inputs in each for fault in inputs.faults)),
        tuple(inputs.pose for inputs in each),
        are_given,
    )
