"""Several scans on one grid: mean height, random variance, roughness, intensity and visibility."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from station.science.geometry.terrain import row_blocks
from station.science.gridding.gridder import CellSums, Gridder

if TYPE_CHECKING:
    from station.quantities import Floats, Floats32, Grid, Ints32, Reals

MAX_DEVIATION_SIGMAS = 6.0  # deviations of a scan are clipped here: larger ones are real change
CLASS_DEGREES_OF_FREEDOM = 10.0  # weight of a cell's class against the cell's own scatter
NEIGHBOURHOOD_CELLS = 9  # edge of the square whose mean is what scans share beyond a cell
MAX_POINT_COUNT = 60_000.0  # stored in two bytes
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
        self._intensity_sum, self._intensity_count, self._observed = (
            np.zeros(grid.shape, np.float32) for _ in range(3)
        )
        self._mean, self._mean_variance = (np.zeros(grid.shape, np.float32) for _ in range(2))
        self._deviation, self._squared_deviation, self._deviation_variance = (
            np.zeros(grid.shape, np.float32) for _ in range(3)
        )
        self._scans = 0

    def add(
        self,
        gridder: Gridder,
        known: tuple[Floats32, Floats32] | None = None,
        roughness_m2: Floats32 | None = None,
    ) -> None:
        """Add a scan.

        `known`, on a reference: random variance of a shot [m²] and correction to subtract from heights [m].
        With the `roughness_m2` of that reference, the scatter of the scans is summed too. All (ny, nx). Cells
        that a reference lacks are left out: most of them are echoes of the air, elsewhere in each scan.
        """
        self._scans += 1
        for rows in row_blocks(self.grid.ny):
            halo = NEIGHBOURHOOD_CELLS // 2 if roughness_m2 is not None else 0
            window = slice(max(rows.start - halo, 0), min(rows.stop + halo, self.grid.ny))
            inner = slice(rows.start - window.start, rows.stop - window.start)
            sums = gridder.rasters(window)
            shot_m2, correction_m = (
                (block[window] for block in known) if known else np.zeros((2, *sums.count.shape))
            )
            mean_m = sums.mean_residual() - correction_m
            self._add(rows, sums.rows(inner), mean_m[inner], shot_m2[inner])
            if roughness_m2 is not None:
                variance_m2 = (shot_m2 + roughness_m2[window]) / np.maximum(sums.count, 1)
                self._add_scatter(rows, inner, mean_m, variance_m2)

    def shift(self, height_m: Floats32) -> None:
        """Raise all scans by a height (ny, nx) [m]."""
        self._residual += height_m * self.count
        self._mean += height_m * self._observed

    def _add(self, rows: slice, sums: CellSums, mean_m: Floats, shot_m2: Reals) -> None:
        count = sums.count.astype(np.float32)
        self._observed[rows] += count > 0
        self.count[rows] += count
        self._residual[rows] += np.nan_to_num(mean_m) * count
        self._mean[rows] += np.nan_to_num(mean_m)
        intensity = sums.intensity()
        weight = np.where(np.isfinite(intensity), count, np.float32(0))
        self._intensity_sum[rows] += np.nan_to_num(intensity) * weight
        self._intensity_count[rows] += weight
        self._variance[rows] += shot_m2 * count
        degrees_of_freedom = np.maximum(count - 1, 0)
        self._within[rows] += np.nan_to_num(sums.standard_deviation()) ** 2 * degrees_of_freedom
        self._degrees_of_freedom[rows] += degrees_of_freedom

    def _add_scatter(self, rows: slice, inner: slice, mean_m: Floats, variance_m2: Reals) -> None:
        """Add the deviations of a scan's cells from those around, which its shared errors do not cause.

        Of the mean of a cell, a deviation lacks what the mean of its neighbourhood contains of the cell; a
        cell without others around it has none. Source: equations.md, 6.21.
        """
        observed = np.isfinite(mean_m)
        share = ndimage.uniform_filter(observed.astype(np.float64), NEIGHBOURHOOD_CELLS, mode="constant")
        local_m = ndimage.uniform_filter(np.nan_to_num(mean_m), NEIGHBOURHOOD_CELLS, mode="constant")
        own_share = 1 / np.maximum(share * NEIGHBOURHOOD_CELLS**2, 1.0)
        with np.errstate(invalid="ignore"):
            deviation_m = (mean_m - local_m / np.maximum(share, 1e-9))[inner]
        observed = observed[inner]
        limit_m = MAX_DEVIATION_SIGMAS * np.sqrt(variance_m2[inner])
        deviation_m = np.clip(np.nan_to_num(deviation_m), -limit_m, limit_m)
        self._deviation[rows] += deviation_m
        self._squared_deviation[rows] += deviation_m**2
        observed_m2 = np.where(observed, variance_m2[inner], 0.0)
        self._mean_variance[rows] += observed_m2
        self._deviation_variance[rows] += observed_m2 * (1 - own_share[inner])

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

    def point_count(self) -> NDArray[np.float16]:
        """Mean number of points of each cell in the scans that observed it (ny, nx); NaN in empty cells."""
        return np.minimum(self._per_scan(self.count), MAX_POINT_COUNT).astype(np.float16)

    def visibility(self) -> Floats32:
        """Share of the scans that observed each cell (ny, nx) [1]."""
        return self._observed / np.float32(max(self._scans, 1))

    def variance_factor(self, classes: Ints32) -> Floats32:
        """Random variance of cells from scan to scan, empirical over modelled (ny, nx) [1].

        It is shrunk towards that of the cell's class, of `classes` (ny, nx) counted from 0: the scatter of a
        cell's few scans is weighted against `CLASS_DEGREES_OF_FREEDOM` of its class. It is 1 without data.
        """
        class_count = int(classes.max()) + 1
        scatter, freedom = np.zeros((2, class_count))
        for rows in row_blocks(self.grid.ny):
            ratio, degrees = self._scatter(rows)
            scatter += np.bincount(classes[rows].ravel(), (ratio * degrees).ravel(), class_count)
            freedom += np.bincount(classes[rows].ravel(), degrees.ravel(), class_count)
        prior = CLASS_DEGREES_OF_FREEDOM
        of_class = ((scatter + prior) / (freedom + prior)).astype(np.float32)
        factor = np.empty(self.grid.shape, np.float32)
        for rows in row_blocks(self.grid.ny):
            ratio, degrees = self._scatter(rows)
            factor[rows] = (prior * of_class[classes[rows]] + ratio * degrees) / (degrees + prior)
        return factor

    def _scatter(self, rows: slice) -> tuple[Floats32, Floats32]:
        """Return variance over scans of the deviations, over the modelled one, and its degrees of freedom."""
        observed, expected_m2 = self._observed[rows], self._deviation_variance[rows]
        degrees = np.where(expected_m2 > 0, np.maximum(observed - 1, 0), np.float32(0))
        scatter_m2 = self._squared_deviation[rows] - self._deviation[rows] ** 2 / np.maximum(observed, 1)
        ratio = np.zeros(degrees.shape, np.float32)
        np.divide(scatter_m2 * observed, expected_m2 * degrees, out=ratio, where=degrees > 0)
        return ratio, degrees.astype(np.float32)

    def scan_mean(self) -> Floats32:
        """Mean over the scans of their mean heights above the reference (ny, nx) [m], NaN in empty cells."""
        return self._per_scan(self._mean)

    def scan_mean_variance(self) -> Floats32:
        """Modelled random variance of `scan_mean` (ny, nx) [m²], NaN in empty cells."""
        return self._per_scan(self._per_scan(self._mean_variance))

    def _per_scan(self, values: Floats32) -> Floats32:
        per_scan = np.full_like(values, np.nan)
        np.divide(values, self._observed, out=per_scan, where=self._observed > 0)
        return per_scan

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
