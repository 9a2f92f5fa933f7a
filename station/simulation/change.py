"""How the surface changes: fixed patterns on the terrain's nodes, each growing with time in its own way.

A pattern counts upwards along the mark's vertical. The ground of an hour is the first ground plus the
amounts of that hour times the patterns, so its cell means are as exact as theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Floats
from station.simulation.places import roof
from station.simulation.randomness import stream
from station.simulation.scenario import Scenario
from station.simulation.terrain import Heights, Valley, bumps

# Where the avalanche breaks off and where it stops: east, north, half length, half width, times size [m];
# the half axes also times the scenario's avalanche_size
RELEASE = (-730.0, 1950.0, 110.0, 90.0)
DEPOSIT = (-700.0, 1500.0, 150.0, 120.0)
WHITE_FROM_M, WHITE_AT_M = 0.005, 0.03  # so much fresh snow begins to hide rock, so much hides it
SLAB_SHARE = 0.5  # height of the slab that leaves against that of the deposit


@dataclass(frozen=True)
class Change:
    """One thing that happens to the surface."""

    name: str
    pattern: Heights  # metres for an amount of one
    amount: Callable[[float], float]  # of hours since the start of the first scan


def changes(scenario: Scenario, place: Valley) -> tuple[Change, ...]:
    """Return what happens to the surface in this scenario; nothing that is switched off."""
    return tuple(
        make(scenario, place)
        for make, size in (
            (_melt, scenario.melt_m_per_h),
            (_snowfall, scenario.snowfall_m),
            (_avalanche, scenario.avalanche_m),
        )
        if size
    )


def ground_at(place: Valley, happening: tuple[Change, ...], hours: float) -> Heights:
    """Return the ground so many hours after the start of the first scan."""
    node = place.ground.node
    for change in happening:
        amount = change.amount(hours)
        if amount:
            node = node + amount * change.pattern.node
    return place.ground.over(node)


def white_at(place: Valley, happening: tuple[Change, ...], hours: float) -> Heights:
    """Return what is white, so many hours after the start: ice, and ground under fresh snow (0-1)."""
    white = place.ice.node
    for change in happening:
        if change.name == "snowfall":
            depth_m = change.amount(hours) * change.pattern.node
            white = np.maximum(white, np.clip((depth_m - WHITE_FROM_M) / (WHITE_AT_M - WHITE_FROM_M), 0, 1))
    return place.ice.over(white)


def _melt(scenario: Scenario, place: Valley) -> Change:
    height = place.ground.node / place.size
    lowest = height[place.ice.node > 0.5].min()
    share = np.clip(1 - (height - lowest) / 450.0, 0, 1) * place.ice.node
    share[share < 0.01] = 0  # rock is rock: it does not melt by what is left of a smooth edge

    def amount(hours: float) -> float:
        return scenario.melt_m_per_h * max(0.0, hours - scenario.melt_from_hour)

    return Change("melt", place.ground.over(-share), amount)


def _snowfall(scenario: Scenario, place: Valley) -> Change:
    """Snow lies in patches where it is not too steep: all of it below 40°, none above 50°."""
    step_m = place.ground.step_m
    patches = bumps(stream(scenario.seed, 20), place.ground.node.shape, step_m / place.size, 150, 900, 1.0)
    down, across = np.gradient(place.ground.node, step_m)
    slope_deg = np.degrees(np.arctan(np.hypot(across, down)))
    held = np.clip((50 - slope_deg) / 10, 0, 1)
    begin, end = scenario.snow_hours

    def amount(hours: float) -> float:
        return scenario.snowfall_m * float(np.clip((hours - begin) / (end - begin), 0, 1))

    if scenario.stable_ground == "poor":
        held[roof(scenario, place)] = 0
    return Change("snowfall", place.ground.over(held * np.clip(1 + 0.3 * patches, 0.1, 2)), amount)


def _avalanche(scenario: Scenario, place: Valley) -> Change:
    deposit, release = (_heap(place, where, scenario.avalanche_size) for where in (DEPOSIT, RELEASE))
    pattern = deposit - SLAB_SHARE * release

    def amount(hours: float) -> float:
        return scenario.avalanche_m if hours >= scenario.avalanche_hour else 0.0

    return Change("avalanche", place.ground.over(pattern), amount)


def _heap(place: Valley, where: tuple[float, float, float, float], larger: float) -> Floats:
    """Return a flat-topped heap of height one with a smooth edge, nothing beyond it."""
    east, north, half_x, half_y = (place.size * length for length in where)
    half_x, half_y = half_x * larger, half_y * larger
    ground = place.ground
    ny, nx = ground.node.shape
    x = ((ground.west_m + np.arange(nx) * ground.step_m - east) / half_x)[None, :]
    y = ((ground.south_m + np.arange(ny) * ground.step_m - north) / half_y)[:, None]
    inward = np.clip(2 * (1 - np.hypot(x, y)), 0, 1)
    return np.asarray(inward**2 * (3 - 2 * inward))
