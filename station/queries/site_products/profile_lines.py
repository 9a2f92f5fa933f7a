"""Lines across the grid: samples between its cells, along which profiles and contours are measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import sparse

from station.errors import ConfigError
from station.quantities import Bools, Floats, Grid

COMPLETE = 1 - 1e-9  # sum of the weights of a sample all of whose cells are known


@dataclass(frozen=True)
class Line:
    """Samples (k,) along a line, one for each length of a cell, interpolated between four cells."""

    distance_m: Floats  # from its start
    x_m: Floats
    y_m: Floats
    cells: Bools  # (ny, nx) all that take part
    interpolation: sparse.csr_array  # (k, n) weights of those cells

    def weights(self, observed: Bools) -> tuple[sparse.csr_array, Bools]:
        """Return the weights (k, m) of the observed cells (ny, nx), and which samples (k,) are complete."""
        weights = self.interpolation[:, np.flatnonzero(observed[self.cells])]
        return weights, np.asarray(weights.sum(axis=1)).ravel() > COMPLETE


def sample_line(points_m: Sequence[tuple[float, float]], grid: Grid) -> Line:
    """Return the samples of a line through points (easting, northing) on a grid; those outside are left out.

    Raises ConfigError if less than two are on the grid.
    """
    path = shapely.LineString(points_m)
    distance_m = grid.cell_m * np.arange(int(path.length / grid.cell_m + 1e-6) + 1)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(path, distance_m))
    column, row = (xy[:, 0] - grid.west_m) / grid.cell_m - 0.5, (grid.north_m - xy[:, 1]) / grid.cell_m - 0.5
    inside = (column >= 0) & (column <= grid.nx - 1) & (row >= 0) & (row <= grid.ny - 1)
    if np.count_nonzero(inside) < 2:
        raise ConfigError(f"the line from {points_m[0]} to {points_m[-1]} is not on the grid")
    column, row = column[inside], row[inside]
    west, north = (
        np.minimum(axis, size - 2).astype(np.int64) for axis, size in ((column, grid.nx), (row, grid.ny))
    )
    east_share, south_share = column - west, row - north
    sample, cell, weight = [], [], []
    for down, row_weight in ((0, 1 - south_share), (1, south_share)):
        for right, column_weight in ((0, 1 - east_share), (1, east_share)):
            used = row_weight * column_weight > 0
            sample.append(np.flatnonzero(used))
            cell.append(((north + down) * grid.nx + west + right)[used])
            weight.append((row_weight * column_weight)[used])
    involved, position = np.unique(np.concatenate(cell), return_inverse=True)
    cells = np.zeros(grid.shape, np.bool_)
    cells.ravel()[involved] = True
    interpolation = sparse.csr_array(
        (np.concatenate(weight), (np.concatenate(sample), position)), shape=(len(column), len(involved))
    )
    return Line(distance_m[inside], xy[inside, 0], xy[inside, 1], cells, interpolation)
