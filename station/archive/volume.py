"""Volumes between epochs and where their uncertainty comes from; what is not known of single points."""

from __future__ import annotations

import netCDF4
import numpy as np
import numpy.typing as npt
import shapely
import xarray as xr

from station.archive.aggregate import CHANGE, Aggregates, Held, cell_values, common_of, seen_in_all
from station.archive.store import Row
from station.errors import StoreError
from station.quantities import Bools, Floats, Grid, Scanner
from station.science.points import shared_covariance, shot_covariance
from station.science.shared import against, basis
from station.science.voids import area_weights
from station.science.volume import common_contributions, shared_contributions


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
        """Volume of the change over cells (ny, nx) in an epoch, or from a second one to it.

        As in `areas.nc`: cells without a change are interpolated; `coverage` is the share of the others.
        Three sigmas [m³]: with everything; of that the cells' own; and as published, the whole errors of
        cells each their own. The maps hold the share of each cell in the variance of what was seen, and in
        the published one; each sums up to 1. Raises StoreError where nothing was seen.
        """
        held = self._held(cells, row, other)
        chosen = seen_in_all(held, cells)
        if not chosen.any():
            raise StoreError(f"{row.path}: none of the {np.count_nonzero(cells)} cells has a change")
        size_m2 = self._series.grid.cell_m**2 * np.count_nonzero(cells)
        weights_m2 = size_m2 * area_weights(cells, chosen)[0][chosen]
        own, shared = self._contributions(held, chosen, weights_m2, self._random(held, chosen, chosen[cells]))
        sigmas_m = [self._sigma(one, chosen) for one in ([row] if other is None else [row, other])]
        published = weights_m2**2 * sum(sigma_m**2 for sigma_m in sigmas_m)
        found = self.area(cells, row, other)

        def volume(value_m3: float) -> tuple[tuple[()], float, dict[str, str]]:
            return (), value_m3, {"units": "m3"}

        def on_map(values: Floats) -> tuple[tuple[str, str], Floats, dict[str, str]]:
            share = np.full(cells.shape, np.nan)
            share[chosen] = values / values.sum()
            return ("y", "x"), share, {"units": "1"}

        return xr.Dataset(
            {
                "volume_change": volume(found.mean_m * size_m2),
                "volume_change_uncertainty": volume(found.mean_sigma_m * size_m2),
                "volume_change_random_uncertainty": volume(float(np.sqrt(own.sum()))),
                "volume_change_uncertainty_hartzell2015": volume(float(np.sqrt(published.sum()))),
                "area_size": ((), size_m2, {"units": "m2"}),
                "coverage": ((), found.coverage, {"units": "1"}),
                "variance_share": on_map(own + shared),
                "variance_share_hartzell2015": on_map(published),
            },
            {"y": self._series.grid.y_m, "x": self._series.grid.x_m},
        )

    def _sigma(self, row: Row, chosen: Bools) -> Floats:
        """One sigma of chosen cells (n,) in an epoch, everything included [m]."""
        with netCDF4.Dataset(row.path) as file:
            return cell_values(file[f"{CHANGE}_uncertainty"], row.index, chosen)

    def _contributions(
        self, held: list[Held], chosen: Bools, weights: Floats, random_m2: list[Floats]
    ) -> tuple[Floats, Floats]:
        """What each chosen cell (n,) adds to the variance of a weighted sum: its own, the shared."""
        own, shared, felt_by = np.zeros(len(weights)), np.zeros(len(weights)), []
        for one, own_m2 in zip(held, random_m2, strict=True):
            own += weights**2 * own_m2
            unknown = one.unknown
            if unknown is None:
                continue
            if len(held) == 1 and not one.adjusted:
                unknown = against(unknown, one.reference.shared)
            felt = self.felt(one, chosen)
            noise = self.held_share(one, chosen, felt, own_m2) if len(held) > 1 else None
            felt_by.append(felt)
            shared += shared_contributions(weights, felt, unknown, noise)
        common = common_of(held)
        if common is not None:
            shared -= common_contributions(weights, (felt_by[0], felt_by[1]), common)
        return own, shared

    def point_covariance(self, points_m: Floats, row: Row, scanner: Scanner) -> Floats:
        """Covariance (n, 3, 3) of points (n, 3) on the map in an epoch [m²]: shot, pose, lean, air.

        Raises StoreError where the epoch does not say what its points share.
        """
        held = self.read(row, np.zeros(self._series.grid.shape, np.bool_))
        if held.unknown is None:
            raise StoreError(f"{row.path}: the epoch holds nothing of the scanner: its scan came on the map")
        position_m, (east, north) = held.scanner[:3], held.scanner[3:]
        axis = east, north, float(np.sqrt(max(1 - east**2 - north**2, 0.0)))
        offset_m = points_m - np.array(position_m)
        of = basis(self._series.grid, (position_m[0], position_m[1], position_m[2]), axis)
        own_m2 = shot_covariance(offset_m, np.array(axis), scanner)
        return own_m2 + shared_covariance(of, offset_m, held.unknown)
