"""A given master surface: one band of elevations in a GeoTIFF."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from station.errors import ConfigError
from station.quantities import Floats, Grid
from station.science.pose import horizontal_crs, is_same_map

ALIGNED = 1e-3  # of a cell
ELEVATIONS_M = (-500.0, 9000.0)  # of land


def read_geotiff(path: Path, grid: Grid, crs: str | None) -> Floats:
    """Read elevations [m] on a grid (ny, nx), NaN outside the file and where it has none.

    The file's cells must be those of the grid: nothing is resampled, for that would change its errors unseen.
    Raises ConfigError that says what differs, or how to install what is lacking.
    """
    try:
        # An extra for its size; lighter TIFF readers lack the compressions GDAL writes elevations with.
        import rasterio  # noqa: PLC0415 - an extra
        from rasterio.windows import Window  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"{path}: to read GeoTIFF: pip install 'tls-station[geotiff]'") from error
    elevation_m = np.full(grid.shape, np.nan)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a file that is not georeferenced; said below
            tif = rasterio.open(path)
        with tif:
            if tif.count != 1:
                raise ConfigError(f"{path}: has {tif.count} bands; elevations are one")
            _check_crs(path, tif.crs.to_wkt() if tif.crs else None, crs)
            column, row = _place(path, tuple(tif.transform)[:6], grid)
            top, left = max(-row, 0), max(-column, 0)  # of the file, within the grid
            rows = min(grid.ny - top, tif.height - max(row, 0))
            columns = min(grid.nx - left, tif.width - max(column, 0))
            if rows <= 0 or columns <= 0:
                raise ConfigError(f"{path}: does not overlap grid.bounds_m")
            window = Window(max(column, 0), max(row, 0), columns, rows)
            band = tif.read(1, window=window, masked=True).astype(np.float64)
            band = band * tif.scales[0] + tif.offsets[0]
    except rasterio.errors.RasterioError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    elevation_m[top : top + rows, left : left + columns] = band.filled(np.nan)
    return _checked(path, elevation_m)


def _check_crs(path: Path, has_wkt: str | None, wanted: str | None) -> None:
    """Refuse another map than the site's; a neighbouring zone looks just as good."""
    if wanted is None:
        return
    if has_wkt is None:
        raise ConfigError(
            f"{path}: names no CRS; if it is {wanted}: gdal_edit.py -a_srs {wanted} {path.name}"
        )
    has, should = horizontal_crs(has_wkt), horizontal_crs(wanted)
    if not is_same_map(has, should):
        raise ConfigError(f"{path}: is in {has.name}, map.crs is {should.name}")


def _place(path: Path, transform: tuple[float, ...], grid: Grid) -> tuple[int, int]:
    """Return column and row of the file in which the grid begins."""
    width_m, turn, west_m, other_turn, height_m, north_m = transform
    if (width_m, height_m, west_m, north_m) == (1.0, 1.0, 0.0, 0.0):
        raise ConfigError(f"{path}: is not georeferenced")
    if turn or other_turn or height_m >= 0:
        raise ConfigError(f"{path}: is not north up; gdalwarp makes it so")
    if max(abs(width_m - grid.cell_m), abs(height_m + grid.cell_m)) * max(grid.shape) > ALIGNED * grid.cell_m:
        raise ConfigError(
            f"{path}: has cells of {width_m:g} × {-height_m:g} m, grid.cell_m is {grid.cell_m:g}"
        )
    column, row = (grid.west_m - west_m) / grid.cell_m, (north_m - grid.north_m) / grid.cell_m
    off = max(abs(column - round(column)), abs(row - round(row)))
    if off > ALIGNED:
        raise ConfigError(
            f"{path}: its cells begin at {west_m:.3f}, {north_m:.3f} m, {off:.3f} of a cell beside those of"
            f" grid.bounds_m ({grid.west_m:.3f}, {grid.north_m:.3f}): move bounds_m, or gdalwarp -tap"
        )
    return round(column), round(row)


def _checked(path: Path, elevation_m: Floats) -> Floats:
    """Return elevations that can be some."""
    elevation_m[~np.isfinite(elevation_m)] = np.nan
    if np.isnan(elevation_m).all():
        raise ConfigError(f"{path}: holds no elevation within grid.bounds_m")
    low_m, high_m = float(np.nanmin(elevation_m)), float(np.nanmax(elevation_m))
    if low_m < ELEVATIONS_M[0] or high_m > ELEVATIONS_M[1]:
        raise ConfigError(
            f"{path}: elevations from {low_m:g} to {high_m:g} m are none: its nodata value is not declared"
            " (gdal_edit.py -a_nodata), or its unit is not the metre"
        )
    return elevation_m
