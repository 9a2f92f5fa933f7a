"""Surface change: fixed patterns on the terrain's nodes, each with its own amplitude over time.

A pattern is positive upwards along the mark's vertical. The ground at a given hour is the initial ground plus
the sum of amounts times patterns, so its cell means are as exact as theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from station.quantities import Floats
from station.simulation.randomness import rng_for
from station.simulation.scenario import Deposit, Scenario
from station.simulation.world.beach import bar
from station.simulation.world.places import roof
from station.simulation.world.rock_face import falls
from station.simulation.world.terrain import NodeField, Valley, bumps

# Release and deposit of the avalanche: east, north, half length, half width, times size [m]; the half axes
# also times the scenario's avalanche_size
RELEASE = (-730.0, 1950.0, 110.0, 90.0)
DEPOSIT = (-700.0, 1500.0, 150.0, 120.0)
SNOW_COVER_FROM_M, FULL_SNOW_COVER_M = 0.005, 0.03  # fresh snow that begins to cover rock, and that covers it
SETTLING_AT_M = 3000.0
DRIFT_M, DRIFT_SHARE = (25.0, 250.0), 0.5  # wavelengths (times size) and relative scatter of the depth
HEAVE_M = (200.0, 500.0)  # wavelengths, times size
HEAVE_PATTERNS = 6  # that a scan's heave is a combination of
CREEP_SLOPE_M = 50.0  # smoothing of the ground for its direction, times size
CREEP_DIP_DEG = 15.0  # more than the slope's, as in the upper part of a slide
SNOW = ("snowfall", "winter")
BREATHING = ("heave", "creep")
ON_STABLE_GROUND = (*SNOW, *BREATHING, "deposit")  # that one who draws stable ground does not know of
DISC_SAMPLES = 8  # in each direction around a node
SLAB_SHARE = 0.5  # height of the released slab over that of the deposit


@dataclass(frozen=True)
class SurfaceChange:
    """One process that changes the surface."""

    name: str
    pattern: NodeField  # metres for a unit amount
    amount: Callable[[float], float]  # of hours since the start of the first scan


def surface_changes(scenario: Scenario, valley: Valley) -> tuple[SurfaceChange, ...]:
    """Return the surface changes of this scenario, without those that are switched off."""
    single = tuple(
        build(scenario, valley)
        for build, size in (
            (_melt, scenario.melt_m_per_h),
            (_snowfall, scenario.snowfall_m),
            (_avalanche, scenario.avalanche_m),
            (_settling, scenario.settling_m_per_h),
            (_winter, scenario.winter_m),
            (_summer, scenario.summer_melt_m),
            (_creep, scenario.creep_m),
            (_sand, scenario.bar_growth_m),
            (_rockfall, scenario.rockfall_m),
        )
        if size
    )
    deposits = tuple(_debris(deposit, valley) for deposit in scenario.deposits)
    thaw = _thaw(scenario, valley) if scenario.thaw_m else ()
    return (*single, *thaw, *deposits, *(heave(scenario, valley) if scenario.heave_m else ()))


def ground_at(valley: Valley, changes: tuple[SurfaceChange, ...], hours: float) -> NodeField:
    """Return the ground `hours` after the start of the first scan."""
    node = valley.ground.node
    for change in changes:
        amount = change.amount(hours)
        if amount:
            node = node + amount * change.pattern.node
    return valley.ground.with_nodes(node)


def snow_cover(valley: Valley, changes: tuple[SurfaceChange, ...], hours: float) -> NodeField:
    """Return the snow and ice cover `hours` after the start (0-1): ice, and ground under fresh snow."""
    cover = valley.ice.node
    for change in changes:
        if change.name in SNOW:
            depth_m = change.amount(hours) * change.pattern.node
            cover = np.maximum(
                cover, np.clip((depth_m - SNOW_COVER_FROM_M) / (FULL_SNOW_COVER_M - SNOW_COVER_FROM_M), 0, 1)
            )
    return valley.ice.with_nodes(cover)


def _melt_pattern(valley: Valley) -> NodeField:
    height = valley.ground.node / valley.size
    lowest = height[valley.ice.node > 0.5].min()
    share = np.clip(1 - (height - lowest) / 450.0, 0, 1) * valley.ice.node
    share[share < 0.01] = 0  # the smooth edge of the ice must not melt rock
    return valley.ground.with_nodes(-share)


def _melt(scenario: Scenario, valley: Valley) -> SurfaceChange:
    def amount(hours: float) -> float:
        elapsed_h = _melting_h(scenario, hours) - _melting_h(scenario, scenario.melt_from_hour)
        return scenario.melt_m_per_h * max(0.0, elapsed_h)

    return SurfaceChange("melt", _melt_pattern(valley), amount)


def _melting_h(scenario: Scenario, hours: float) -> float:
    """Return the hours of mean melt in the hours since the start, or since the midnight before it."""
    if not scenario.melt_by_day:
        return hours
    day, hour = divmod(scenario.start.hour + scenario.start.minute / 60 + hours, 24)
    return float(24 * day + 12 * (1 - np.cos(np.pi * np.clip((hour - 6) / 12, 0, 1))))


def _thaw(scenario: Scenario, valley: Valley) -> tuple[SurfaceChange, ...]:
    """Return what melts in each hour: the snow between the heights that the edge passes."""
    height_m = valley.ground.node / valley.size
    edge_m = height_m[valley.ice.node > 0.5].min()
    ice = np.where(valley.ice.node < 0.01, 0.0, valley.ice.node)  # its smooth edge lies on rock

    def amount(begin_hour: float) -> Callable[[float], float]:
        return lambda hours: scenario.thaw_m * min(max(hours - begin_hour, 0.0), 1.0)

    bands = []
    for hour in range(int(scenario.hours - scenario.thaw_from_hour) + 1):
        passed = np.floor((height_m - edge_m) / scenario.thaw_climb_m_per_h) == hour
        pattern = valley.ground.with_nodes(-1.0 * passed * ice)
        bands.append(SurfaceChange("thaw", pattern, amount(scenario.thaw_from_hour + hour)))
    return tuple(bands)


def _settling(scenario: Scenario, valley: Valley) -> SurfaceChange:
    """Ice settles in proportion to its distance from the scanner."""
    share = valley.ice.node * np.hypot(*_places_m(valley)) / (SETTLING_AT_M * valley.size)
    share[valley.ice.node < 0.01] = 0

    def amount(hours: float) -> float:
        return scenario.settling_m_per_h * max(0.0, hours - scenario.settling_from_hour)

    return SurfaceChange("settling", valley.ground.with_nodes(-share), amount)


def _after_season(scenario: Scenario, amount_m: float) -> Callable[[float], float]:
    return lambda hours: amount_m if 0 < scenario.season_hour <= hours else 0.0


def _winter(scenario: Scenario, valley: Valley) -> SurfaceChange:
    """Snow of months: deep in the lee and in hollows, thin on crests, none on walls."""
    shape, step_m = valley.ground.node.shape, valley.ground.step_m
    drift = bumps(rng_for(scenario.seed, 21), shape, step_m / valley.size, *DRIFT_M, 1.0)
    pattern = _snow_share(scenario, valley) * np.clip(1 + DRIFT_SHARE * drift, 0.1, 2.5)
    amount = _after_season(scenario, scenario.winter_m)
    return SurfaceChange("winter", valley.ground.with_nodes(pattern), amount)


def _summer(scenario: Scenario, valley: Valley) -> SurfaceChange:
    return SurfaceChange("summer", _melt_pattern(valley), _after_season(scenario, scenario.summer_melt_m))


def heave(scenario: Scenario, valley: Valley) -> tuple[SurfaceChange, ...]:
    """Return the heave of rock: a wave over the day whose phase varies in space, and one new in each scan.

    The second is a combination of fixed patterns. Both have the same variance.
    """
    shape, step_m = valley.ground.node.shape, valley.ground.step_m / valley.size

    def pattern(number: int, share: float) -> NodeField:
        wave = bumps(rng_for(scenario.seed, 22, number), shape, step_m, *HEAVE_M, 1.0)
        return valley.ground.with_nodes(np.sqrt(share) * wave * _rock(valley))

    def daily(phase_rad: float) -> Callable[[float], float]:
        return lambda hours: scenario.heave_m * float(np.sin(2 * np.pi * hours / 24 + phase_rad))

    def random(number: int) -> Callable[[float], float]:
        return lambda hours: (
            scenario.heave_m
            * float(
                rng_for(scenario.seed, 23, number, int(np.floor(hours)) + 1).uniform(-np.sqrt(3), np.sqrt(3))
            )
        )

    waves = [SurfaceChange("heave", pattern(n, 0.5), daily(n * np.pi / 2)) for n in range(2)]
    scans = [
        SurfaceChange("heave", pattern(2 + n, 0.5 / HEAVE_PATTERNS), random(n)) for n in range(HEAVE_PATTERNS)
    ]
    return (*waves, *scans)


def _creep(scenario: Scenario, valley: Valley) -> SurfaceChange:
    """Part of the rock moves down the slope: the height at a place falls, and rough ground moves past it."""
    ground = valley.ground
    step_m = ground.step_m
    smooth = gaussian_filter(ground.node, CREEP_SLOPE_M * valley.size / step_m)
    north, east = np.gradient(smooth, step_m)
    slope = np.hypot(east, north).clip(1e-6)
    dip_rad = np.arctan(slope) + np.radians(CREEP_DIP_DEG)
    local_north, local_east = np.gradient(ground.node, step_m)
    ahead = (
        -(local_east * east + local_north * north) / slope
    )  # rise of the ground in the direction of motion
    patches = bumps(rng_for(scenario.seed, 24), ground.node.shape, step_m / valley.size, 300, 900, 1.0)
    share = np.clip(2 * (patches - 0.3), 0, 1) * np.clip((slope - 0.2) / 0.2, 0, 1) * _rock(valley)
    pattern = -share * (np.sin(dip_rad) + np.cos(dip_rad) * ahead)

    def amount(hours: float) -> float:
        return scenario.creep_m * hours / scenario.hours

    return SurfaceChange("creep", ground.with_nodes(pattern), amount)


def _sand(scenario: Scenario, valley: Valley) -> SurfaceChange:
    """Build the bar of a beach up after the scans of the reference."""
    begin = scenario.reference_scans * scenario.interval_s / 3600

    def amount(hours: float) -> float:
        share = (hours - begin) / max(scenario.hours - begin, 1.0)
        return scenario.bar_growth_m * float(np.clip(share, 0, 1))

    return SurfaceChange("sand", bar(valley), amount)


def _rockfall(scenario: Scenario, valley: Valley) -> SurfaceChange:
    def amount(hours: float) -> float:
        return scenario.rockfall_m if hours >= scenario.rockfall_hour else 0.0

    return SurfaceChange("rockfall", falls(valley), amount)


def _rock(valley: Valley) -> Floats:
    """Return the share of rock on the nodes, zero on ice."""
    return np.asarray(np.clip(1 - 2 * valley.ice.node, 0, 1))


def _snowfall(scenario: Scenario, valley: Valley) -> SurfaceChange:
    """Snow lies in patches on moderate slopes: all of it below 40°, none above 50°."""
    step_m = valley.ground.step_m
    patches = bumps(rng_for(scenario.seed, 20), valley.ground.node.shape, step_m / valley.size, 150, 900, 1.0)
    snow_share = _snow_share(scenario, valley)
    begin, end = scenario.snow_hours

    def amount(hours: float) -> float:
        return scenario.snowfall_m * float(np.clip((hours - begin) / (end - begin), 0, 1))

    return SurfaceChange(
        "snowfall", valley.ground.with_nodes(snow_share * np.clip(1 + 0.3 * patches, 0.1, 2)), amount
    )


def _snow_share(scenario: Scenario, valley: Valley) -> Floats:
    """Return the share of the snow that lies: all below 40°, none above 50° or on a known roof (ny, nx)."""
    down, across = np.gradient(valley.ground.node, valley.ground.step_m)
    slope_deg = np.degrees(np.arctan(np.hypot(across, down)))
    snow_share = np.clip((50 - slope_deg) / 10, 0, 1)
    if scenario.kind != "valley":  # where it lay at the start
        snow_share *= valley.ice.node
    if scenario.stable_ground == "poor":
        snow_share[roof(scenario, valley)] = 0
    return np.asarray(snow_share)


def _avalanche(scenario: Scenario, valley: Valley) -> SurfaceChange:
    deposit, release = (_deposit(valley, outline, scenario.avalanche_size) for outline in (DEPOSIT, RELEASE))
    pattern = deposit - SLAB_SHARE * release

    def amount(hours: float) -> float:
        return scenario.avalanche_m if hours >= scenario.avalanche_hour else 0.0

    return SurfaceChange("avalanche", valley.ground.with_nodes(pattern), amount)


def _deposit(valley: Valley, outline: tuple[float, float, float, float], size_factor: float) -> Floats:
    """Return a flat-topped mound of unit height with a smooth edge, zero outside."""
    east, north, half_x, half_y = (valley.size * length for length in outline)
    half_x, half_y = half_x * size_factor, half_y * size_factor
    east_m, north_m = _places_m(valley)
    inward = np.clip(2 * (1 - np.hypot((east_m - east) / half_x, (north_m - north) / half_y)), 0, 1)
    return np.asarray(inward**2 * (3 - 2 * inward))


def _debris(deposit: Deposit, valley: Valley) -> SurfaceChange:
    """Return a disc of even depth; a node at its edge has the covered share of what is around it."""
    east_m, north_m = _places_m(valley)
    within_m = (np.arange(DISC_SAMPLES) + 0.5) / DISC_SAMPLES - 0.5
    shift_m = valley.ground.step_m * within_m
    radius_m = np.sqrt(deposit.area_m2 / np.pi)
    covered = sum(
        np.hypot(east_m + x - deposit.east_m, north_m + y - deposit.north_m) < radius_m
        for x in shift_m
        for y in shift_m
    )
    share = np.asarray(covered) / DISC_SAMPLES**2

    def amount(hours: float) -> float:
        return deposit.depth_m if hours >= deposit.hour else 0.0

    return SurfaceChange("deposit", valley.ground.with_nodes(share), amount)


def _places_m(valley: Valley) -> tuple[Floats, Floats]:
    """Return east (1, nx) and north (ny, 1) of the nodes [m]."""
    ground = valley.ground
    ny, nx = ground.node.shape
    east_m: Floats = (ground.west_m + np.arange(nx, dtype=np.float64) * ground.step_m)[None, :]
    north_m: Floats = (ground.south_m + np.arange(ny, dtype=np.float64) * ground.step_m)[:, None]
    return east_m, north_m
