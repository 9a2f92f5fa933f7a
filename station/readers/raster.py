"""A given reference surface: one band of elevations in a GeoTIFF."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from station.errors import ConfigError
from station.quantities import Floats, Grid
from station.science.geometry.pose import horizontal_crs, is_same_map

ALIGNMENT_TOLERANCE = 1e-3  # of a cell
ELEVATION_LIMITS_M = (-500.0, 9000.0)  # plausible on land


def read_geotiff(path: Path, grid: Grid, crs: str | None) -> Floats:
    """Read elevations [m] on a grid (ny, nx), NaN outside the file and where it has no data.

    The cells of the file must be those of the grid: nothing is resampled, because that would change the
    errors unnoticed. Raises ConfigError with the difference, or with the library to install.
    """
    try:
        # An extra because of its size; smaller TIFF readers lack the compressions that GDAL uses.
        import rasterio  # noqa: PLC0415 - an extra
        from rasterio.windows import Window  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(
            f"{path}: reading GeoTIFF needs rasterio: pip install 'tls-station[geotiff]'"
        ) from error
    elevation_m = np.full(grid.shape, np.nan)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about a missing georeference; an error below
            tif = rasterio.open(path)
        with tif:
            if tif.count != 1:
                raise ConfigError(f"{path}: has {tif.count} bands; expected one, of elevations")
            _check_crs(path, tif.crs.to_wkt() if tif.crs else None, crs)
            column, row = _grid_offset(path, tuple(tif.transform)[:6], grid)
            first_row, first_column = max(-row, 0), max(-column, 0)  # of the file in the grid
            rows = min(grid.ny - first_row, tif.height - max(row, 0))
            columns = min(grid.nx - first_column, tif.width - max(column, 0))
            if rows <= 0 or columns <= 0:
                raise ConfigError(f"{path}: does not overlap grid.bounds_m")
            window = Window(max(column, 0), max(row, 0), columns, rows)
            band = tif.read(1, window=window, masked=True).astype(np.float64)
            band = band * tif.scales[0] + tif.offsets[0]
    except rasterio.errors.RasterioError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    elevation_m[first_row : first_row + rows, first_column : first_column + columns] = band.filled(np.nan)
    return _validate_elevations(path, elevation_m)


def _check_crs(path: Path, file_wkt: str | None, site_wkt: str | None) -> None:
    """Raise ConfigError if the CRS is not the site's; a neighbouring zone looks just as plausible."""
    if site_wkt is None:
        return
    if file_wkt is None:
        raise ConfigError(
            f"{path}: declares no CRS; if it is {site_wkt}: gdal_edit.py -a_srs {site_wkt} {path.name}"
        )
    file_crs, site_crs = horizontal_crs(file_wkt), horizontal_crs(site_wkt)
    if not is_same_map(file_crs, site_crs):
        raise ConfigError(f"{path}: is in {file_crs.name}, map.crs is {site_crs.name}")


def _grid_offset(path: Path, transform: tuple[float, ...], grid: Grid) -> tuple[int, int]:
    """Return the column and the row of the file at which the grid begins."""
    width_m, row_rotation, west_m, column_rotation, height_m, north_m = transform
    if (width_m, height_m, west_m, north_m) == (1.0, 1.0, 0.0, 0.0):
        raise ConfigError(f"{path}: is not georeferenced")
    if row_rotation or column_rotation or height_m >= 0:
        raise ConfigError(f"{path}: is not north-up; reproject it with gdalwarp")
    if (
        max(abs(width_m - grid.cell_m), abs(height_m + grid.cell_m)) * max(grid.shape)
        > ALIGNMENT_TOLERANCE * grid.cell_m
    ):
        raise ConfigError(
            f"{path}: has cells of {width_m:g} × {-height_m:g} m, grid.cell_m is {grid.cell_m:g}"
        )
    column, row = (grid.west_m - west_m) / grid.cell_m, (north_m - grid.north_m) / grid.cell_m
    misalignment = max(abs(column - round(column)), abs(row - round(row)))
    if misalignment > ALIGNMENT_TOLERANCE:
        raise ConfigError(
            f"{path}: its cells begin at {west_m:.3f}, {north_m:.3f} m, {misalignment:.3f} of a cell off"
            f" those of grid.bounds_m ({grid.west_m:.3f}, {grid.north_m:.3f}):"
            " move bounds_m, or gdalwarp -tap"
        )
    return round(column), round(row)


def _validate_elevations(path: Path, elevation_m: Floats) -> Floats:
    """Return the elevations [m]; raise ConfigError if they are not plausible."""
    elevation_m[~np.isfinite(elevation_m)] = np.nan
    if np.isnan(elevation_m).all():
        raise ConfigError(f"{path}: contains no elevation within grid.bounds_m")
    low_m, high_m = float(np.nanmin(elevation_m)), float(np.nanmax(elevation_m))
    if low_m < ELEVATION_LIMITS_M[0] or high_m > ELEVATION_LIMITS_M[1]:
        raise ConfigError(
            f"{path}: impossible elevations from {low_m:g} to {high_m:g} m: its nodata value is not declared"
            " (gdal_edit.py -a_nodata), or its unit is not the metre"
        )
    return elevation_m
