"""Non-linear effect of a wrong scanner pose on heights, of which the Jacobian is the first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Reals, SharedParameters
from station.science.analysis.sensitivity import GROUPS, block_diagonal, group_mask
from station.science.geometry.air import EARTH_RADIUS_M
from station.science.geometry.observation import Points
from station.science.geometry.terrain import BilinearSurface
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.parameters import GLOBAL
from station.science.uncertainty.propagation import aggregate_variance

DRAWS_PER_BLOCK = 500


@dataclass(frozen=True)
class PoseErrorModel:
    """Error of a weighted sum of cell heights as a function of the unknown parameters of a scan.

    Inputs are the shared parameters (p,), then two of unit variance: the independent tilt of the lines, and
    the random errors of the cells.
    """

    surface: BilinearSurface
    position_m: tuple[float, float, float]
    points: Points  # (n,) on the surface
    weights: Floats  # (n,)
    jacobian: HeightJacobian
    shared: SharedParameters
    random_m2: Floats  # (n,)

    def __call__(self, inputs: Floats) -> Floats:
        """Return the error of the sum (draws,) for inputs (p + 2, draws)."""
        parts = np.array_split(inputs[:-2], inputs.shape[1] // DRAWS_PER_BLOCK + 1, axis=1)
        errors_m = np.concatenate([self._height_errors(part) @ self.weights for part in parts])
        line_only = SharedParameters(
            self.shared.names, self.shared.units, self.shared.estimate, 0 * self.shared.covariance,
            self.shared.line_tilt_variance,
        )  # fmt: skip
        lines_m2 = aggregate_variance(self.weights, 0 * self.random_m2, self.jacobian, line_only)
        cells_m2 = float(np.sum(self.weights**2 * self.random_m2))
        return np.asarray(errors_m + np.sqrt(lines_m2) * inputs[-2] + np.sqrt(cells_m2) * inputs[-1])

    def groups(self) -> list[Bools]:
        """Return a mask of inputs (p + 2,) for each group, the random group last."""
        unit_inputs = {"jitter": (True, False)}
        masks = [
            np.append(group_mask(self.shared.names, group), unit_inputs.get(group, (False, False)))
            for group in GROUPS
        ]
        return [*masks, np.append(np.zeros(len(self.shared.names), bool), (False, True))]

    def draw(self, count: int, random: np.random.Generator) -> Floats:
        """Return random inputs (p + 2, count), independent between groups."""
        values, vectors = np.linalg.eigh(block_diagonal(self.shared).covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.concatenate(
            [root @ random.standard_normal((len(root), count)), random.standard_normal((2, count))]
        )

    def _height_errors(self, parameters: Floats) -> Floats:
        """Heights of the points above the surface (draws, n) [m], for scanner errors (p, draws)."""
        by_name = {name: parameters[index][:, None] for index, (name, _) in enumerate(GLOBAL)}
        plane = self.jacobian.params.plane
        u_m, v_m, w_m = (axis - origin for axis, origin in zip(self.points, self.position_m, strict=True))
        x_m, y_m, z_m = (
            axis - by_name[f"translation_{name}"]
            for axis, name in zip(plane.in_map_axes((u_m, v_m, w_m)), ("east", "north", "up"), strict=True)
        )
        x_m, y_m = _rotate(x_m, y_m, by_name["heading"])
        sight_tilt_rad, refraction, cross_tilt_rad = self._interpolate_knots(parameters)
        horizontal_m = np.hypot(x_m, y_m)
        east_rad, north_rad = (
            by_name["tilt_east"] + cross_tilt_rad * x_m / horizontal_m,
            by_name["tilt_north"] + cross_tilt_rad * y_m / horizontal_m,
        )
        z_m, x_m = _rotate(z_m, x_m, -north_rad)
        y_m, z_m = _rotate(y_m, z_m, -east_rad)
        horizontal_m = np.hypot(x_m, y_m)
        moving = self.jacobian.pose[-1] != 0
        refraction = refraction + by_name["refraction"] + by_name["refraction_ice"] * moving
        refraction_rad = refraction * horizontal_m / (2 * EARTH_RADIUS_M)
        bent_m, z_m = _rotate(horizontal_m, z_m, refraction_rad - sight_tilt_rad)
        x_m, y_m = x_m * bent_m / horizontal_m, y_m * bent_m / horizontal_m
        scale = 1 + by_name["range_bias"] / np.hypot(bent_m, z_m) + 1e-6 * by_name["range_scale"]
        moved_m = plane.in_grid_axes((scale * x_m, scale * y_m, scale * z_m))
        east_m, north_m, up_m = (origin + axis for origin, axis in zip(self.position_m, moved_m, strict=True))
        grid = self.surface.grid
        column, row = (east_m - grid.west_m) / grid.cell_m, (grid.north_m - north_m) / grid.cell_m
        return np.asarray(up_m - self.surface.height_and_gradient(column, row)[0])

    def _interpolate_knots(self, parameters: Floats) -> list[Reals]:
        """Sight tilt, refraction and cross tilt (draws, n), interpolated to each point."""
        refraction = self.jacobian.refraction_interpolation()
        return [
            knots.interpolate(parameters[part].T)
            for part, knots in zip(
                self.jacobian.params.knot_slices,
                (self.jacobian.tilt_interpolation(), refraction, refraction),
                strict=True,
            )
        ]


def _rotate(first: Floats, second: Floats, angle_rad: Floats) -> tuple[Floats, Floats]:
    """Rotate coordinates in their plane, from the first axis towards the second."""
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    return first * cosine - second * sine, first * sine + second * cosine
