"""Change and its sigma as cloud-optimised GeoTIFF, each with a style that QGIS takes up by itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import netCDF4
import numpy as np

from station import __version__
from station.archive.layout import Series, written_whole
from station.archive.store import Row
from station.errors import StationError
from station.products.colours import Scale, change_scale, sigma_scale
from station.products.gallery import put

BLOCK = 512  # rows and columns of a tile
KINDS = {
    "change": ("elevation_change", "elevation above the reference surface [m]"),
    "sigma": ("elevation_change_uncertainty", "1 sigma of the elevation change of a single cell [m]"),
}


def export_geotiff(series: Series, row: Row, folder: Path, limit_m: float) -> list[Path]:
    """Write the change of an epoch and its sigma into a folder, with their styles; return the two GeoTIFFs.

    Raises StationError where rasterio is not installed, StoreError where it cannot write.
    """
    made = []
    for kind, (name, told) in KINDS.items():
        path = folder / f"{Path(row.epoch_file).stem}_{kind}.tif"
        with netCDF4.Dataset(row.path) as file:
            values = np.ma.filled(file[name][row.index].astype(np.float32), np.float32(np.nan))
        tags = {
            "station": series.station_id,
            "epoch": row.epoch_file,
            "time_start": f"{row.start:%Y-%m-%dT%H:%M:%SZ}",
            "software": f"station {__version__}",
        }
        _write(path, series, values, told, tags)
        scale = change_scale(limit_m, "the reference") if kind == "change" else sigma_scale(limit_m)
        put(path.with_suffix(".qml"), _style(scale).encode())
        made.append(path)
    return made


def _write(path: Path, series: Series, values: Any, told: str, tags: dict[str, str]) -> None:  # noqa: ANN401
    """Write a raster as GDAL's own COG: tiled, overviews by mean, what is seen first at the front."""
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
                raster.set_band_description(1, told)
                raster.set_band_unit(1, "m")
                raster.update_tags(AREA_OR_POINT="Area", **tags)
            with written_whole(path) as beside, memory.open() as raster:
                copy(
                    raster, beside, driver="COG", COMPRESS="DEFLATE", PREDICTOR="YES", LEVEL="6",
                    BLOCKSIZE=str(BLOCK), OVERVIEW_RESAMPLING="AVERAGE",
                )  # fmt: skip
    except rasterio.errors.RasterioError as error:
        raise StationError(f"{path}: cannot be made: {error}") from error


def _style(scale: Scale) -> str:
    """Return a QGIS style: the colours of the maps between the same ends."""
    table = scale.table()
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
    ends = f'minimumValue="{scale.low:g}" maximumValue="{scale.high:g}"'
    return (
        '<!DOCTYPE qgis PUBLIC "http://mrcc.com/qgis.dtd" "SYSTEM">\n'
        f'<qgis version="3.22" styleCategories="Symbology"><!-- {quoteattr(scale.title)[1:-1]} -->\n'
        '<pipe><rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1"'
        f' classificationMin="{scale.low:g}" classificationMax="{scale.high:g}" nodataColor="">\n'
        "<rasterTransparency/><rastershader>"
        f'<colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0" {ends}>\n'
        f"{items}\n</colorrampshader></rastershader></rasterrenderer></pipe>\n"
        "<blendMode>0</blendMode></qgis>\n"
    )
