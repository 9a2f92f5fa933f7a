"""The true errors of a simulated station, scan by scan."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from station.quantities import Floats
from station.simulation.instrument import motion
from station.simulation.instrument.scan import ScanConditions
from station.simulation.scenario import Scenario
from station.simulation.world.air import AirOfScan

BEARING_STEP_DEG = 0.25  # sampling of the refraction, whose patches have sharp edges

CONVENTIONS = (
    "A direction d recorded in the scanner's frame has the true direction"
    " Rz(-heading) R_SOP Ry(pitch) Rx(roll) d, from the SOP's position plus `position`."
    " Roll and pitch are relative to the first scan, from which the SOP was solved: their mean over its"
    " duration is zero. The SOP itself is free of errors."
)


def true_errors(
    scenario: Scenario, conditions: list[ScanConditions], tilt: tuple[motion.TiltAxis, motion.TiltAxis]
) -> xr.Dataset:
    """Return the true value of every error of every scan, dimension `time`; angles in degrees."""
    return xr.merge(
        [_motion(scenario, conditions, tilt), _air(scenario, conditions), _sensor(scenario, conditions)]
    )


def _per_scan(values: list[Any], units: str, long_name: str, *dims: str) -> tuple[Any, ...]:
    return (("time", *dims), np.array(values), {"units": units, "long_name": long_name})


def _motion(
    scenario: Scenario, conditions: list[ScanConditions], tilt: tuple[motion.TiltAxis, motion.TiltAxis]
) -> xr.Dataset:
    elapsed_s = np.arange(0, scenario.scan_s + 0.5)
    starts = [scenario.scan_start_s(condition.scan) for condition in conditions]
    roll, pitch = (np.degrees([axis.tilt(start + elapsed_s) for start in starts]) for axis in tilt)
    series = ("time", "into_scan")
    relative = "true, relative to the SOP's scan"
    return xr.Dataset(
        {
            "relative_roll": (series, roll, {"units": "degree", "long_name": f"tilt about x, {relative}"}),
            "relative_pitch": (series, pitch, {"units": "degree", "long_name": f"tilt about y, {relative}"}),
            "line_jitter": _per_scan(
                [np.degrees(condition.jitter_rad) for condition in conditions],
                "degree",
                "elevation error of each line",
                "line",
            ),
            "heading": _per_scan(
                [np.degrees(condition.pose_offset.heading_rad) for condition in conditions],
                "degree",
                "rotation, clockwise from above",
            ),
            "position": _per_scan(
                [condition.pose_offset.position_m for condition in conditions],
                "m",
                "shift against the SOP",
                "enu",
            ),
            "range_bias": _per_scan(
                [condition.range_bias_m for condition in conditions], "m", "measured minus true"
            ),
            "moved": _per_scan(
                [np.int8(motion.has_moved(scenario, condition.scan)) for condition in conditions],
                "1",
                "1 if the scanner was moved permanently; included in roll, pitch, heading and position",
            ),
            "scanner_start": _per_scan(
                [condition.scanner_start_s for condition in conditions], "s", "gps_time at the start"
            ),
        },
        coords={
            "into_scan": ("into_scan", elapsed_s, {"units": "s"}),
            "enu": ["east", "north", "up"],
        },
    )


def _air(scenario: Scenario, conditions: list[ScanConditions]) -> xr.Dataset:
    """Return the air at the scanner and over the valley, NaN if it is switched off."""
    first, last = (np.radians(scenario.mount_heading_deg) + edge for edge in scenario.azimuth_rad)
    bearing_rad = np.linspace(first, last, 1 + round(np.degrees(last - first) / BEARING_STEP_DEG))
    refraction: list[Floats] = [
        condition.air.coefficient_at(bearing_rad) if condition.air else np.zeros_like(bearing_rad)
        for condition in conditions
    ]
    rows = [_air_values(condition.air) for condition in conditions]
    names = (
        ("temperature", "degC", "at the scanner"),
        ("pressure", "hPa", "at the scanner"),
        ("humidity", "%", "at the scanner"),
        ("path_warmer", "K", "air along the beam minus the thermometer's reading"),
        ("lapse_rate", "K m-1", "decrease of temperature with height"),
    )
    return xr.Dataset(
        {
            "refraction": _per_scan(refraction, "1", "coefficient of refraction by direction", "bearing"),
            "fog_visibility": _per_scan(
                [condition.visibility_m for condition in conditions], "m", "visibility, infinite without fog"
            ),
            **_cold_air(conditions),
            **{
                name: _per_scan([row[column] for row in rows], units, long_name)
                for column, (name, units, long_name) in enumerate(names)
            },
        },
        coords={
            "bearing": (
                "bearing",
                np.degrees(bearing_rad),
                {"units": "degree", "long_name": "counter-clockwise from east"},
            )
        },
    )


def _cold_air(conditions: list[ScanConditions]) -> dict[str, tuple[Any, ...]]:
    """Return what cold air adds to the refraction over ice; nothing if it is switched off."""
    layers = [condition.cold_air for condition in conditions if condition.cold_air]
    if not layers:
        return {}
    return {
        "ice_refraction": _per_scan([layer.whole_path for layer in layers], "1", "added on rays to ice"),
        "ice_layer": _per_scan([layer.at_ice for layer in layers], "1", "added to refraction at the ice"),
    }


def _air_values(air: AirOfScan | None) -> tuple[float, ...]:
    """Return temperature, pressure, humidity, warmth of the path and lapse rate, in the units of `_air`."""
    if air is None:
        return (math.nan,) * 5
    at_scanner = air.at_scanner
    return (
        at_scanner.temperature_c,
        at_scanner.pressure_hpa,
        at_scanner.humidity_pct,
        air.path_warmer_k,
        air.lapse_k_per_m,
    )


def _sensor(scenario: Scenario, conditions: list[ScanConditions]) -> xr.Dataset:
    faults = [motion.sensor_faults(scenario, condition.scan) for condition in conditions]
    return xr.Dataset(
        {
            "log_bias": _per_scan(
                [np.degrees(fault.bias_rad) for fault in faults], "degree", "of the sensor", "axis"
            ),
            "log_cyclic": _per_scan(
                [np.degrees(fault.cyclic_rad) for fault in faults],
                "degree",
                "amplitude of the sensor's cyclic error",
                "axis",
            ),
            "log_phase": _per_scan(
                [np.degrees(fault.phase_rad) for fault in faults],
                "degree",
                "cyclic error = amplitude times sin(azimuth about z + phase)",
                "axis",
            ),
            "log_clock": _per_scan([fault.clock_s for fault in faults], "s", "log time minus scan time"),
        },
        coords={"axis": ["roll", "pitch"]},
    )
