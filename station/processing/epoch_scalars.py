"""Numbers of an epoch as a whole: its scalar variables in the store, and the metrics of its log line."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from station.archive import epochs
from station.processing.scans.scan_inputs import ScanInputs
from station.quantities import Measurement, Quality

MAX_METRIC_CELLS = 100_000  # the metrics of larger scans are computed from a sample


def air_key(scalars: Mapping[str, float]) -> tuple[float, ...]:
    """Return temperature, pressure and humidity of an epoch [°C, hPa, %]; () if they are unknown."""
    air = tuple(scalars[name] for name in epochs.AIR_VARIABLES if name in scalars)
    return air if len(air) == len(epochs.AIR_VARIABLES) else ()


def scalar_variables(
    measurement: Measurement, inputs: ScanInputs, point_total: int, ground_total: int
) -> dict[str, float]:
    """Return the scalar variables of an epoch by their name in the store.

    The scan has `point_total` points, `ground_total` of which were used.
    """
    tilt_record, geometry = inputs.tilt_record, inputs.geometry
    scalars = {
        "point_total": float(point_total),
        "discarded_share": 1.0 - ground_total / point_total,
        "coverage": float(np.count_nonzero(measurement.count) / measurement.cell_index.size),
    }
    if geometry.position_m is not None:
        position_m = geometry.grid.plane.place_to_map(geometry.position_m)
        scalars |= dict(zip(("scanner_east", "scanner_north", "scanner_height"), position_m, strict=True))
        scalars |= {"scanner_axis_east": geometry.axis[0], "scanner_axis_north": geometry.axis[1]}
    if tilt_record is not None:
        scalars["platform_roll"] = math.degrees(tilt_record.mean_roll_rad)
        scalars["platform_pitch"] = math.degrees(tilt_record.mean_pitch_rad)
        scalars["tilt_residual"] = math.degrees(tilt_record.noise_rad)
        scalars["log_offset"] = tilt_record.offset_s
    return scalars | air_scalars(inputs)


def air_scalars(inputs: ScanInputs) -> dict[str, float]:
    """Return the air of a scan by variable name [°C, hPa, %]; empty if it is unknown."""
    air = inputs.air
    if air is None:
        return {}
    return dict(
        zip(epochs.AIR_VARIABLES, (air.temperature_c, air.pressure_hpa, air.humidity_pct), strict=True)
    )


def log_metrics(epoch: epochs.Epoch, seconds: float) -> dict[str, float | str]:
    """Return the metrics of a scan for the log line and the status."""
    measurement = epoch.measurement
    metrics: dict[str, float | str] = {
        "points": int(epoch.scalars["point_total"]),
        "cells": round(epoch.scalars["coverage"] * measurement.cell_index.size),
    }
    if epoch.scalars["discarded_share"]:
        metrics["discarded_pct"] = round(100 * epoch.scalars["discarded_share"], 2)
    if epoch.scalars["rejected_echo_share"]:
        metrics["rejected_echo_pct"] = round(100 * epoch.scalars["rejected_echo_share"], 3)
    sample = slice(None, None, 1 + len(measurement.cells) // MAX_METRIC_CELLS)
    change_m, sigma_m = measurement.change_m[sample], measurement.cells["uncertainty_m"][sample]
    valid = np.isfinite(sigma_m)
    if valid.any():
        metrics["sigma_median_m"] = round(float(np.median(sigma_m[valid])), 4)
    valid = np.isfinite(change_m)
    if valid.any():
        metrics["change_median_m"] = round(float(np.median(change_m[valid])), 4)
        significant = measurement.quality[sample][valid] & np.uint8(Quality.CHANGE_SIGNIFICANT)
        metrics["significant_pct"] = round(100 * float(np.mean(significant > 0)), 1)
    for variable in ("stable_nmad", "stable_z_std"):
        if np.isfinite(epoch.scalars.get(variable, np.nan)):
            metrics[variable] = round(epoch.scalars[variable], 3)
    for variable, name in (
        ("platform_roll", "roll_deg"),
        ("platform_pitch", "pitch_deg"),
        ("registration_rotation", "registration_deg"),
        ("registration_translation", "registration_m"),
    ):
        if variable in epoch.scalars:
            metrics[name] = round(epoch.scalars[variable], 4)
    metrics["seconds"] = round(seconds, 2)
    return metrics
