"""How the scanner moves, and what its inclination sensor makes of it.

Truth: a direction d recorded in the scanner's frame points along `R_SOP · Ry(pitch) · Rx(roll) · d` in
east-north-up (EQUATIONS 2.5). Roll and pitch are relative to the scan the SOP was solved from, the first of
the series: the SOP holds that scan's lean averaged over its duration, so that the relative lean has mean zero
over the first scan by definition, though it drifts and sways within it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Floats, InclinationLog
from station.simulation.randomness import stream, wander
from station.simulation.scenario import Scenario
from station.simulation.shakes import Jerks, Knock, gusty_sway

LOG_MARGIN_S = 6.0  # the log begins and ends this much before and after the shots
CLOCK_LIMIT_S = 5.0  # Voordendag et al. (2023): log and scan differ by up to 5 s
SPACING_S = 0.1  # the lean is interpolated between such times: sway has periods of 1.5 s and more
JERKS_PER_SCAN = 2.0
WOBBLE_LINES = 7.3  # period of the mirror's wobble: it closes with no whole number of lines
WOBBLE_SWELL = 0.4  # share by which the wobble's height wanders over hundreds of lines

LeanPart = Callable[[Floats], Floats]  # of seconds since the first scan began [rad]


@dataclass(frozen=True)
class Axis:
    """The lean about one axis of the scanner, by seconds since the first scan began."""

    parts: tuple[LeanPart, ...]
    zero_rad: float

    def lean(self, series_s: Floats) -> Floats:
        """Return the lean relative to the scan of the SOP [rad]."""
        return np.asarray(sum((part(series_s) for part in self.parts), -self.zero_rad * np.ones(1)))


@dataclass(frozen=True)
class Moves:
    """What one scan does to the scanner besides leaning: turned clockwise from above, moved E, N, U."""

    heading_rad: float
    position_m: Floats  # (3,)


@dataclass(frozen=True)
class SensorFaults:
    """What the inclination sensor adds in one scan, roll first."""

    bias_rad: Floats  # (2,)
    cyclic_rad: Floats  # (2,) amplitude of the wave over one turn
    phase_rad: Floats  # (2,)
    clock_s: float  # what the log's time is ahead of the scan's


def axes(scenario: Scenario) -> tuple[Axis, Axis]:
    """Return the true lean of the series about the scanner's x (roll) and y (pitch)."""
    during = np.linspace(0, scenario.scan_s, int(scenario.scan_s / SPACING_S) + 1)
    found = []
    for number in range(2):
        rng = stream(scenario.seed, 30, number)
        parts: tuple[LeanPart, ...] = (
            wander(rng, np.radians(scenario.lean_drift_deg), 2.5 * 3600, 26 * 3600),
            wander(rng, np.radians(scenario.lean_within_scan_deg), 150, 2400),
            wander(rng, np.radians(scenario.sway_deg), 2, 25),
            *_rare(scenario, number),
        )
        zero_rad = float(np.mean(sum(part(during) for part in parts)))
        found.append(Axis(parts, zero_rad))
    return found[0], found[1]


def _rare(scenario: Scenario, number: int) -> list[LeanPart]:
    """Return the gusts, the jerks and the knock of one axis; nothing that is switched off."""
    parts: list[LeanPart] = []
    if scenario.wind_sway_deg:
        parts.append(gusty_sway(scenario.seed, number, np.radians(scenario.wind_sway_deg)))
    if scenario.lean_jerk_deg:
        size_rad = np.radians(scenario.lean_jerk_deg)
        parts.append(Jerks(scenario.seed, number, size_rad, JERKS_PER_SCAN / scenario.scan_s))
    if scenario.moved_hour and scenario.moved_deg:
        direction_rad = stream(scenario.seed, 39, 0).uniform(0, 2 * np.pi)
        share = (np.cos(direction_rad), np.sin(direction_rad))[number]
        parts.append(Knock(3600 * scenario.moved_hour, np.radians(scenario.moved_deg) * share))
    return parts


def has_moved(scenario: Scenario, scan: int) -> bool:
    """Tell whether somebody had moved the scanner for good before this scan."""
    return 0 < 3600 * scenario.moved_hour <= scenario.scan_start_s(scan)


def moves(scenario: Scenario, scan: int) -> Moves:
    """Return how the scanner is turned and moved in one scan; in the first not at all, the SOP is of it.

    Whoever tilts the scanner for good turns it by half as much, to either side, and shifts it.
    """
    rng = stream(scenario.seed, 31, scan)
    here = 1.0 if scan else 0.0
    heading_rad = here * float(np.radians(scenario.heading_deg) * rng.standard_normal())
    position_m = here * scenario.position_m * rng.standard_normal(3)
    if has_moved(scenario, scan):
        rng = stream(scenario.seed, 39, 1)
        heading_rad += float(np.radians(scenario.moved_deg / 2) * rng.choice((-1, 1)))
        direction = rng.standard_normal(3)
        position_m = position_m + scenario.moved_m * direction / np.linalg.norm(direction)
    return Moves(heading_rad, position_m)


def line_jitter(scenario: Scenario, scan: int) -> Floats:
    """Return by how much each line points higher than all else says [rad] (lines,)."""
    rng = stream(scenario.seed, 32, scan)
    white = np.radians(scenario.line_jitter_deg) * rng.standard_normal(scenario.lines)
    return np.asarray(white + _wobble(scenario, scan))


def _wobble(scenario: Scenario, scan: int) -> Floats:
    """Return the part of the jitter that comes back every few lines [rad] (lines,)."""
    rng = stream(scenario.seed, 38, scan)
    line = np.arange(scenario.lines, dtype=np.float64)
    swell = 1 + wander(rng, WOBBLE_SWELL, 300, 2000)(line)
    wave = np.sin(2 * np.pi * line / WOBBLE_LINES + rng.uniform(0, 2 * np.pi))
    return np.asarray(
        np.radians(scenario.mirror_wobble_deg) * np.sqrt(2 / (1 + WOBBLE_SWELL**2)) * swell * wave
    )


def sensor_faults(scenario: Scenario, scan: int) -> SensorFaults:
    """Return the sensor's errors in one scan; the wave keeps its phase and changes its height."""
    rng = stream(scenario.seed, 33, scan)
    phase_rad = stream(scenario.seed, 34).uniform(0, 2 * np.pi, 2)
    clock_s = scenario.log_clock_s * rng.standard_normal()
    return SensorFaults(
        bias_rad=np.radians(scenario.log_bias_deg) * rng.standard_normal(2),
        cyclic_rad=np.radians(scenario.log_cyclic_deg)
        * (1 + scenario.log_cyclic_change * rng.standard_normal(2)),
        phase_rad=phase_rad,
        clock_s=float(np.clip(clock_s, -CLOCK_LIMIT_S, CLOCK_LIMIT_S)),
    )


def sensor_log(
    scenario: Scenario, scan: int, lean: tuple[Axis, Axis], scanner_start_s: float
) -> InclinationLog:
    """Return what the sensor wrote during one scan, time in scanner seconds, about once a second.

    Source: Voordendag et al. (2023), section 2.2 and Fig. 3 (noise, wave over one turn, clock).
    """
    rng = stream(scenario.seed, 35, scan)
    faults = sensor_faults(scenario, scan)
    count = int(scenario.scan_s + 2 * LOG_MARGIN_S)
    into_s = np.arange(count) - LOG_MARGIN_S + 0.03 * rng.standard_normal(count).clip(-3, 3)
    first, last = scenario.azimuth_rad
    head_rad = first + (last - first) * np.clip(into_s / scenario.scan_s, 0, 1)
    mount_rad = np.radians([scenario.mount_roll_deg, scenario.mount_pitch_deg])
    read = [
        mount_rad[number]
        + axis.lean(scenario.scan_start_s(scan) + into_s)
        + faults.bias_rad[number]
        + faults.cyclic_rad[number] * np.sin(head_rad + faults.phase_rad[number])
        + np.radians(scenario.log_noise_deg) * rng.standard_normal(count)
        for number, axis in enumerate(lean)
    ]
    return InclinationLog(scanner_start_s + into_s + faults.clock_s, read[0], read[1])


def rotation_x(angle_rad: float) -> Floats:
    """Rotation of points about x, counter-clockwise positive (3, 3). Source: EQUATIONS 2.1."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def rotation_y(angle_rad: float) -> Floats:
    """Rotation of points about y, counter-clockwise positive (3, 3). Source: EQUATIONS 2.1."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rotation_z(angle_rad: float) -> Floats:
    """Rotation of points about z, counter-clockwise positive (3, 3). Source: EQUATIONS 2.1."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def sop(scenario: Scenario) -> Floats:
    """Return the scanner's orientation and position: its frame to east-north-up at the mark (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = (
        rotation_z(np.radians(scenario.mount_heading_deg))
        @ rotation_y(np.radians(scenario.mount_pitch_deg))
        @ rotation_x(np.radians(scenario.mount_roll_deg))
    )
    matrix[:3, 3] = scenario.mount_position_m
    return matrix
