"""Jacobian of cell heights with respect to the parameters that all points of a scan share.

Ten global parameters apply to all points, but for one: the refraction of paths to ice and snow, in excess of
that of paths to rock. Three more depend on azimuth: tilt along the line of sight (knots
every 1°), refraction and tilt across the line of sight (knots every 5°). The Jacobian of a cell's height is
analytic in the cell's position and the terrain gradient, so it is never stored. These functions and the
covariance stored with an epoch give the uncertainty of a cell, a box, a volume or a difference.
Source: equations.md, 6.1 and 6.2.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import sparse

from station.grid_plane import STEEPEST_UP
from station.quantities import Bools, Floats, Floats32, Grid, Ints, Reals, SharedParameters
from station.science.geometry.air import EARTH_RADIUS_M
from station.science.uncertainty.parameters import (
    GLOBAL,
    LINE_GROUPS_PER_KNOT,
    TILT_KNOTS_PER_REFRACTION,
    ParameterLayout,
    knot_interpolation,
)


class EnclosingKnots(NamedTuple):
    """The two knots that enclose each of n cells, and the weight of the upper one."""

    lower: Ints  # (n,)
    upper: Ints  # (n,)
    fraction: Reals  # (n,)

    def interpolate(self, at_knots: Reals) -> Reals:
        """Return values at the cells (..., n), linearly interpolated between knots (..., k)."""
        return np.asarray(
            at_knots[..., self.lower] * (1 - self.fraction) + at_knots[..., self.upper] * self.fraction
        )


@dataclass(frozen=True)
class HeightJacobian:
    """Jacobian J of n cell heights with respect to the shared parameters, without its zeros.

    A cell's height depends on the ten globals, the tilt of its scan line, and the two enclosing knots of
    refraction and of cross tilt.
    """

    params: ParameterLayout
    pose: Reals  # (10, n)
    sight_tilt: Reals  # (n,) per rad
    refraction: Reals  # (n,) per unit of k
    cross_tilt: Reals  # (n,) per rad of rotation about the head's viewing direction
    knot_position: Reals  # (n,) fractional index of the sight-tilt knot

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.sight_tilt)

    @property
    def gradient(self) -> Reals:
        """Gradient of the ground along x and y of the grid (2, n) [1]."""
        x, y, down = self.params.plane.in_grid_axes((self.pose[3], self.pose[4], self.pose[5]))
        return np.asarray(np.stack([x, y]) / -down)

    @property
    def tan_slope(self) -> Reals:
        """Tangent of the slope of the ground (n,) [1]; overhangs count as vertical."""
        return np.asarray(np.hypot(*self.pose[3:5] / np.maximum(-self.pose[5], STEEPEST_UP)))

    @cached_property
    def line(self) -> Ints:
        """Scan-line group (n,) of each cell."""
        return (self.knot_position * LINE_GROUPS_PER_KNOT).astype(np.int64)

    def tilt_interpolation(self) -> EnclosingKnots:
        """Return the sight-tilt knots that enclose each cell."""
        lower = self.knot_position.astype(np.int64)
        return EnclosingKnots(lower, (lower + 1) % self.params.sight_tilt_knots, self.knot_position - lower)

    def refraction_interpolation(self) -> EnclosingKnots:
        """Return the refraction knots that enclose each cell; cross tilt has the same knots."""
        lower = self.knot_position.astype(np.int64) // TILT_KNOTS_PER_REFRACTION
        return EnclosingKnots(
            lower,
            (lower + 1) % self.params.refraction_knots,
            self.knot_position / TILT_KNOTS_PER_REFRACTION - lower,
        )

    def _knot_series(self) -> Iterator[tuple[slice, Reals, EnclosingKnots]]:
        """Yield the parameters, the derivatives (n,) and the enclosing knots of each knot series."""
        refraction = self.refraction_interpolation()
        yield from zip(
            self.params.knot_slices,
            (self.sight_tilt, self.refraction, self.cross_tilt),
            (self.tilt_interpolation(), refraction, refraction),
            strict=True,
        )

    def to_sparse(self) -> sparse.csr_array:
        """Return J (n, p) as a sparse matrix."""
        count = len(self)
        row = np.arange(count)
        rows, values = [np.tile(row, len(GLOBAL))], [self.pose.ravel()]
        columns = [np.repeat(np.arange(len(GLOBAL)), count)]
        for series, derivative, (lower, upper, fraction) in self._knot_series():
            rows += [row, row]
            columns += [series.start + lower, series.start + upper]
            values += [derivative * (1 - fraction), derivative * fraction]
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return sparse.csr_array(entries, shape=(count, len(self.params.names)))

    def line_tilt_to_sparse(self) -> sparse.csr_array:
        """Return the derivatives of the heights by the line tilts (n, line_groups) as a sparse matrix."""
        entries = self.sight_tilt, (np.arange(len(self)), self.line)
        return sparse.csr_array(entries, shape=(len(self), self.params.line_groups))

    def effect(self, parameters: Floats) -> Reals:
        """Return the effect J x of parameters x (p,) on the heights (n,) [m]."""
        effect = parameters[: len(GLOBAL)] @ self.pose
        for series, derivative, knots in self._knot_series():
            effect = effect + derivative * knots.interpolate(parameters[series])
        return np.asarray(effect)

    def aggregate(self, weights: Floats) -> Floats:
        """Return the Jacobian (p,) of a weighted sum of heights: g = Jᵀ a.

        Source: equations.md, 6.2.
        """
        parts: list[Floats] = [self.pose @ weights]
        for series, derivative, (lower, upper, fraction) in self._knot_series():
            effect = derivative * weights
            knots = np.concatenate([lower, upper])
            shares = np.concatenate([effect * (1 - fraction), effect * fraction])
            parts.append(_sums(knots, shares, series.stop - series.start))
        return np.concatenate(parts)

    def aggregate_by_line(self, weights: Floats) -> Floats:
        """Return the derivatives of a weighted sum of heights by the line tilts (line_groups,)."""
        return _sums(self.line, self.sight_tilt * weights, self.params.line_groups)

    def take(self, selection: Bools | Ints | slice) -> HeightJacobian:
        """Return the Jacobian of the selected cells."""
        columns = (
            column[selection]
            for column in (self.sight_tilt, self.refraction, self.cross_tilt, self.knot_position)
        )
        return HeightJacobian(self.params, self.pose[:, selection], *columns)

    def scaled(self, factor: Reals) -> HeightJacobian:
        """Return the Jacobian of heights times a factor (n,)."""
        return replace(
            self,
            pose=self.pose * factor,
            sight_tilt=self.sight_tilt * factor,
            refraction=self.refraction * factor,
            cross_tilt=self.cross_tilt * factor,
        )

    def variance(self, shared: SharedParameters) -> Reals:
        """Return the systematic variance of cell heights (n,) [m²]: diag(J C Jᵀ) plus line-tilt variance.

        Fastest for cells in the order in which the head passes them.
        """
        params, knot = self.params, self.knot_position.astype(np.int16)
        if not len(knot):
            return np.zeros_like(self.sight_tilt)
        if np.any(knot[1:] < knot[:-1]):
            variance_m2, order = np.empty_like(self.sight_tilt), np.argsort(knot, kind="stable")
            variance_m2[order] = self.take(order).variance(shared)
            return variance_m2
        columns = self._columns()
        weighted = np.empty_like(columns)
        edges = [0, *(np.flatnonzero(knot[1:] > knot[:-1]) + 1).tolist(), len(knot)]
        active = params.active_parameters(knot[edges[:-1]].astype(np.int64))
        covariances = shared.covariance[active[:, :, None], active[:, None, :]].astype(columns.dtype)
        for covariance, (first, end) in zip(covariances, pairwise(edges), strict=True):
            np.matmul(covariance, columns[:, first:end], out=weighted[:, first:end])
        # Rounding may make it negative where the covariance is singular.
        knot_m2 = np.maximum(np.einsum("ij,ij->j", columns, weighted), 0.0)
        lines = slice(int(knot[0]) * LINE_GROUPS_PER_KNOT, (int(knot[-1]) + 1) * LINE_GROUPS_PER_KNOT)
        line_rad2 = (
            knot_interpolation(params).residual_projector[lines] ** 2 @ line_tilt_variance(params, shared)
        ).astype(columns.dtype)
        return np.asarray(self.sight_tilt**2 * line_rad2[self.line - lines.start] + knot_m2)

    def covariance(self, shared: SharedParameters) -> Floats:
        """Return the systematic covariance of cell heights (n, n) [m²]: J C Jᵀ plus that of line tilts."""
        design = self.to_sparse()
        lines = self.line_tilt_to_sparse() @ knot_interpolation(self.params).residual_projector
        line_m2 = (lines * line_tilt_variance(self.params, shared)) @ lines.T
        return np.asarray(design @ (design @ shared.covariance).T + line_m2, np.float64)

    def _columns(self) -> Reals:
        """Return the non-zero columns of J (16, n), in the order of `ParameterLayout.active_parameters`."""
        pose_count = len(GLOBAL)
        columns = np.empty((pose_count + 6, len(self)), self.sight_tilt.dtype)
        columns[:pose_count] = self.pose
        # Unlike `_knot_series` this stays in the precision of the cells, and skips the indices of the knots.
        tilt, refraction = self.knot_position, self.knot_position / TILT_KNOTS_PER_REFRACTION
        effects = (self.sight_tilt, tilt), (self.refraction, refraction), (self.cross_tilt, refraction)
        lower_columns, upper_columns = columns[pose_count::2], columns[pose_count + 1 :: 2]
        for (effect, position), lower, upper in zip(effects, lower_columns, upper_columns, strict=True):
            np.multiply(effect, position - np.floor(position), out=upper)
            np.subtract(effect, upper, out=lower)
        return columns


def _sums(index: Ints, values: Reals, count: int) -> Floats:
    """Return the sums (count,) of the values with the same index."""
    return np.asarray(np.bincount(index, values, count), dtype=np.float64)


def line_tilt_variance(params: ParameterLayout, shared: SharedParameters) -> Floats:
    """Variance (line_groups,) of the tilt of each line group that the knots do not represent [rad²].

    It is independent from line group to line group.
    """
    by_interval = shared.line_tilt_variance[len(GLOBAL) : len(GLOBAL) + params.knot_intervals]
    return np.repeat(by_interval, LINE_GROUPS_PER_KNOT)


def height_jacobian(
    params: ParameterLayout,
    offset_m: tuple[Reals, Reals, Reals],
    east_gradient: Reals,
    north_gradient: Reals,
    knot_position: Reals | None = None,
    rock: Bools | None = None,
) -> HeightJacobian:
    """Return the Jacobian of the heights of cells at `offset_m` (each (n,)) from the scanner, on the grid.

    `knot_position` (n,) skips its computation where it is known already. `rock` (n,) marks ground that
    is no ice or snow; by default there is none. Signs: scanner state minus assumed state.
    Source: equations.md, 6.1.
    """
    x_m, y_m, z_m = params.plane.in_map_axes(offset_m)
    # The vector against the normal of the ground: on the map its gradient, and -1.
    east, north, down = params.plane.in_map_axes((east_gradient, north_gradient, -1.0))
    up = -down
    horizontal_m2 = x_m**2 + y_m**2  # np.hypot takes five times as long
    range_m2 = horizontal_m2 + z_m**2
    horizontal_m = np.maximum(np.sqrt(horizontal_m2), 1e-6)
    slope_m = east * x_m + north * y_m
    normal_m = up * z_m - slope_m  # n_u · P
    rise_m = up * horizontal_m + z_m * slope_m / horizontal_m  # F
    refraction_m = horizontal_m * rise_m / (2 * EARTH_RADIUS_M)
    rotation_m = (
        -(up * y_m + north * z_m),
        up * x_m + east * z_m,
        east * y_m - north * x_m,
    )
    # A rotation about the line of sight does not move the point. The line of sight has the components
    # `radial_m` normal to the head's axis and `axial_m` along it: the effects of rotating about both cancel.
    u = params.axis
    axial_m = u[0] * x_m + u[1] * y_m + u[2] * z_m
    about_axis_m = u[0] * rotation_m[0] + u[1] * rotation_m[1] - u[2] * rotation_m[2]
    radial_m = np.sqrt(np.maximum(range_m2 - axial_m**2, 1e-12))
    return HeightJacobian(
        params=params,
        pose=np.stack(
            [
                *rotation_m,
                east,
                north,
                np.full_like(x_m, down),
                normal_m / np.sqrt(np.maximum(range_m2, 1e-12)),
                normal_m * 1e-6,
                refraction_m,
                refraction_m * (True if rock is None else ~rock),
            ]
        ),
        sight_tilt=-rise_m,
        refraction=refraction_m,
        cross_tilt=-axial_m * about_axis_m / radial_m,
        knot_position=params.knot_position(offset_m) if knot_position is None else knot_position,
    )


def cell_jacobian(
    params: ParameterLayout,
    grid: Grid,
    position_m: tuple[float, float, float],
    elevation_m: Floats | Floats32,
    gradient: tuple[Floats32, Floats32],
    selection: Bools,
    rock: Bools | None = None,
) -> HeightJacobian:
    """Return the Jacobian of the heights of the selected cells (ny, nx) of a surface, in row-major order.

    `rock` (n,) marks those that are no ice or snow; by default there are none.
    """
    row, column = np.nonzero(selection)
    east, north = (np.nan_to_num(component[row, column].astype(np.float64)) for component in gradient)
    offset_m = (
        grid.x_m[column] - position_m[0],
        grid.y_m[row] - position_m[1],
        elevation_m[row, column].astype(np.float64) - position_m[2],
    )
    return height_jacobian(params, offset_m, east, north, rock=rock)


def sight_tilt_of(azimuth_rad: Floats) -> Floats:
    """Return the sight tilt (lines, 2) for a unit tilt about east and about north."""
    return np.stack([np.cos(azimuth_rad), -np.sin(azimuth_rad)], axis=-1)
