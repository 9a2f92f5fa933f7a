"""Arrays that users give, on the grid of a store: weights, masks, polygons; and the epochs they name."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, TypeAlias, TypeGuard

import numpy as np
import numpy.typing as npt
import shapely

from station.archive.areas import area_polygons
from station.archive.netcdf_layout import Series
from station.errors import StationError
from station.quantities import Bools, Floats, Grid

if TYPE_CHECKING:
    import xarray as xr  # half a second that the service does not need

ALIGNED_CELLS = 0.01  # of a cell: coordinates that differ less are the same
Epoch: TypeAlias = "int | str | np.datetime64 | datetime | xr.DataArray"


def to_grid(values: npt.ArrayLike | xr.DataArray, grid: Grid) -> Floats | Bools:
    """Return weights or a mask on the grid (ny, nx), rows from north to south.

    A DataArray is aligned by its coordinates, whatever its order; cells outside it are zero. Raises
    ValueError if it does not fit the grid or contains NaN.
    """
    aligned = _align(values, grid) if _is_data_array(values) else np.asarray(values)
    if aligned.shape != grid.shape:
        raise ValueError(f"the array has shape {aligned.shape}, the grid {grid.shape}")
    if aligned.dtype == np.bool_:
        return aligned.astype(np.bool_)
    weights = aligned.astype(np.float64)
    unknown = np.count_nonzero(np.isnan(weights))
    if unknown:
        raise ValueError(f"{unknown} weights are NaN: give 0 to cells outside, as weights.fillna(0) does")
    return weights


def _is_data_array(value: object) -> TypeGuard[xr.DataArray]:
    return hasattr(value, "dims") and hasattr(value, "values")


def _align(array: xr.DataArray, grid: Grid) -> npt.NDArray[np.generic]:
    if set(array.dims) != {"y", "x"}:
        raise ValueError(f"the array has the dimensions {array.dims}, the grid y and x")
    array = array.transpose("y", "x")
    if not {"y", "x"} <= set(array.coords):
        return np.asarray(array.values)
    positions = []
    for axis, centres_m in (("y", grid.y_m), ("x", grid.x_m)):
        step_m = -grid.cell_m if axis == "y" else grid.cell_m
        position = (array[axis].values - centres_m[0]) / step_m
        index = np.rint(position).astype(np.int64)
        inside = (index >= 0) & (index < len(centres_m))
        if not inside.all() or np.any(np.abs(position - index) > ALIGNED_CELLS):
            raise ValueError(f"{axis} of the array are not cell centres of the grid")
        positions.append(index)
    aligned = np.zeros(grid.shape, array.dtype)
    aligned[np.ix_(*positions)] = array.values
    return aligned


def to_mask(area: str | npt.ArrayLike | xr.DataArray | shapely.Geometry, series: Series) -> Bools:
    """Return the mask (ny, nx) of an area: a name in `areas.nc`, a mask, or a polygon in map coordinates.

    A polygon contains the cells whose centres it contains. Raises StationError if the name is unknown,
    ValueError if a mask does not fit the grid or a polygon no cell.
    """
    grid = series.grid
    if isinstance(area, str):
        polygons = area_polygons(series)
        if area not in polygons:
            known = ", ".join(polygons) or "none"
            raise StationError(f"no area {area!r} in {series.folder / 'areas.nc'}; areas: {known}")
        area = polygons[area]
    if isinstance(area, shapely.Geometry):
        shapely.prepare(area)
        mask = np.asarray(shapely.contains_xy(area, grid.x_m[None, :], grid.y_m[:, None]))
    else:
        mask = np.asarray(to_grid(area, grid) != 0)
    if not mask.any():
        raise ValueError("the area contains no cell of the grid: are its coordinates those of the map?")
    return mask


def to_index_or_time(epoch: Epoch) -> int | np.datetime64:
    """Return an epoch given by a user as an index or a time in UTC; raise ValueError for anything else."""
    value: object = epoch.values[()] if _is_data_array(epoch) else epoch
    if isinstance(value, (int, np.integer)) and not isinstance(value, np.timedelta64):
        return int(value)
    try:
        if isinstance(value, str):
            value = datetime.fromisoformat(value)
        if isinstance(value, datetime) and value.tzinfo is not None:
            value = value.astimezone(UTC).replace(tzinfo=None)
        time = np.array(value, "M8[ns]")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{epoch!r} is neither an index of an epoch nor a time") from error
    if time.ndim or np.isnat(time):
        raise ValueError("the time of the epoch is missing, or there are several")
    return np.datetime64(time.item(), "ns")
