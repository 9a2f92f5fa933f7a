"""What a wrongly assumed scanner does to heights, turned and shifted in full; `shared` to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Shared
from station.science.air import EARTH_RADIUS_M
from station.science.sensitivity import GROUPS, apart, members
from station.science.shared import GLOBAL, Sensitivities, aggregate_variance
from station.science.terrain import Ground
from station.science.view import Points

DRAWS_AT_ONCE = 500


@dataclass(frozen=True)
class Moved:
    """A weighted sum of the heights of cells, as a function of what the scan does not know.

    Inputs are the shared parameters (p,), then two of unit variance: what lines have of their own, and what
    cells have.
    """

    ground: Ground
    position_m: tuple[float, float, float]
    points: Points  # (n,) on the ground
    weights: Floats  # (n,)
    felt: Sensitivities
    unknown: Shared
    random_m2: Floats  # (n,)

    def __call__(self, inputs: Floats) -> Floats:
        """Return how far off the sum is (draws,), of inputs (p + 2, draws)."""
        parts = np.array_split(inputs[:-2], inputs.shape[1] // DRAWS_AT_ONCE + 1, axis=1)
        off = np.concatenate([self._off(part) @ self.weights for part in parts])
        silent = Shared(
            self.unknown.names, self.unknown.units, self.unknown.estimate, 0 * self.unknown.covariance,
            self.unknown.noise_variance,
        )  # fmt: skip
        lines_m2 = aggregate_variance(self.weights, 0 * self.random_m2, self.felt, silent)
        cells_m2 = float(np.sum(self.weights**2 * self.random_m2))
        return np.asarray(off + np.sqrt(lines_m2) * inputs[-2] + np.sqrt(cells_m2) * inputs[-1])

    def groups(self) -> list[Bools]:
        """Tell which inputs belong to each of the groups, the random one last."""
        ends = {"jitter": (True, False)}
        found = [
            np.append(members(self.unknown.names, group), ends.get(group, (False, False))) for group in GROUPS
        ]
        return [*found, np.append(np.zeros(len(self.unknown.names), bool), (False, True))]

    def draw(self, count: int, random: np.random.Generator) -> Floats:
        """Return inputs (p + 2, count), independent between groups."""
        values, vectors = np.linalg.eigh(apart(self.unknown).covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.concatenate(
            [root @ random.standard_normal((len(root), count)), random.standard_normal((2, count))]
        )

    def _off(self, parameters: Floats) -> Floats:
        """Heights (draws, n) of the points above the ground if the scanner is off by this (p, draws) [m]."""
        of = {name: parameters[at][:, None] for at, (name, _) in enumerate(GLOBAL)}
        x_m, y_m, z_m = (
            axis - at - of[f"translation_{name}"]
            for axis, at, name in zip(self.points, self.position_m, ("east", "north", "up"), strict=True)
        )
        x_m, y_m = _turned(x_m, y_m, of["heading"])
        lean_rad, bend, across_rad = self._knots(parameters)
        flat_m = np.hypot(x_m, y_m)
        east_rad, north_rad = (
            of["tilt_east"] + across_rad * x_m / flat_m,
            of["tilt_north"] + across_rad * y_m / flat_m,
        )
        z_m, x_m = _turned(z_m, x_m, -north_rad)
        y_m, z_m = _turned(y_m, z_m, -east_rad)
        flat_m = np.hypot(x_m, y_m)
        upward_rad = (of["refraction"] + bend) * flat_m / (2 * EARTH_RADIUS_M) - lean_rad
        farther_m, z_m = _turned(flat_m, z_m, upward_rad)
        x_m, y_m = x_m * farther_m / flat_m, y_m * farther_m / flat_m
        scale = 1 + of["range_bias"] / np.hypot(farther_m, z_m) + 1e-6 * of["range_scale"]
        east_m, north_m, up_m = (
            at + scale * axis for at, axis in zip(self.position_m, (x_m, y_m, z_m), strict=True)
        )
        grid = self.ground.grid
        column, row = (east_m - grid.west_m) / grid.cell_m, (grid.north_m - north_m) / grid.cell_m
        return np.asarray(up_m - self.ground.under(column, row)[0])

    def _knots(self, parameters: Floats) -> list[Floats]:
        """Lean, refraction and lean across (draws, n) at each point."""
        of, refraction = self.felt.of, self.felt.refraction_knot()
        ends = np.cumsum([len(GLOBAL), of.lean_count, of.refraction_count])
        return [
            (knots[before] * (1 - share)[:, None] + knots[after] * share[:, None]).T
            for knots, (before, after, share) in zip(
                np.split(parameters, ends)[1:],
                (self.felt.lean_knot(), refraction, refraction),
                strict=True,
            )
        ]


def _turned(first: Floats, second: Floats, angle_rad: Floats) -> tuple[Floats, Floats]:
    """Turn coordinates in their plane, from the first axis towards the second."""
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    return first * cosine - second * sine, first * sine + second * cosine
