"""Levels and rates as GeoTIFF, one for each day and variable, or as one NetCDF file of all days."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import netCDF4

from station._version import __version__
from station.archive.atomic_files import atomic_write
from station.archive.derived.level_files import (
    LEVEL_VARIABLES,
    create_level_file,
    is_day,
    level_files,
    level_raster,
)
from station.archive.discovery import time_coverage
from station.archive.netcdf_layout import Series
from station.errors import StationError, StoreError
from station.products.area_tables import Span
from station.products.geotiff import write_cog


def export_levels(series: Series, span: Span | None, folder: Path, file_format: str) -> list[Path]:
    """Write the days and months of levels that began in a span, by default the newest day; return the files.

    `file_format` is geotiff or netcdf. Raises StationError if there are none or a library is missing,
    StoreError if a file is damaged or cannot be written.
    """
    begun = {path: _begin(path) for path in level_files(series)}
    days = [path for path in begun if is_day(path)]
    chosen = days[-1:] if span is None else [path for path, begin in begun.items() if begin in span]
    if not chosen:
        raise StationError(
            "no day of levels in this span: products.levels = true keeps them, when a day is over"
        )
    if file_format == "geotiff":
        return [path for source in chosen for path in _write_geotiffs(series, source, folder)]
    groups = {noun: [path for path in chosen if is_day(path) == (noun == "day")] for noun in ("day", "month")}
    return [_write_netcdf(series, paths, folder, noun) for noun, paths in groups.items() if paths]


def _begin(path: Path) -> datetime:
    stamp = "%Y%m%d" if is_day(path) else "%Y%m"
    return datetime.strptime(path.stem.split("_")[-2], stamp).replace(tzinfo=UTC)


def _write_geotiffs(series: Series, source: Path, folder: Path) -> list[Path]:
    paths = []
    for spec in LEVEL_VARIABLES:
        path = folder / f"{source.stem.rpartition('_')[0]}_{spec.name}.tif"
        tags = {"station": series.station_id, "source": source.name, "software": f"station {__version__}"}
        write_cog(path, series, level_raster(source, spec.name)[:], spec.long_name, tags, spec.units or "1")
        paths.append(path)
    return paths


def _write_netcdf(series: Series, sources: list[Path], folder: Path, noun: str) -> Path:
    """Write days or months of levels as one file, with the values as stored."""
    periods = [source.stem.split("_")[-2] for source in sources]
    period = " to ".join(dict.fromkeys((periods[0], periods[-1])))
    path = folder / f"{series.station_id}_levels_{period.replace(' to ', '-')}.nc"
    title = f"Level and rate of the surface at {series.name or series.station_id}, {period}"
    with atomic_write(path) as tmp_path, netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
        create_level_file(file, series, title, len(sources), noun)
        _as_stored(file)
        for index, source_path in enumerate(sources):
            try:
                with netCDF4.Dataset(source_path) as source:
                    _as_stored(source)
                    for name, variable in source.variables.items():
                        if "time" in variable.dimensions:
                            file[name][index] = variable[0]
            except (OSError, RuntimeError) as error:
                raise StoreError(f"{source_path}: cannot be read: {error} (station check --store)") from error
        start_s, end_s = file["time_bnds"][0, 0], file["time_bnds"][-1, 1]
        file.setncatts(time_coverage(float(start_s), float(end_s)))
    return path


def _as_stored(file: netCDF4.Dataset) -> None:
    file.set_auto_mask(False)
    file.set_auto_chartostring(False)
