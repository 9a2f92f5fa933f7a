"""Everything that went wrong at a simulated station, scan by scan, written down."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from station.quantities import Floats
from station.simulation import motion
from station.simulation.scan import Conditions
from station.simulation.scenario import Scenario

BEARING_STEP_DEG = 0.25  # between directions at which the refraction is told: its patches have sharp edges

CONVENTIONS = (
    "A direction d recorded in the scanner's frame truly points along"
    " Rz(-heading) R_SOP Ry(pitch) Rx(roll) d, from the SOP's position plus `position`."
    " Roll and pitch are relative to the first scan, from which the SOP is: their mean over its duration"
    " is zero. The SOP itself is without error."
)


def true_errors(
    scenario: Scenario, now: list[Conditions], lean: tuple[motion.Axis, motion.Axis]
) -> xr.Dataset:
    """Return the true value of every error of every scan, dimension `time`; angles in degrees."""
    return xr.merge([_motion(scenario, now, lean), _air(scenario, now), _sensor(scenario, now)])


def _per_scan(values: list[Any], units: str, meaning: str, *more: str) -> tuple[Any, ...]:
    return (("time", *more), np.array(values), {"units": units, "long_name": meaning})


def _motion(scenario: Scenario, now: list[Conditions], lean: tuple[motion.Axis, motion.Axis]) -> xr.Dataset:
    into_s = np.arange(0, scenario.scan_s + 0.5)
    starts = [scenario.scan_start_s(one.scan) for one in now]
    roll, pitch = (np.degrees([axis.lean(start + into_s) for start in starts]) for axis in lean)
    series = ("time", "into_scan")
    relative = "true, relative to the SOP's scan"
    return xr.Dataset(
        {
            "relative_roll": (series, roll, {"units": "degree", "long_name": f"lean about x, {relative}"}),
            "relative_pitch": (series, pitch, {"units": "degree", "long_name": f"lean about y, {relative}"}),
            "line_jitter": _per_scan(
                [np.degrees(one.jitter_rad) for one in now], "degree", "how much higher a line points", "line"
            ),
            "heading": _per_scan(
                [np.degrees(one.moves.heading_rad) for one in now], "degree", "turn, clockwise from above"
            ),
            "position": _per_scan([one.moves.position_m for one in now], "m", "shift against the SOP", "enu"),
            "range_bias": _per_scan([one.range_bias_m for one in now], "m", "measured less true"),
            "moved": _per_scan(
                [np.int8(motion.has_moved(scenario, one.scan)) for one in now],
                "1",
                "whether the scanner has been moved for good; roll, pitch, heading and position hold it",
            ),
            "scanner_start": _per_scan([one.scanner_start_s for one in now], "s", "gps_time at the start"),
        },
        coords={
            "into_scan": ("into_scan", into_s, {"units": "s"}),
            "enu": ["east", "north", "up"],
        },
    )


def _air(scenario: Scenario, now: list[Conditions]) -> xr.Dataset:
    """Return the air at the scanner and over the valley, NaN where it is switched off."""
    first, last = (np.radians(scenario.mount_heading_deg) + edge for edge in scenario.azimuth_rad)
    bearing_rad = np.linspace(first, last, 1 + round(np.degrees(last - first) / BEARING_STEP_DEG))
    bend: list[Floats] = [
        one.air.coefficient_at(bearing_rad) if one.air else np.zeros_like(bearing_rad) for one in now
    ]
    told = [
        (a.at_scanner.temperature_c, a.at_scanner.pressure_hpa, a.at_scanner.humidity_pct, a.path_warmer_k,
         a.lapse_k_per_m) if (a := one.air) else (float("nan"),) * 5
        for one in now
    ]  # fmt: skip
    names = (
        ("temperature", "degC", "at the scanner"),
        ("pressure", "hPa", "at the scanner"),
        ("humidity", "%", "at the scanner"),
        ("path_warmer", "K", "air along the beam against the thermometer's"),
        ("lapse_rate", "K m-1", "how much colder a metre higher is"),
    )
    return xr.Dataset(
        {
            "refraction": _per_scan(bend, "1", "coefficient of refraction by direction", "bearing"),
            "fog_visibility": _per_scan(
                [one.visibility_m for one in now], "m", "how far one sees, infinite without fog"
            ),
            **{
                name: _per_scan([row[column] for row in told], units, meaning)
                for column, (name, units, meaning) in enumerate(names)
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


def _sensor(scenario: Scenario, now: list[Conditions]) -> xr.Dataset:
    faults = [motion.sensor_faults(scenario, one.scan) for one in now]
    return xr.Dataset(
        {
            "log_bias": _per_scan(
                [np.degrees(one.bias_rad) for one in faults], "degree", "of the sensor", "axis"
            ),
            "log_cyclic": _per_scan(
                [np.degrees(one.cyclic_rad) for one in faults],
                "degree",
                "height of the sensor's wave",
                "axis",
            ),
            "log_phase": _per_scan(
                [np.degrees(one.phase_rad) for one in faults],
                "degree",
                "the wave is its height times sin(azimuth about z + phase)",
                "axis",
            ),
            "log_clock": _per_scan([one.clock_s for one in faults], "s", "log's time less scan's time"),
        },
        coords={"axis": ["roll", "pitch"]},
    )
