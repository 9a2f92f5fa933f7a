"""True motion of the scanner, and the record of its inclination sensor.

A direction d recorded in the scanner's frame points along `R_SOP · Ry(pitch) · Rx(roll) · d` in east-north-up
(equations.md, 2.5). Roll and pitch are relative to the scan from which the SOP was solved, the first of the
series. The SOP contains that scan's tilt, averaged over its duration, so the relative tilt has zero mean over
the first scan by definition, although it drifts and sways within it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Floats, InclinationLog
from station.simulation.instrument.disturbances import (
    DailyWave,
    PermanentTilt,
    RandomWalk,
    StepDisturbance,
    gusty_sway,
)
from station.simulation.randomness import random_fourier, rng_for
from station.simulation.scenario import Scenario

LOG_MARGIN_S = 6.0  # the log covers this margin on both sides of the shots
CLOCK_LIMIT_S = 5.0  # Voordendag et al. (2023): log and scan differ by up to 5 s
SPACING_S = 0.1  # sampling of the tilt for interpolation: sway has periods of 1.5 s and more
DISTURBANCES_PER_SCAN = 2.0
WOBBLE_LINES = 7.3  # period of the mirror's wobble, not a whole number of lines
WOBBLE_SWELL = 0.4  # relative variation of the wobble's amplitude over hundreds of lines

TiltFunction = Callable[[Floats], Floats]  # seconds since the start of the first scan → tilt [rad]


@dataclass(frozen=True)
class TiltAxis:
    """Tilt about one axis of the scanner, by seconds since the start of the first scan."""

    parts: tuple[TiltFunction, ...]
    mean_rad: float

    def tilt(self, series_s: Floats) -> Floats:
        """Return the tilt relative to the scan of the SOP [rad]."""
        return np.asarray(sum((part(series_s) for part in self.parts), -self.mean_rad * np.ones(1)))


@dataclass(frozen=True)
class PoseOffset:
    """Pose change of one scan besides tilt: rotation clockwise from above, shift east, north, up."""

    heading_rad: float
    position_m: Floats  # (3,)


@dataclass(frozen=True)
class SensorFaults:
    """Errors of the inclination sensor in one scan, roll first."""

    bias_rad: Floats  # (2,)
    cyclic_rad: Floats  # (2,) amplitude of the cyclic error over one turn
    phase_rad: Floats  # (2,)
    clock_s: float  # log time minus scan time


def tilt_axes(scenario: Scenario) -> tuple[TiltAxis, TiltAxis]:
    """Return the true tilt of the series about the scanner's x (roll) and y (pitch)."""
    during = np.linspace(0, scenario.scan_s, int(scenario.scan_s / SPACING_S) + 1)
    axes = []
    for index in range(2):
        rng = rng_for(scenario.seed, 30, index)
        parts: tuple[TiltFunction, ...] = (
            random_fourier(rng, np.radians(scenario.tilt_drift_deg), 2.5 * 3600, 26 * 3600),
            random_fourier(rng, np.radians(scenario.tilt_within_scan_deg), 150, 2400),
            random_fourier(rng, np.radians(scenario.sway_deg), 2, 25),
            *_disturbances(scenario, index),
        )
        mean_rad = float(np.mean(sum(part(during) for part in parts)))
        axes.append(TiltAxis(parts, mean_rad))
    return axes[0], axes[1]


def _disturbances(scenario: Scenario, axis: int) -> list[TiltFunction]:
    """Return gusts, steps, slow and permanent tilt of one axis, without those that are switched off."""
    parts: list[TiltFunction] = []
    if scenario.wind_sway_deg:
        parts.append(gusty_sway(scenario.seed, axis, np.radians(scenario.wind_sway_deg)))
    if scenario.tilt_jerk_deg:
        size_rad = np.radians(scenario.tilt_jerk_deg)
        parts.append(StepDisturbance(scenario.seed, axis, size_rad, DISTURBANCES_PER_SCAN / scenario.scan_s))
    if scenario.moved_hour and scenario.moved_deg:
        direction_rad = rng_for(scenario.seed, 39, 0).uniform(0, 2 * np.pi)
        share = (np.cos(direction_rad), np.sin(direction_rad))[axis]
        parts.append(PermanentTilt(3600 * scenario.moved_hour, np.radians(scenario.moved_deg) * share))
    if scenario.tilt_daily_deg:
        phase_rad = rng_for(scenario.seed, 44, axis).uniform(0, 2 * np.pi)
        parts.append(DailyWave(np.radians(scenario.tilt_daily_deg), phase_rad))
    if scenario.tilt_walk_deg:
        parts.append(RandomWalk(scenario.seed, axis, np.radians(scenario.tilt_walk_deg)))
    if scenario.season_hour and scenario.season_deg:
        direction_rad = rng_for(scenario.seed, 46, 0).uniform(0, 2 * np.pi)
        share = (np.cos(direction_rad), np.sin(direction_rad))[axis]
        parts.append(PermanentTilt(3600 * scenario.season_hour, np.radians(scenario.season_deg) * share))
    return parts


def has_moved(scenario: Scenario, scan: int) -> bool:
    """Return True if the scanner had been moved permanently before this scan."""
    return 0 < 3600 * scenario.moved_hour <= scenario.scan_start_s(scan)


def pose_offset(scenario: Scenario, scan: int) -> PoseOffset:
    """Return rotation and shift of the scanner in one scan; zero in the first, from which the SOP was solved.

    A permanent tilt comes with a rotation of half its size, to either side, and a shift; the tilt of a season
    comes with a rotation of the same size.
    """
    rng = rng_for(scenario.seed, 31, scan)
    factor = 1.0 if scan else 0.0
    heading_rad = factor * float(np.radians(scenario.heading_deg) * rng.standard_normal())
    position_m = factor * scenario.position_m * rng.standard_normal(3)
    if has_moved(scenario, scan):
        rng = rng_for(scenario.seed, 39, 1)
        heading_rad += float(np.radians(scenario.moved_deg / 2) * rng.choice((-1, 1)))
        direction = rng.standard_normal(3)
        position_m = position_m + scenario.moved_m * direction / np.linalg.norm(direction)
    if 0 < 3600 * scenario.season_hour <= scenario.scan_start_s(scan):
        side = rng_for(scenario.seed, 46, 1).choice((-1, 1))
        heading_rad += float(np.radians(scenario.season_deg) * side)
    return PoseOffset(heading_rad, position_m)


def line_jitter(scenario: Scenario, scan: int) -> Floats:
    """Return the elevation error of each line [rad] (lines,)."""
    rng = rng_for(scenario.seed, 32, scan)
    white = np.radians(scenario.line_jitter_deg) * rng.standard_normal(scenario.lines)
    if freedom := scenario.line_jitter_freedom:
        draws = rng_for(scenario.seed, 45, scan).standard_t(freedom, scenario.lines)
        white = np.radians(scenario.line_jitter_deg) * np.sqrt((freedom - 2) / freedom) * draws
    return np.asarray(white + _wobble(scenario, scan))


def _wobble(scenario: Scenario, scan: int) -> Floats:
    """Return the periodic part of the line jitter [rad] (lines,)."""
    rng = rng_for(scenario.seed, 38, scan)
    line = np.arange(scenario.lines, dtype=np.float64)
    swell = 1 + random_fourier(rng, WOBBLE_SWELL, 300, 2000)(line)
    wave = np.sin(2 * np.pi * line / WOBBLE_LINES + rng.uniform(0, 2 * np.pi))
    return np.asarray(
        np.radians(scenario.mirror_wobble_deg) * np.sqrt(2 / (1 + WOBBLE_SWELL**2)) * swell * wave
    )


def sensor_faults(scenario: Scenario, scan: int) -> SensorFaults:
    """Return the sensor's errors in one scan; the cyclic error keeps its phase and varies in amplitude."""
    rng = rng_for(scenario.seed, 33, scan)
    phase_rad = rng_for(scenario.seed, 34).uniform(0, 2 * np.pi, 2)
    clock_s = scenario.log_clock_s * rng.standard_normal()
    return SensorFaults(
        bias_rad=np.radians(scenario.log_bias_deg) * rng.standard_normal(2),
        cyclic_rad=np.radians(scenario.log_cyclic_deg)
        * (1 + scenario.log_cyclic_change * rng.standard_normal(2)),
        phase_rad=phase_rad,
        clock_s=float(np.clip(clock_s, -CLOCK_LIMIT_S, CLOCK_LIMIT_S)),
    )


def sensor_log(
    scenario: Scenario, scan: int, tilt: tuple[TiltAxis, TiltAxis], scanner_start_s: float
) -> InclinationLog:
    """Return the record of the sensor during one scan, time in scanner seconds, about 1 Hz.

    Source: Voordendag et al. (2023), section 2.2 and Fig. 3 (noise, wave over one turn, clock).
    """
    rng = rng_for(scenario.seed, 35, scan)
    faults = sensor_faults(scenario, scan)
    count = int(scenario.scan_s + 2 * LOG_MARGIN_S)
    elapsed_s = np.arange(count) - LOG_MARGIN_S + 0.03 * rng.standard_normal(count).clip(-3, 3)
    first, last = scenario.azimuth_rad
    head_rad = first + (last - first) * np.clip(elapsed_s / scenario.scan_s, 0, 1)
    mount_rad = np.radians([scenario.mount_roll_deg, scenario.mount_pitch_deg])
    readings = [
        mount_rad[index]
        + axis.tilt(scenario.scan_start_s(scan) + elapsed_s)
        + faults.bias_rad[index]
        + faults.cyclic_rad[index] * np.sin(head_rad + faults.phase_rad[index])
        + np.radians(scenario.log_noise_deg) * rng.standard_normal(count)
        for index, axis in enumerate(tilt)
    ]
    return InclinationLog(scanner_start_s + elapsed_s + faults.clock_s, readings[0], readings[1])


def faulty_log(scenario: Scenario, scan: int, log: InclinationLog) -> InclinationLog | None:
    """Return the log as the file will have it: with the scenario's fault, None if there is no file.

    "cut": it ends at 30-70 % of the scan. "time": one row is an hour late. "swapped": roll and pitch are in
    each other's column. "flipped": pitch has the other sign.
    """
    if not scenario.log_fault or scan < scenario.log_fault_hour:
        return log
    time_s, roll_rad, pitch_rad = log.time_s, log.roll_rad, log.pitch_rad
    rng = rng_for(scenario.seed, 47, scan)
    if scenario.log_fault == "missing":
        return None
    if scenario.log_fault == "cut":
        count = int(rng.uniform(0.3, 0.7) * len(time_s))
        return InclinationLog(time_s[:count], roll_rad[:count], pitch_rad[:count])
    if scenario.log_fault == "time":
        wrong_s = time_s.copy()
        wrong_s[int(rng.uniform(0.2, 0.8) * len(time_s))] += 3600.0
        return InclinationLog(wrong_s, roll_rad, pitch_rad)
    if scenario.log_fault == "swapped":
        return InclinationLog(time_s, pitch_rad, roll_rad)
    return InclinationLog(time_s, roll_rad, -pitch_rad)


def rotation_x(angle_rad: float) -> Floats:
    """Rotation of points about x, counter-clockwise positive (3, 3). Source: equations.md, 2.1."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def rotation_y(angle_rad: float) -> Floats:
    """Rotation of points about y, counter-clockwise positive (3, 3). Source: equations.md, 2.1."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rotation_z(angle_rad: float) -> Floats:
    """Rotation of points about z, counter-clockwise positive (3, 3). Source: equations.md, 2.1."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def sop(scenario: Scenario) -> Floats:
    """Return the SOP: the transformation from the scanner's frame to east-north-up at the mark (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = (
        rotation_z(np.radians(scenario.mount_heading_deg))
        @ rotation_y(np.radians(scenario.mount_pitch_deg))
        @ rotation_x(np.radians(scenario.mount_roll_deg))
    )
    matrix[:3, 3] = scenario.mount_position_m
    return matrix
