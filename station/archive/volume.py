"""Volumes between epochs and where their uncertainty comes from; what is not known of single points."""

from __future__ import annotations

import netCDF4
import numpy as np
import numpy.typing as npt
import shapely
import xarray as xr

from station.archive.aggregate import CHANGE, Aggregates
from station.archive.store import Row
from station.errors import StoreError
from station.quantities import Bools, Floats, Grid, Scanner
from station.science.points import shared_covariance, shot_covariance
from station.science.shared import against, basis
from station.science.volume import contributions


def cells_of(area: npt.ArrayLike | shapely.Geometry, grid: Grid) -> Bools:
    """Cells (ny, nx) of an area: given as such, or those with their centre in a polygon on the map."""
    if isinstance(area, shapely.Geometry):
        shapely.prepare(area)
        return np.asarray(shapely.contains_xy(area, grid.x_m[None, :], grid.y_m[:, None]))
    cells = np.asarray(area, np.bool_)
    if cells.shape != grid.shape:
        raise ValueError(f"an area of {cells.shape} cells on a grid of {grid.shape}")
    return cells


class Volumes(Aggregates):
    """Volumes of the epochs of a store, and the covariance of their points."""

    def change(self, cells: Bools, row: Row, other: Row | None = None) -> xr.Dataset:
        """Volume of the change over cells (ny, nx) in an epoch, or of the difference to a second one.

        Only cells with a change count; `coverage` is their share. Three sigmas [m³]: with all that cells
        share; of that the random part; and as published, the cells' errors each their own. The maps hold the
        share of each cell in the variance, with what cells share and as published; each sums up to 1.
        """
        epochs = [row] if other is None else [row, other]
        read = [self._rasters(one) for one in epochs]
        seen = cells & np.logical_and.reduce([np.isfinite(change_m) for change_m, _ in read])
        if not seen.any():
            raise StoreError(f"{row.path}: none of the {np.count_nonzero(cells)} cells has a change")
        area_m2 = self._series.grid.cell_m**2
        change_m = read[0][0] - (0.0 if other is None else read[1][0])
        independent = np.where(seen, area_m2**2 * sum(sigma_m**2 for _, sigma_m in read), np.nan)
        own, shared = self._shares(seen, epochs)
        variance = self.variance(np.where(seen, area_m2, 0.0), row, other)

        def on_map(values: Floats) -> tuple[tuple[str, str], Floats, dict[str, str]]:
            return ("y", "x"), values / np.nansum(values), {"units": "1"}

        return xr.Dataset(
            {
                "volume_change": ((), float(area_m2 * change_m[seen].sum()), {"units": "m3"}),
                "volume_change_uncertainty": ((), np.sqrt(variance), {"units": "m3"}),
                "volume_change_random_uncertainty": ((), np.sqrt(np.nansum(own)), {"units": "m3"}),
                "volume_change_uncertainty_hartzell2015": (
                    (), np.sqrt(np.nansum(independent)), {"units": "m3"},
                ),
                "area_size": ((), area_m2 * np.count_nonzero(seen), {"units": "m2"}),
                "coverage": ((), np.count_nonzero(seen) / np.count_nonzero(cells), {"units": "1"}),
                "variance_share": on_map(own + shared),
                "variance_share_hartzell2015": on_map(independent),
            },
            {"y": self._series.grid.y_m, "x": self._series.grid.x_m},
        )  # fmt: skip

    def _rasters(self, row: Row) -> tuple[Floats, Floats]:
        """Change and sigma (ny, nx) of an epoch's cells [m]."""
        with netCDF4.Dataset(row.path) as file:
            change_m, sigma_m = (
                np.ma.filled(file[name][row.index].astype(np.float64), np.nan)
                for name in (CHANGE, f"{CHANGE}_uncertainty")
            )
        return change_m, sigma_m

    def _shares(self, seen: Bools, epochs: list[Row]) -> tuple[Floats, Floats]:
        """What each cell (ny, nx) adds to the variance of the volume [m⁶]: its own, the shared."""
        held = [self._read(one, seen) for one in epochs]
        weights = np.full(np.count_nonzero(seen), self._series.grid.cell_m**2)
        total = np.where(seen, np.zeros((2, *seen.shape)), np.nan)
        for one in held:
            random_m2, unknown = one.random_m**2, one.unknown
            if len(held) > 1:  # what one reference does not know is in both and goes
                before_m2 = one.reference.random_variance_m2[seen]
                random_m2 = np.maximum(random_m2 - before_m2, 0.0) + self._apart(held, seen) * before_m2
            elif unknown is not None and not one.adjusted:
                unknown = against(unknown, one.reference.shared)
            if unknown is None:
                total[0, seen] += weights**2 * random_m2
            else:
                total[:, seen] += contributions(weights, random_m2, self._felt(one, seen), unknown)
        return total[0], total[1]

    def point_covariance(self, points_m: Floats, row: Row, scanner: Scanner) -> Floats:
        """Covariance (n, 3, 3) of points (n, 3) on the map in an epoch [m²]: shot, pose, lean, air.

        Raises StoreError where the epoch does not say what its points share.
        """
        held = self._read(row, np.zeros(self._series.grid.shape, np.bool_))
        if held.unknown is None:
            raise StoreError(f"{row.path}: the epoch holds nothing of the scanner: its scan came on the map")
        position_m, (east, north) = held.scanner[:3], held.scanner[3:]
        axis = east, north, float(np.sqrt(max(1 - east**2 - north**2, 0.0)))
        offset_m = points_m - np.array(position_m)
        of = basis(self._series.grid, (position_m[0], position_m[1], position_m[2]), axis)
        own_m2 = shot_covariance(offset_m, np.array(axis), scanner)
        return own_m2 + shared_covariance(of, offset_m, held.unknown)
