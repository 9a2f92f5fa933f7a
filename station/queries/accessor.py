"""`ds.station`: queries of a dataset that `station.open` returned, for the epochs it contains."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import shapely
import xarray as xr

from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL
from station.archive.epochs import EpochRef
from station.archive.series.index import list_epochs, processing_file, series_in
from station.archive.series.lazy import open_virtual
from station.errors import StationError
from station.queries.grid_arrays import to_grid, to_mask
from station.queries.volumes import Volumes

if TYPE_CHECKING:
    from station.queries.grid_arrays import Epoch

SAME_TIME_S = 1.0  # times of the dataset and of the store that differ less are of one epoch
POINT_VARIABLES = (CHANGE, TOTAL, RANDOM, "point_count", "quality")


@xr.register_dataset_accessor("station")  # type: ignore[no-untyped-call]
class StationAccessor:
    """Variances, volumes, differences and points of the epochs of a dataset, from its store."""

    def __init__(self, ds: xr.Dataset) -> None:
        self._ds = ds

    @cached_property
    def _volumes(self) -> Volumes:
        return Volumes(series_in(self._store))

    @cached_property
    def _store(self) -> Path:
        """Folder of the store; raises StationError if the dataset was not read from `series.nc`."""
        source = self._ds.encoding.get("source")
        if source is None:
            raise StationError(
                "this dataset does not know its store: use ds.station on what station.open returned, or on a"
                " selection of it; or call station.variance(folder, ...)"
            )
        if Path(source).name != "series.nc":
            raise StationError(
                f"{source}: has no reference surface, without which the variance of a sum cannot be computed:"
                " use ds.station on station.open(folder of the station), or call"
                " station.variance(folder, weights, ds.time[0]); boxes.nc and daily.nc have the uncertainty"
                " of blocks, and the comment of elevation_change_uncertainty a safe bound"
            )
        return Path(source).parent

    @property
    def processing(self) -> xr.Dataset:
        """How the epochs of the dataset were processed, lazily: the content of `processing.nc`."""
        path = processing_file(series_in(self._store))
        return open_virtual(path).sel(time=self._ds["time"])

    def variance(self, weights: npt.ArrayLike | xr.DataArray) -> xr.DataArray:
        """Return the variance of a weighted sum of elevation change in each epoch [m² times squared weights].

        `weights` are those of `station.variance`: of a mask, the variance of the mean of its cells.
        """
        on_grid = to_grid(weights, self._volumes.grid)
        return self._over_time("variance", "m2", lambda epoch: self._volumes.variance(on_grid, epoch))

    def volume(self, area: str | npt.ArrayLike | xr.DataArray | shapely.Geometry) -> xr.Dataset:
        """Return the volume change of an area in each epoch with its uncertainty [m³], as in `areas.nc`.

        `area` is that of `station.volume`: a name, a mask, or a polygon in map coordinates.
        """
        cells = to_mask(area, self._volumes.series)
        size_m2 = np.count_nonzero(cells) * self._volumes.grid.cell_m**2
        changes = {}

        def volume_change(epoch: EpochRef) -> float:
            changes[epoch] = self._volumes.area(cells, epoch)
            return changes[epoch].mean_m * size_m2

        def volume_sigma(epoch: EpochRef) -> float:
            return changes[epoch].mean_sigma_m * size_m2

        variables = [
            self._over_time("volume_change", "m3", volume_change),
            self._over_time("volume_change_uncertainty", "m3", volume_sigma),
            self._over_time("coverage", "1", lambda epoch: changes[epoch].coverage),
        ]
        return xr.Dataset({variable.name: variable for variable in variables})

    def between(self, epoch: Epoch, epoch2: Epoch) -> xr.Dataset:
        """Return the elevation change of each cell from an epoch to a second one, with its uncertainty [m].

        An epoch is an index in the series or a time, as in `station.variance`.
        """
        first, second = self._volumes.find_epoch(epoch), self._volumes.find_epoch(epoch2)
        return self._volumes.change_between(second, first)

    def at(self, x: float, y: float) -> xr.Dataset:
        """Return the series of the cell that contains a point in map coordinates, with its uncertainty [m].

        Raises StationError if the point is outside the dataset.
        """
        reach_m = self._volumes.grid.cell_m * (0.5 + 1e-9)
        names = [name for name in POINT_VARIABLES if name in self._ds]
        try:
            return self._ds[names].sel(x=x, y=y, method="nearest", tolerance=reach_m)
        except KeyError as error:
            raise StationError(f"no cell at x={x}, y={y}: the point is outside the dataset") from error

    def error_structure(self) -> xr.Dataset:
        """Return change and errors of the cells of a dataset with one epoch, and their correlations [m].

        In the form of obsarray, which then forms covariances, and with punpy propagates them. Raises
        StationError if the dataset has several epochs or too many cells.
        """
        if len(self._epochs) != 1:
            raise StationError(
                f"the dataset has {len(self._epochs)} epochs: select one, with .isel(time=...)"
            )
        grid, x_m, y_m = self._volumes.grid, self._ds["x"].values, self._ds["y"].values
        cells = np.zeros(grid.shape, np.bool_)
        cells[np.ix_(np.isin(grid.y_m, y_m), np.isin(grid.x_m, x_m))] = True
        return self._volumes.error_structure(cells, self._epochs[0])

    def _over_time(self, name: str, units: str, value: Callable[[EpochRef], float]) -> xr.DataArray:
        """Return a value of each epoch of the dataset."""
        time = self._ds["time"]
        values = np.array([value(epoch) for epoch in self._epochs]).reshape(time.shape)
        return xr.DataArray(values, {"time": time}, time.dims, name=name, attrs={"units": units})

    @cached_property
    def _epochs(self) -> list[EpochRef]:
        """Epochs of the dataset; raises StationError if the store has none at a time of it."""
        stored = list_epochs(self._volumes.series)
        stored_s = np.array([epoch.time_s for epoch in stored])
        times = np.atleast_1d(self._ds["time"].values)
        time_s = (times - np.datetime64(0, "s")) / np.timedelta64(1, "s")
        position = np.minimum(np.searchsorted(stored_s, time_s - SAME_TIME_S), len(stored) - 1)
        lost = np.flatnonzero(np.abs(stored_s[position] - time_s) > SAME_TIME_S)
        if len(lost):
            raise StationError(f"the store has no epoch at {times[lost[0]]}: was the time changed?")
        return [stored[index] for index in position]
