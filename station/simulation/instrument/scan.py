"""Simulation of one scan: line after line of shots with their errors, as the scanner would record them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Ints
from station.simulation.instrument import motion
from station.simulation.instrument.ray_casting import RayHits, cast_rays
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario
from station.simulation.world.air import (
    AirOfScan,
    air_of_scan,
    fog_transmission,
    fog_visibility_m,
    range_ratio,
)
from station.simulation.world.terrain import EAST_M, NORTH_M, SOUTH_M, WEST_M, NodeField

SHOTS_PER_BLOCK = 50_000  # fits the cache
RETRACE = 0.25  # share of each line without shots, while the mirror swings back
ROCK, WHITE = 0.25, 0.60  # reflectance of rock, and of snow and ice
SPECKLE = 0.08  # relative scatter of the intensity of single shots
GAIN = 0.05  # largest relative change of the receiver's gain in a scan
FADING = 0.3  # relative scatter of the detection limit: the edge of visibility in fog is not sharp


@dataclass(frozen=True)
class SimulatedScan:
    """Echoes of a scan in the order of shooting, and the true positions of the points hit."""

    x_m: Floats  # (n,) scanner's frame
    y_m: Floats
    z_m: Floats
    time_s: Floats  # scanner's seconds
    intensity: Floats  # 0-1: by snow, ice or rock and by incidence
    true_m: Floats  # (n, 3) east, north, up of the mark


@dataclass(frozen=True)
class ScanConditions:
    """Conditions common to all shots of a scan."""

    scan: int
    scanner_start_s: float
    air: AirOfScan | None
    tilt_time_s: Floats  # (k,) into the scan
    tilt_rad: Floats  # (2, k) roll, pitch
    jitter_rad: Floats  # (lines,)
    pose_offset: motion.PoseOffset
    range_bias_m: float
    visibility_m: float  # infinite without fog
    gain: float  # of the receiver, 1 on average
    start_share: Floats  # (2,) shift of the scan's azimuths and elevations, as a share of a step


def scan_conditions(
    scenario: Scenario, scan: int, tilt: tuple[motion.TiltAxis, motion.TiltAxis]
) -> ScanConditions:
    """Return the conditions common to all shots of one scan."""
    rng = rng_for(scenario.seed, 50, scan)
    elapsed_s = np.linspace(0, scenario.scan_s, int(scenario.scan_s / motion.SPACING_S) + 2)
    start_s = scenario.scan_start_s(scan)
    gain = 1 + GAIN * rng_for(scenario.seed, 53, scan).uniform(-1, 1)
    return ScanConditions(
        scan=scan,
        scanner_start_s=float(np.round(rng.uniform(30, 110), 3)),  # since it was switched on
        air=air_of_scan(scenario, scan),
        tilt_time_s=elapsed_s,
        tilt_rad=np.stack([axis.tilt(start_s + elapsed_s) for axis in tilt]),
        jitter_rad=motion.line_jitter(scenario, scan),
        pose_offset=motion.pose_offset(scenario, scan),
        range_bias_m=float(scenario.range_bias_m * rng.standard_normal()),
        visibility_m=fog_visibility_m(scenario, scan),
        gain=gain if scenario.range_noise_m else 1.0,
        start_share=rng.uniform(0, 1, 2),
    )


def simulate_scan(
    scenario: Scenario, ground: NodeField, cover: NodeField, conditions: ScanConditions
) -> SimulatedScan:
    """Simulate one scan of a ground whose `cover` is 1 for ice and snow and 0 for rock."""
    aim_rng, receiver_rng = (rng_for(scenario.seed, kind, conditions.scan) for kind in (51, 52))
    lines = max(1, SHOTS_PER_BLOCK // scenario.shots_per_line)
    parts = [
        _simulate_lines(
            scenario,
            ground,
            cover,
            conditions,
            np.arange(first, min(first + lines, scenario.lines)),
            aim_rng,
            receiver_rng,
        )
        for first in range(0, scenario.lines, lines)
    ]
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("x_m", "y_m", "z_m", "time_s", "intensity", "true_m")
    }
    return SimulatedScan(**columns)


def _simulate_lines(
    scenario: Scenario,
    ground: NodeField,
    cover: NodeField,
    conditions: ScanConditions,
    lines: Ints,
    rng: np.random.Generator,
    receiver_rng: np.random.Generator,
) -> SimulatedScan:
    azimuth_rad, elevation_rad, elapsed_s, line = _angles(scenario, conditions, lines, rng)
    eye_m = np.array(scenario.mount_position_m) + conditions.pose_offset.position_m
    beam_error = scenario.beam_sigma_rad * rng.standard_normal((2, len(line)))
    direction = _directions(
        scenario,
        conditions,
        azimuth_rad + beam_error[0] / np.cos(elevation_rad),
        elevation_rad + beam_error[1] + conditions.jitter_rad[line],
        elapsed_s,
    )
    bearing_rad = np.unwrap(np.arctan2(direction[1], direction[0]))
    air = conditions.air
    hits = cast_rays(
        ground,
        eye_m,
        bearing_rad,
        direction[2] / np.hypot(direction[0], direction[1]),
        _reach_m(scenario),
        air.coefficient_at if air else np.zeros_like,
    )
    rise_m = hits.up_m - eye_m[2]
    range_m = np.hypot(hits.along_m, rise_m)
    cos_incidence = _cos_incidence(hits, direction)
    echo = (cos_incidence > np.cos(np.radians(scenario.incidence_max_deg))) & (range_m < scenario.range_max_m)
    echo &= rng.random(len(line)) >= scenario.echo_loss
    measured_m = range_m * range_ratio(air, rise_m) + conditions.range_bias_m
    measured_m += scenario.range_noise_m * rng.standard_normal(len(line))
    intensity = (ROCK + (WHITE - ROCK) * cover.at(hits.east_m, hits.north_m)) * cos_incidence
    echo &= _detected_in_fog(scenario, conditions, intensity, range_m, receiver_rng)
    flat_m = measured_m * np.cos(elevation_rad)
    return SimulatedScan(
        x_m=(flat_m * np.cos(azimuth_rad))[echo],
        y_m=(flat_m * np.sin(azimuth_rad))[echo],
        z_m=(measured_m * np.sin(elevation_rad))[echo],
        time_s=(conditions.scanner_start_s + elapsed_s)[echo],
        intensity=_recorded_intensity(scenario, conditions, intensity[echo], receiver_rng),
        true_m=np.stack((hits.east_m, hits.north_m, hits.up_m), axis=1)[echo],
    )


def _detected_in_fog(
    scenario: Scenario,
    conditions: ScanConditions,
    intensity: Floats,
    range_m: Floats,
    receiver_rng: np.random.Generator,
) -> Bools:
    """Return a mask of the echoes strong enough to be detected through fog; all of them without fog.

    An echo weakens with the square of the range and with the fog there and back. The detection limit is the
    echo of the faintest ground detected in clear air: rock at maximum range and maximum incidence.
    """
    if np.isinf(conditions.visibility_m):
        return np.ones(len(range_m), dtype=np.bool_)
    faintest = ROCK * np.cos(np.radians(scenario.incidence_max_deg))
    margin = intensity / faintest * (scenario.range_max_m / range_m) ** 2
    needed = np.exp(FADING * receiver_rng.standard_normal(len(range_m)))
    return np.asarray(margin * fog_transmission(range_m, conditions.visibility_m) > needed)


def _recorded_intensity(
    scenario: Scenario, conditions: ScanConditions, intensity: Floats, receiver_rng: np.random.Generator
) -> Floats:
    """Return the intensity recorded by the receiver, with speckle in each shot [1]."""
    if not scenario.range_noise_m:
        return intensity
    speckle = 1 + SPECKLE * receiver_rng.standard_normal(len(intensity))
    return np.clip(conditions.gain * speckle * intensity, 0, 1)


def _angles(
    scenario: Scenario,
    conditions: ScanConditions,
    lines: Ints,
    rng: np.random.Generator,
) -> tuple[Floats, Floats, Floats, Ints]:
    """Return recorded azimuth and elevation, seconds into the scan and line of each shot of these lines."""
    shots = scenario.shots_per_line
    first, last = scenario.azimuth_rad
    low, high = np.radians(scenario.elevation_deg)
    step = (high - low) / shots
    line = np.repeat(lines, shots)
    shot = np.tile(np.arange(shots), len(lines))
    phase = np.repeat(rng.uniform(0, 1, len(lines)), shots)  # the mirror is not synchronised with the head
    azimuth_rad = first + (last - first) * (line + conditions.start_share[0]) / scenario.lines
    elevation_rad = high - step * (shot + phase)
    elapsed_s = scenario.scan_s / scenario.lines * (line + (1 - RETRACE) * shot / shots)
    return azimuth_rad, elevation_rad, elapsed_s, line


def _directions(
    scenario: Scenario,
    conditions: ScanConditions,
    azimuth_rad: Floats,
    elevation_rad: Floats,
    elapsed_s: Floats,
) -> Floats:
    """Return unit vectors of the true shot directions in east-north-up (3, n).

    Source: equations.md, 2.5, R_SOP Ry(pitch) Rx(roll) d, then the heading error of the scan about up.
    """
    flat = np.cos(elevation_rad)
    x, y, z = flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(elevation_rad)
    roll, pitch = (
        np.interp(elapsed_s, conditions.tilt_time_s, angle_rad) for angle_rad in conditions.tilt_rad
    )
    y, z = y * np.cos(roll) - z * np.sin(roll), y * np.sin(roll) + z * np.cos(roll)
    x, z = x * np.cos(pitch) + z * np.sin(pitch), z * np.cos(pitch) - x * np.sin(pitch)
    rotation = motion.rotation_z(-conditions.pose_offset.heading_rad) @ motion.sop(scenario)[:3, :3]
    return np.asarray(rotation @ np.stack((x, y, z)))


def _cos_incidence(hits: RayHits, direction: Floats) -> Floats:
    """Return the cosine of the angle of incidence [1]."""
    along = direction[0] * hits.slope_east + direction[1] * hits.slope_north - direction[2]
    return np.asarray(along / np.sqrt(1 + hits.slope_east**2 + hits.slope_north**2))


def _reach_m(scenario: Scenario) -> float:
    """Return the distance to the furthest corner of the valley [m]."""
    return float(scenario.size * np.hypot(max(-WEST_M, EAST_M), max(-SOUTH_M, NORTH_M)))
