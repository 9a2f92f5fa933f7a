"""Surface change: fixed patterns on the terrain's nodes, each with its own amplitude over time.

A pattern is positive upwards along the mark's vertical. The ground at a given hour is the initial ground plus
the sum of amounts times patterns, so its cell means are as exact as theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Floats
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario
from station.simulation.world.places import roof
from station.simulation.world.terrain import NodeField, Valley, bumps

# Release and deposit of the avalanche: east, north, half length, half width, times size [m]; the half axes
# also times the scenario's avalanche_size
RELEASE = (-730.0, 1950.0, 110.0, 90.0)
DEPOSIT = (-700.0, 1500.0, 150.0, 120.0)
SNOW_COVER_FROM_M, FULL_SNOW_COVER_M = 0.005, 0.03  # fresh snow that begins to cover rock, and that covers it
SLAB_SHARE = 0.5  # height of the released slab over that of the deposit


@dataclass(frozen=True)
class SurfaceChange:
    """One process that changes the surface."""

    name: str
    pattern: NodeField  # metres for a unit amount
    amount: Callable[[float], float]  # of hours since the start of the first scan


def surface_changes(scenario: Scenario, valley: Valley) -> tuple[SurfaceChange, ...]:
    """Return the surface changes of this scenario, without those that are switched off."""
    return tuple(
        build(scenario, valley)
        for build, size in (
            (_melt, scenario.melt_m_per_h),
            (_snowfall, scenario.snowfall_m),
            (_avalanche, scenario.avalanche_m),
        )
        if size
    )


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
        if change.name == "snowfall":
            depth_m = change.amount(hours) * change.pattern.node
            cover = np.maximum(
                cover, np.clip((depth_m - SNOW_COVER_FROM_M) / (FULL_SNOW_COVER_M - SNOW_COVER_FROM_M), 0, 1)
            )
    return valley.ice.with_nodes(cover)


def _melt(scenario: Scenario, valley: Valley) -> SurfaceChange:
    height = valley.ground.node / valley.size
    lowest = height[valley.ice.node > 0.5].min()
    share = np.clip(1 - (height - lowest) / 450.0, 0, 1) * valley.ice.node
    share[share < 0.01] = 0  # the smooth edge of the ice must not melt rock

    def amount(hours: float) -> float:
        return scenario.melt_m_per_h * max(0.0, hours - scenario.melt_from_hour)

    return SurfaceChange("melt", valley.ground.with_nodes(-share), amount)


def _snowfall(scenario: Scenario, valley: Valley) -> SurfaceChange:
    """Snow lies in patches on moderate slopes: all of it below 40°, none above 50°."""
    step_m = valley.ground.step_m
    patches = bumps(rng_for(scenario.seed, 20), valley.ground.node.shape, step_m / valley.size, 150, 900, 1.0)
    down, across = np.gradient(valley.ground.node, step_m)
    slope_deg = np.degrees(np.arctan(np.hypot(across, down)))
    snow_share = np.clip((50 - slope_deg) / 10, 0, 1)
    begin, end = scenario.snow_hours

    def amount(hours: float) -> float:
        return scenario.snowfall_m * float(np.clip((hours - begin) / (end - begin), 0, 1))

    if scenario.stable_ground == "poor":
        snow_share[roof(scenario, valley)] = 0
    return SurfaceChange(
        "snowfall", valley.ground.with_nodes(snow_share * np.clip(1 + 0.3 * patches, 0.1, 2)), amount
    )


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
    ground = valley.ground
    ny, nx = ground.node.shape
    x = ((ground.west_m + np.arange(nx) * ground.step_m - east) / half_x)[None, :]
    y = ((ground.south_m + np.arange(ny) * ground.step_m - north) / half_y)[:, None]
    inward = np.clip(2 * (1 - np.hypot(x, y)), 0, 1)
    return np.asarray(inward**2 * (3 - 2 * inward))
