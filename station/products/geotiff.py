"""Change and its sigma as cloud-optimised GeoTIFF, each with a style that QGIS applies automatically."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import netCDF4
import numpy as np

from station._version import __version__
from station.archive.atomic_files import atomic_write
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.errors import StationError
from station.products.colours import ColourScale, change_scale, sigma_scale
from station.products.gallery import replace_if_changed

TILE_CELLS = 512  # rows and columns of a tile
KINDS = {
    "change": ("elevation_change", "elevation above the reference surface [m]"),
    "sigma": ("elevation_change_uncertainty", "1 sigma of the elevation change of a single cell [m]"),
}


def export_geotiff(series: Series, epoch: EpochRef, folder: Path, limit_m: float) -> list[Path]:
    """Write the change of an epoch and its sigma with QGIS styles into a folder; return the two GeoTIFFs.

    Raises StationError if rasterio is not installed, StoreError if a file cannot be written.
    """
    paths = []
    for kind, (name, description) in KINDS.items():
        path = folder / f"{Path(epoch.epoch_file).stem}_{kind}.tif"
        with netCDF4.Dataset(epoch.path) as file:
            values = np.ma.filled(file[name][epoch.index].astype(np.float32), np.float32(np.nan))
        tags = {
            "station": series.station_id,
            "epoch": epoch.epoch_file,
            "time_start": f"{epoch.start:%Y-%m-%dT%H:%M:%SZ}",
            "software": f"station {__version__}",
        }
        write_cog(path, series, values, description, tags)
        scale = (
            change_scale(limit_m, "the reference", on_map=series.grid.plane.is_map)
            if kind == "change"
            else sigma_scale(limit_m)
        )
        replace_if_changed(path.with_suffix(".qml"), _qgis_style(scale).encode())
        paths.append(path)
    return paths


def write_cog(
    path: Path,
    series: Series,
    values: Any,  # noqa: ANN401
    description: str,
    tags: dict[str, str],
    units: str = "m",
) -> None:
    """Write a raster as a COG of GDAL: tiled, with overviews by mean, the coarsest first in the file."""
    try:
        import rasterio  # noqa: PLC0415 - an extra
        from rasterio.io import MemoryFile  # noqa: PLC0415
        from rasterio.shutil import copy  # noqa: PLC0415
    except ImportError as error:
        raise StationError("GeoTIFF needs rasterio: pip install 'tls-station[export]'") from error
    grid = series.grid
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": 1,
        "height": grid.ny,
        "width": grid.nx,
        "crs": series.crs,
        "transform": rasterio.Affine(grid.cell_m, 0, grid.west_m, 0, -grid.cell_m, grid.north_m),
        "nodata": float("nan"),
    }
    try:
        with MemoryFile() as memory:
            with memory.open(**profile) as raster:
                raster.write(values, 1)
                raster.set_band_description(1, description)
                raster.set_band_unit(1, units)
                raster.update_tags(AREA_OR_POINT="Area", **tags)
            with atomic_write(path) as tmp_path, memory.open() as raster:
                copy(
                    raster, tmp_path, driver="COG", COMPRESS="DEFLATE", PREDICTOR="YES", LEVEL="6",
                    BLOCKSIZE=str(TILE_CELLS), OVERVIEW_RESAMPLING="AVERAGE",
                )  # fmt: skip
    except rasterio.errors.RasterioError as error:
        raise StationError(f"{path}: cannot be written: {error}") from error


def _qgis_style(scale: ColourScale) -> str:
    """Return a QGIS style with the colours and limits of the maps."""
    table = scale.colour_table()
    steps = np.linspace(0, 255, 33).round().astype(int)
    share = steps / 255
    if scale.logarithmic:
        values = scale.low * (scale.high / scale.low) ** share
    else:
        values = scale.low + share * (scale.high - scale.low)
    items = "".join(
        f'<item value="{value:.6g}" label="{value:.3g}" alpha="255" color="#{red:02x}{green:02x}{blue:02x}"/>'
        for value, (red, green, blue) in zip(values, table[steps].tolist(), strict=True)
    )
    limits = f'minimumValue="{scale.low:g}" maximumValue="{scale.high:g}"'
    return (
        '<!DOCTYPE qgis PUBLIC "http://mrcc.com/qgis.dtd" "SYSTEM">\n'
        f'<qgis version="3.22" styleCategories="Symbology"><!-- {quoteattr(scale.title)[1:-1]} -->\n'
        '<pipe><rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1"'
        f' classificationMin="{scale.low:g}" classificationMax="{scale.high:g}" nodataColor="">\n'
        "<rasterTransparency/><rastershader>"
        f'<colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0" {limits}>\n'
        f"{items}\n</colorrampshader></rastershader></rasterrenderer></pipe>\n"
        "<blendMode>0</blendMode></qgis>\n"
    )
