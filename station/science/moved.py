"""What a wrongly assumed scanner does to heights, turned and shifted in full; `shared` to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Shared
from station.science.air import EARTH_RADIUS_M
from station.science.pose import rotation_x, rotation_y, rotation_z
from station.science.sensitivity import GROUPS, apart, members
from station.science.shared import GLOBAL, Sensitivities, aggregate_variance
from station.science.terrain import Ground
from station.science.view import Points


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
        off = np.array([self.weights @ self._off(draw) for draw in inputs[:-2].T])
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
        """Return how high the points (n,) appear above the ground if the scanner is off by this [m]."""
        by_name = dict(zip((name for name, _ in GLOBAL), parameters, strict=False))
        shift_m = [by_name[f"translation_{axis}"] for axis in ("east", "north", "up")]
        offset_m = np.stack(
            [axis - at - shift for axis, at, shift in zip(self.points, self.position_m, shift_m, strict=True)]
        )
        x_m, y_m, z_m = self._turned(offset_m, by_name, parameters)
        range_m = np.sqrt(x_m**2 + y_m**2 + z_m**2)
        scale = 1 + by_name["range_bias"] / range_m + 1e-6 * by_name["range_scale"]
        east_m, north_m, up_m = (
            at + scale * axis for at, axis in zip(self.position_m, (x_m, y_m, z_m), strict=True)
        )
        grid = self.ground.grid
        column, row = (east_m - grid.west_m) / grid.cell_m, (grid.north_m - north_m) / grid.cell_m
        return np.asarray(up_m - self.ground.under(column, row)[0])

    def _turned(self, offset_m: Floats, by_name: dict[str, float], parameters: Floats) -> Points:
        """Turn the lines of sight back by what the scanner leans and turns more than assumed, and the air."""
        turn = (
            rotation_x(-by_name["tilt_east"])
            @ rotation_y(-by_name["tilt_north"])
            @ rotation_z(by_name["heading"])
        )
        x_m, y_m, z_m = turn @ offset_m
        first, count = len(GLOBAL), self.felt.of.lean_count
        lean_rad, bend = (
            knots[before] * (1 - share) + knots[after] * share
            for knots, (before, after, share) in (
                (parameters[first : first + count], self.felt.lean_knot()),
                (parameters[first + count :], self.felt.refraction_knot()),
            )
        )
        flat_m = np.hypot(x_m, y_m)
        up_rad = (by_name["refraction"] + bend) * flat_m / (2 * EARTH_RADIUS_M) - lean_rad
        nearer = np.cos(up_rad) - z_m / flat_m * np.sin(up_rad)
        return x_m * nearer, y_m * nearer, z_m * np.cos(up_rad) + flat_m * np.sin(up_rad)
