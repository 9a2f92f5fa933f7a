"""Simulation of one scan: line after line of shots with their errors, as the scanner would record them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from station.quantities import Bools, Floats, Ints
from station.simulation.instrument import motion
from station.simulation.instrument.airborne import (
    Cloud,
    airborne_range_m,
    cloud_of_scan,
    particle_brightness,
)
from station.simulation.instrument.face_casting import cast_onto_face
from station.simulation.instrument.ray_casting import RayHits, cast_rays, trace_from
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario
from station.simulation.world import rock_face
from station.simulation.world.air import (
    AirOfScan,
    air_of_scan,
    fog_transmission,
    fog_visibility_m,
    range_ratio,
)
from station.simulation.world.beach import SAND
from station.simulation.world.cold_air import ICE, ColdAir, added_coefficient, cold_air_of_scan
from station.simulation.world.terrain import NodeField

SHOTS_PER_BLOCK = 50_000  # fits the cache
RETRACE = 0.25  # share of each line without shots, while the mirror swings back
ROCK, WHITE = 0.25, 0.60  # reflectance of rock, and of snow and ice, at 1064 nm
REFLECTANCE = {905: (ROCK, 0.80), 1064: (ROCK, WHITE), 1550: (0.30, 0.10)}  # at 1550 nm snow is dark
SPECKLE = 0.08  # relative scatter of the intensity of single shots
GAIN = 0.05  # largest relative change of the receiver's gain in a scan
PRISMS_PER_S = (7294 / 60, -4664 / 60)  # of a Livox Mid-40, see `_rosette`
BENDING_PASSES = 3  # the point hit and the bending depend on each other
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
    airborne: Bools  # (n,) echoes from the air


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
    cold_air: ColdAir | None = None  # over ice
    cloud: Cloud | None = None  # close to the scanner


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
        cold_air=cold_air_of_scan(scenario, scan),
        cloud=cloud_of_scan(scenario, scan),
    )


def simulate_scan(
    scenario: Scenario,
    ground: NodeField,
    cover: NodeField,
    conditions: ScanConditions,
    ice: NodeField | None = None,
    sea_m: float = -np.inf,
) -> SimulatedScan:
    """Simulate one scan of a ground whose `cover` is 1 for ice and snow and 0 for rock.

    On a beach it is 1 where the ground is wet, and below the level of the sea there are no echoes. `ice` is
    where cold air lies; without it, that is `cover`.
    """
    aim_rng, receiver_rng, air_rng = (rng_for(scenario.seed, kind, conditions.scan) for kind in (51, 52, 54))
    lines = max(1, SHOTS_PER_BLOCK // scenario.shots_per_line)
    parts = [
        _simulate_lines(
            scenario,
            ground,
            cover,
            cover if ice is None else ice,
            conditions,
            np.arange(first, min(first + lines, scenario.lines)),
            sea_m,
            (aim_rng, receiver_rng, air_rng),
        )
        for first in range(0, scenario.lines, lines)
    ]
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("x_m", "y_m", "z_m", "time_s", "intensity", "true_m", "airborne")
    }
    return SimulatedScan(**columns)


def _simulate_lines(
    scenario: Scenario,
    ground: NodeField,
    cover: NodeField,
    ice: NodeField,
    conditions: ScanConditions,
    lines: Ints,
    sea_m: float,
    rngs: tuple[np.random.Generator, np.random.Generator, np.random.Generator],
) -> SimulatedScan:
    rng, receiver_rng, air_rng = rngs
    azimuth_rad, elevation_rad, elapsed_s, line = _angles(scenario, conditions, lines, rng)
    eye_m = np.array(scenario.mount_position_m) + conditions.pose_offset.position_m
    beam_error = scenario.beam_sigma_rad * rng.standard_normal((2, len(line)))
    if scenario.angle_step_deg:
        beam_error += np.radians(scenario.angle_step_deg) * rng.uniform(-0.5, 0.5, (2, len(line)))
    direction = _directions(
        scenario,
        conditions,
        azimuth_rad + beam_error[0] / np.cos(elevation_rad),
        elevation_rad + beam_error[1] + conditions.jitter_rad[line],
        elapsed_s,
    )
    air = conditions.air
    hits, true_m, cos_incidence = _meet_ground(scenario, ground, ice, conditions, eye_m, direction)
    rise_m = true_m[:, 2] - eye_m[2]
    range_m = np.hypot(hits.along_m, rise_m)
    echo = (cos_incidence > np.cos(np.radians(scenario.incidence_max_deg))) & (range_m < scenario.range_max_m)
    echo &= (hits.up_m > sea_m) & (rng.random(len(line)) >= scenario.echo_loss)
    rock, white = _reflectances(scenario)
    intensity = (rock + (white - rock) * cover.at(hits.east_m, hits.north_m)) * cos_incidence
    echo &= intensity * (scenario.range_max_m / range_m) ** 2 > scenario.faintest_reflectance
    echo &= _detected_in_fog(scenario, conditions, intensity, range_m, receiver_rng)
    airborne = np.zeros(len(line), dtype=np.bool_)
    if scenario.airborne_share or conditions.cloud:
        way_m = np.where(np.isfinite(range_m), range_m, scenario.range_max_m)
        air_m = airborne_range_m(scenario, conditions.cloud, azimuth_rad, elevation_rad, way_m, air_rng)
        airborne = np.isfinite(air_m)
        echo |= airborne
        range_m = np.where(airborne, air_m, range_m)
        rise_m = np.where(airborne, air_m * direction[2], rise_m)
        true_m = np.where(airborne[:, None], eye_m + air_m[:, None] * direction.T, true_m)
        intensity = np.where(airborne, particle_brightness(white, len(line), air_rng), intensity)
    measured_m = range_m * range_ratio(air, rise_m) + conditions.range_bias_m
    measured_m += scenario.range_noise_m * rng.standard_normal(len(line))
    flat_m = measured_m * np.cos(elevation_rad)
    return SimulatedScan(
        x_m=(flat_m * np.cos(azimuth_rad))[echo],
        y_m=(flat_m * np.sin(azimuth_rad))[echo],
        z_m=(measured_m * np.sin(elevation_rad))[echo],
        time_s=(conditions.scanner_start_s + elapsed_s)[echo],
        intensity=_recorded_intensity(scenario, conditions, intensity[echo], receiver_rng),
        true_m=true_m[echo],
        airborne=airborne[echo],
    )


def _meet_ground(
    scenario: Scenario,
    ground: NodeField,
    ice: NodeField,
    conditions: ScanConditions,
    eye_m: Floats,
    direction: Floats,
) -> tuple[RayHits, Floats, Floats]:
    """Return where beams meet the ground, the same in east-north-up (n, 3), and the cosine of incidence.

    Hits on a rock face are along, up and out of it.
    """
    coefficient_at = conditions.air.coefficient_at if conditions.air else np.zeros_like
    bearing_rad = np.unwrap(np.arctan2(direction[1], direction[0]))
    if scenario.kind == "rockfall":
        hits = cast_onto_face(ground, eye_m, direction, coefficient_at(bearing_rad))
        place_m = np.stack((hits.east_m, hits.north_m, hits.up_m))
        return hits, rock_face.from_face(place_m).T, _cos_incidence(hits, rock_face.axes() @ direction)
    slope = direction[2] / np.hypot(direction[0], direction[1])
    hits = cast_rays(ground, eye_m, bearing_rad, slope, _reach_m(ground), coefficient_at)
    if conditions.cold_air:
        rays = (bearing_rad, slope, coefficient_at(bearing_rad))
        hits = bend_over_ice(conditions.cold_air, ground, ice, eye_m, rays, hits)
    true_m = np.stack((hits.east_m, hits.north_m, hits.up_m), axis=1)
    return hits, true_m, _cos_incidence(hits, direction)


def bend_over_ice(
    cold_air: ColdAir,
    ground: NodeField,
    ice: NodeField,
    eye_m: Floats,
    rays: tuple[Floats, Floats, Floats],
    hits: RayHits,
) -> RayHits:
    """Return the hits with those on ice moved to where rays bent by cold air meet the ground.

    `rays` is bearing [rad], initial slope and coefficient of refraction without cold air, each (n,).
    """
    on_ice = np.flatnonzero(ice.at(hits.east_m, hits.north_m) > ICE)
    bearing_rad, slope, coefficient = (values[on_ice] for values in rays)
    columns = np.stack([getattr(hits, field.name) for field in fields(RayHits)])
    along_m, ray = columns[0, on_ice], (bearing_rad, slope, coefficient)
    for _ in range(BENDING_PASSES):
        total = coefficient + added_coefficient(cold_air, ground, ice, eye_m, ray, along_m)
        bent = trace_from(ground, eye_m, bearing_rad, slope, total, along_m)
        along_m = np.where(np.isfinite(bent.along_m), bent.along_m, along_m)
    columns[:, on_ice] = [getattr(bent, field.name) for field in fields(RayHits)]
    return RayHits(*columns)


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
    faintest = _reflectances(scenario)[0] * np.cos(np.radians(scenario.incidence_max_deg))
    margin = intensity / faintest * (scenario.range_max_m / range_m) ** 2
    needed = np.exp(FADING * receiver_rng.standard_normal(len(range_m)))
    return np.asarray(margin * fog_transmission(range_m, conditions.visibility_m) > needed)


def _reflectances(scenario: Scenario) -> tuple[float, float]:
    """Return the reflectance of bare ground and of its cover: of rock and snow, or of dry and wet sand."""
    return SAND if scenario.kind == "beach" else REFLECTANCE[scenario.wavelength_nm]


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
    if scenario.pattern == "rosette":
        return _rosette(scenario, conditions, lines)
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


def _rosette(
    scenario: Scenario, conditions: ScanConditions, lines: Ints
) -> tuple[Floats, Floats, Floats, Ints]:
    """Return what `_angles` does for two prisms that deflect the beam equally and rotate at constant speed.

    Source: Brazeal et al. (2021), the Livox Mid-40: 7294 and -4664 turns a minute.
    """
    shots = scenario.shots_per_line
    line, shot = np.repeat(lines, shots), np.tile(np.arange(shots), len(lines))
    elapsed_s = scenario.scan_s * (line + shot / shots) / scenario.lines
    turns = np.outer(PRISMS_PER_S, elapsed_s) + conditions.start_share[:, None]
    across, up = (part(2 * np.pi * turns).mean(axis=0) for part in (np.cos, np.sin))
    low, high = np.radians(scenario.elevation_deg)
    (first, last), middle = scenario.azimuth_rad, (low + high) / 2
    return (first + last) / 2 + (last - first) / 2 * across, middle + (high - low) / 2 * up, elapsed_s, line


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


def _reach_m(ground: NodeField) -> float:
    """Return the distance from the mark to the furthest corner of the ground [m]."""
    (ny, nx), step_m = ground.node.shape, ground.step_m
    east_m, north_m = ground.west_m + (nx - 1) * step_m, ground.south_m + (ny - 1) * step_m
    return float(np.hypot(max(-ground.west_m, east_m), max(-ground.south_m, north_m)))
