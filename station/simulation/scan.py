"""One scan: line after line of shots, each with its errors, as the scanner would record them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Ints
from station.simulation import motion
from station.simulation.air import AirOfScan, air_of_scan, left_by_fog, stretch, visibility_m
from station.simulation.cast import Hits, cast
from station.simulation.randomness import stream
from station.simulation.scenario import Scenario
from station.simulation.terrain import EAST_M, NORTH_M, SOUTH_M, WEST_M, Heights

SHOTS_AT_ONCE = 50_000  # what stays in the cache
RETRACE = 0.25  # share of each line in which the mirror swings back and nothing is shot
ROCK, WHITE = 0.25, 0.60  # of the light come back from rock, and from snow and ice
SPECKLE = 0.08  # relative scatter of the brightness of single shots
GAIN = 0.05  # the receiver is up to so much more or less sensitive in a scan
FADING = 0.3  # relative scatter of what the receiver just detects: the edge of sight in fog is not sharp


@dataclass(frozen=True)
class Recorded:
    """What a scan gave, in the order it was shot, and where its echoes truly came from."""

    x_m: Floats  # (n,) scanner's frame
    y_m: Floats
    z_m: Floats
    time_s: Floats  # scanner's seconds
    brightness: Floats  # 0-1: snow, ice or rock, and how steeply it was hit
    true_m: Floats  # (n, 3) east, north, up of the mark


@dataclass(frozen=True)
class Conditions:
    """What holds for all shots of a scan."""

    scan: int
    scanner_start_s: float
    air: AirOfScan | None
    lean_time_s: Floats  # (k,) into the scan
    lean_rad: Floats  # (2, k) roll, pitch
    jitter_rad: Floats  # (lines,)
    moves: motion.Moves
    range_bias_m: float
    visibility_m: float  # infinite without fog
    gain: float  # of the receiver, 1 on average
    start_share: Floats  # (2,) by which share of a step the scan's azimuths and elevations are shifted


def conditions(scenario: Scenario, scan: int, lean: tuple[motion.Axis, motion.Axis]) -> Conditions:
    """Return what holds for all shots of one scan."""
    rng = stream(scenario.seed, 50, scan)
    into_s = np.linspace(0, scenario.scan_s, int(scenario.scan_s / motion.SPACING_S) + 2)
    start_s = scenario.scan_start_s(scan)
    gain = 1 + GAIN * stream(scenario.seed, 53, scan).uniform(-1, 1)
    return Conditions(
        scan=scan,
        scanner_start_s=float(np.round(rng.uniform(30, 110), 3)),  # it counts from when it was switched on
        air=air_of_scan(scenario, scan),
        lean_time_s=into_s,
        lean_rad=np.stack([axis.lean(start_s + into_s) for axis in lean]),
        jitter_rad=motion.line_jitter(scenario, scan),
        moves=motion.moves(scenario, scan),
        range_bias_m=float(scenario.range_bias_m * rng.standard_normal()),
        visibility_m=visibility_m(scenario, scan),
        gain=gain if scenario.range_noise_m else 1.0,
        start_share=rng.uniform(0, 1, 2),
    )


def record(scenario: Scenario, ground: Heights, white: Heights, now: Conditions) -> Recorded:
    """Shoot one scan of a ground that is white (1: ice, snow) or dark (0: rock)."""
    aim, receive = (stream(scenario.seed, kind, now.scan) for kind in (51, 52))
    lines = max(1, SHOTS_AT_ONCE // scenario.shots_per_line)
    parts = [
        _shoot(
            scenario, ground, white, now, np.arange(first, min(first + lines, scenario.lines)), aim, receive
        )
        for first in range(0, scenario.lines, lines)
    ]
    together = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("x_m", "y_m", "z_m", "time_s", "brightness", "true_m")
    }
    return Recorded(**together)


def _shoot(
    scenario: Scenario,
    ground: Heights,
    white: Heights,
    now: Conditions,
    lines: Ints,
    rng: np.random.Generator,
    receive: np.random.Generator,
) -> Recorded:
    azimuth_rad, elevation_rad, into_s, line = _angles(scenario, now, lines, rng)
    eye_m = np.array(scenario.mount_position_m) + now.moves.position_m
    beam = scenario.beam_sigma_rad * rng.standard_normal((2, len(line)))
    world = _point(
        scenario,
        now,
        azimuth_rad + beam[0] / np.cos(elevation_rad),
        elevation_rad + beam[1] + now.jitter_rad[line],
        into_s,
    )
    bearing_rad = np.unwrap(np.arctan2(world[1], world[0]))
    air = now.air
    hits = cast(
        ground,
        eye_m,
        bearing_rad,
        world[2] / np.hypot(world[0], world[1]),
        _reach_m(scenario),
        air.coefficient_at if air else np.zeros_like,
    )
    rise_m = hits.up_m - eye_m[2]
    range_m = np.hypot(hits.along_m, rise_m)
    cosine = _facing(hits, world)
    echo = (cosine > np.cos(np.radians(scenario.incidence_max_deg))) & (range_m < scenario.range_max_m)
    echo &= rng.random(len(line)) >= scenario.echo_loss
    measured_m = range_m * stretch(air, rise_m) + now.range_bias_m
    measured_m += scenario.range_noise_m * rng.standard_normal(len(line))
    brightness = (ROCK + (WHITE - ROCK) * white.at(hits.east_m, hits.north_m)) * cosine
    echo &= _pierces_fog(scenario, now, brightness, range_m, receive)
    flat_m = measured_m * np.cos(elevation_rad)
    return Recorded(
        x_m=(flat_m * np.cos(azimuth_rad))[echo],
        y_m=(flat_m * np.sin(azimuth_rad))[echo],
        z_m=(measured_m * np.sin(elevation_rad))[echo],
        time_s=(now.scanner_start_s + into_s)[echo],
        brightness=_received(scenario, now, brightness[echo], receive),
        true_m=np.stack((hits.east_m, hits.north_m, hits.up_m), axis=1)[echo],
    )


def _pierces_fog(
    scenario: Scenario, now: Conditions, brightness: Floats, range_m: Floats, receive: np.random.Generator
) -> Bools:
    """Tell which echoes are still strong enough behind the fog; all of them without.

    An echo weakens with the square of the range and with the fog there and back; it is detected where it is
    as strong as that of the faintest ground seen in clear air: rock at the reach, hit as slantly as can be.
    """
    if np.isinf(now.visibility_m):
        return np.ones(len(range_m), dtype=np.bool_)
    faintest = ROCK * np.cos(np.radians(scenario.incidence_max_deg))
    margin = brightness / faintest * (scenario.range_max_m / range_m) ** 2
    needed = np.exp(FADING * receive.standard_normal(len(range_m)))
    return np.asarray(margin * left_by_fog(range_m, now.visibility_m) > needed)


def _received(
    scenario: Scenario, now: Conditions, brightness: Floats, receive: np.random.Generator
) -> Floats:
    """Return the brightness as the receiver tells it, each shot with its speckle [1]."""
    if not scenario.range_noise_m:
        return brightness
    speckle = 1 + SPECKLE * receive.standard_normal(len(brightness))
    return np.clip(now.gain * speckle * brightness, 0, 1)


def _angles(
    scenario: Scenario,
    now: Conditions,
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
    phase = np.repeat(rng.uniform(0, 1, len(lines)), shots)  # the mirror runs free of the head
    azimuth_rad = first + (last - first) * (line + now.start_share[0]) / scenario.lines
    elevation_rad = high - step * (shot + phase)
    into_s = scenario.scan_s / scenario.lines * (line + (1 - RETRACE) * shot / shots)
    return azimuth_rad, elevation_rad, into_s, line


def _point(
    scenario: Scenario, now: Conditions, azimuth_rad: Floats, elevation_rad: Floats, into_s: Floats
) -> Floats:
    """Return the unit vectors in east-north-up along which the shots truly leave (3, n).

    Source: EQUATIONS 2.5, R_SOP Ry(pitch) Rx(roll) d, then the scan's own turn about up.
    """
    flat = np.cos(elevation_rad)
    x, y, z = flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(elevation_rad)
    roll, pitch = (np.interp(into_s, now.lean_time_s, lean) for lean in now.lean_rad)
    y, z = y * np.cos(roll) - z * np.sin(roll), y * np.sin(roll) + z * np.cos(roll)
    x, z = x * np.cos(pitch) + z * np.sin(pitch), z * np.cos(pitch) - x * np.sin(pitch)
    turned = motion.rotation_z(-now.moves.heading_rad) @ motion.sop(scenario)[:3, :3]
    return np.asarray(turned @ np.stack((x, y, z)))


def _facing(hits: Hits, world: Floats) -> Floats:
    """Return the cosine of the angle of incidence [1]."""
    along = world[0] * hits.slope_east + world[1] * hits.slope_north - world[2]
    return np.asarray(along / np.sqrt(1 + hits.slope_east**2 + hits.slope_north**2))


def _reach_m(scenario: Scenario) -> float:
    """Return how far the furthest corner of the valley lies."""
    return float(scenario.size * np.hypot(max(-WEST_M, EAST_M), max(-SOUTH_M, NORTH_M)))
