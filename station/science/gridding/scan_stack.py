"""Several scans on one grid: mean height, random variance, roughness, intensity and visibility."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from station.science.geometry.terrain import row_blocks
from station.science.gridding.gridder import CellSums, Gridder

if TYPE_CHECKING:
    from station.quantities import Floats, Floats32, Grid, Ints32, Reals

MAX_STEP_SIGMAS = 6.0  # steps between scans are clipped here: larger ones are real change
CLASS_STEPS = 10.0  # weight of a cell's class, in steps of the cell from scan to scan
ROUGHNESS_CELLS = 1.0  # one sigma of the Gaussian that roughness is pooled with


class ScanStack:
    """Several scans on one grid; scatter within a scan, free of its shared errors, is summed separately.

    Scans are added in blocks of rows, so that the grid's memory is not needed several times.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self._residual = np.zeros(grid.shape)
        self.count, self._variance, self._within, self._degrees_of_freedom = (
            np.zeros(grid.shape, np.float32) for _ in range(4)
        )
        self._intensity_sum, self._intensity_count, self._steps, self._pairs, self._visibility = (
            np.zeros(grid.shape, np.float32) for _ in range(5)
        )
        self._scans = 0
        self._last: Floats32 | None = None  # (2, ny, nx): mean of the previous scan, and its variance

    def add(
        self,
        gridder: Gridder,
        known: tuple[Floats32, Floats32] | None = None,
        roughness_m2: Floats32 | None = None,
    ) -> None:
        """Add a scan.

        `known`, on a reference: random variance of a shot [m²] and correction to subtract from heights [m].
        With the `roughness_m2` of that reference, scans are also compared with each other. All (ny, nx).
        """
        self._scans += 1
        if roughness_m2 is not None and self._last is None:
            self._last = np.full((2, *self.grid.shape), np.nan, np.float32)
        for rows in row_blocks(self.grid.ny):
            sums = gridder.rasters(rows)
            count = sums.count.astype(np.float32)
            shot_m2, correction_m = (block[rows] for block in known) if known else np.zeros((2, *count.shape))
            mean_m = sums.mean_residual() - correction_m
            self._add(rows, sums, count, mean_m, shot_m2)
            if roughness_m2 is not None:
                variance_m2 = (shot_m2 + roughness_m2[rows]) / np.maximum(count, 1)
                self._compare(rows, mean_m.astype(np.float32), variance_m2.astype(np.float32))

    def _add(self, rows: slice, sums: CellSums, count: Floats32, mean_m: Floats, shot_m2: Reals) -> None:
        self._visibility[rows] += count > 0
        self.count[rows] += count
        self._residual[rows] += np.nan_to_num(mean_m) * count
        intensity = sums.intensity()
        weight = np.where(np.isfinite(intensity), count, np.float32(0))
        self._intensity_sum[rows] += np.nan_to_num(intensity) * weight
        self._intensity_count[rows] += weight
        self._variance[rows] += shot_m2 * count
        degrees_of_freedom = np.maximum(count - 1, 0)
        self._within[rows] += np.nan_to_num(sums.standard_deviation()) ** 2 * degrees_of_freedom
        self._degrees_of_freedom[rows] += degrees_of_freedom

    def _compare(self, rows: slice, mean_m: Floats32, variance_m2: Floats32) -> None:
        """Add the squared step from the previous scan, relative to its expected variance."""
        assert self._last is not None  # noqa: S101 - the caller's case
        previous_mean_m, previous_variance_m2 = self._last[:, rows]
        expected_m2 = variance_m2 + previous_variance_m2
        compared = np.isfinite(mean_m - previous_mean_m) & (expected_m2 > 0)
        steps = (mean_m - previous_mean_m)[compared] ** 2 / expected_m2[compared]
        self._steps[rows][compared] += np.minimum(steps, MAX_STEP_SIGMAS**2)
        self._pairs[rows][compared] += 1
        previous_mean_m[:], previous_variance_m2[:] = mean_m, variance_m2

    def intensity(self) -> Floats32:
        """Mean intensity of each cell (ny, nx), 0-1; NaN where unknown."""
        intensity = np.full(self.grid.shape, np.nan, np.float32)
        np.divide(
            self._intensity_sum,
            self._intensity_count,
            out=intensity,
            where=self._intensity_count > 0,
            casting="same_kind",
        )
        return intensity

    def visibility(self) -> Floats32:
        """Share of the scans that observed each cell (ny, nx) [1]."""
        return self._visibility / np.float32(max(self._scans, 1))

    def variance_factor(self, classes: Ints32) -> Floats32:
        """Random variance of cells from scan to scan, empirical over modelled (ny, nx) [1].

        It is shrunk towards that of the cell's class, of `classes` (ny, nx) counted from 0: a cell's own few
        steps are weighted against `CLASS_STEPS` of its class. It is 1 without data.
        """
        class_count = int(classes.max()) + 1
        steps, pairs = np.zeros((2, class_count))
        for rows in row_blocks(self.grid.ny):
            steps += np.bincount(classes[rows].ravel(), self._steps[rows].ravel(), class_count)
            pairs += np.bincount(classes[rows].ravel(), self._pairs[rows].ravel(), class_count)
        ratio = ((steps + CLASS_STEPS) / (pairs + CLASS_STEPS)).astype(np.float32)
        factor = CLASS_STEPS * ratio[classes]
        factor += self._steps
        factor /= self._pairs + CLASS_STEPS
        return np.asarray(factor)

    def mean_residual(self) -> Floats:
        """Mean height of all points above reference or datum (ny, nx) [m], NaN in empty cells."""
        return np.asarray(self._per_point(self._residual))

    def roughness(self) -> Floats32:
        """Variance of the terrain about the reference within each cell (ny, nx) [m²].

        It is the scatter of a scan's points in excess of their own errors, pooled with the adjacent cells
        because few points determine a variance poorly; 0 without data.
        """
        excess = self._within - self._per_point(self._variance, empty=0.0) * self._degrees_of_freedom
        excess = ndimage.gaussian_filter(excess, ROUGHNESS_CELLS)
        degrees_of_freedom = ndimage.gaussian_filter(self._degrees_of_freedom, ROUGHNESS_CELLS)
        roughness_m2 = np.zeros(self.grid.shape, np.float32)
        np.divide(
            excess, degrees_of_freedom, out=roughness_m2, where=(degrees_of_freedom > 1e-3) & (self.count > 0)
        )
        return np.maximum(roughness_m2, 0.0, out=roughness_m2)

    def random_variance(self, roughness_m2: Floats32) -> Floats32:
        """Random variance of the mean of all points (ny, nx) [m²], NaN in empty cells.

        Source: Hartzell et al. (2015), Eq. 12, with the roughness as part of each point's variance.
        """
        return self._per_point(self._per_point(self._variance) + roughness_m2)

    def _per_point(self, values: Reals, empty: float = np.nan) -> Reals:
        """Return values per point (ny, nx); `empty` in cells without points."""
        per_point = np.full_like(values, empty)
        np.divide(values, self.count, out=per_point, where=self.count > 0)
        return per_point
