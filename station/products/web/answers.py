"""Answers of the server: the change of any polygon over any epochs, and parts of the series as files.

Each is a task for a worker process with limited memory and time. What is asked for is limited, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from station.archive.derived.computed_rasters import open_raster
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.schema import BY_NAME
from station.archive.series.index import SeriesIndex, series_in
from station.errors import StationError
from station.products.area_tables import REFERENCE, Span, computed_records, find_epoch
from station.products.epoch_table import csv_times
from station.products.exports.netcdf import write_netcdf
from station.products.exports.selection import Part, Selection, parse_box, select
from station.products.geotiff import write_cog
from station.quantities import Bools
from station.queries.grid_arrays import to_mask

MAX_COORDINATE_M = 1e8  # beyond any map
MAX_CORNERS = 500  # of a polygon
MAX_EPOCHS = 100  # of an answer
MAX_VALUES = 50_000_000  # of a file: cells times epochs
Parameters = Mapping[str, str]  # of a request
Progress = Callable[[], None]
NOTE = "uncertainty: one standard deviation; low, high: 95 % interval; systematic errors are included"
RASTERS = {name: spec for name, spec in BY_NAME.items() if name.startswith("elevation")}


def epoch_list(data: Path, parameters: Parameters, progress: Progress) -> list[dict[str, str]]:
    """Return name and start (UTC) of the epochs of a span, by default of all; raise StationError."""
    progress()
    span = Span.parse(parameters.get("from"), parameters.get("to"))
    epochs = (epoch for epoch in SeriesIndex(series_in(data)) if epoch.start in span)
    return [{"epoch": epoch.epoch_file, "start_utc": f"{epoch.start:%Y-%m-%dT%H:%M:%SZ}"} for epoch in epochs]


def polygon_change(data: Path, parameters: Parameters, progress: Progress) -> dict[str, Any]:
    """Return mean, median and volume change of a polygon in each epoch of a span, as in `areas.nc`.

    Parameters: `polygon`, easting and northing [m] of each corner; `from` and `to`, by default the newest
    epoch; `against`, as of `station areas`. Raises StationError if these are wrong, or ask for too much.
    """
    series = series_in(data)
    cells = _cells(_polygon(parameters.get("polygon", "")), series)
    span = _span(series, parameters)
    count = sum(epoch.start in span for epoch in SeriesIndex(series))
    if count > MAX_EPOCHS:
        raise StationError(
            f"{count} epochs in this span, at most {MAX_EPOCHS} at once: narrow it with from and to, or run"
            " station areas"
        )

    def track(epochs: list[EpochRef]) -> Any:  # noqa: ANN401 - an iterator
        for epoch in epochs:
            progress()
            yield epoch

    against = parameters.get("against", REFERENCE)
    records = list(computed_records(series, {"polygon": cells}, span, against, track))
    return {
        "against": against,
        "area_size_m2": float(np.count_nonzero(cells)) * series.grid.cell_m**2,
        "note": NOTE,
        "epochs": [
            csv_times(record.start.timestamp(), record.end.timestamp())
            | {"verdict": record.verdict}
            | {name: value if np.isfinite(value) else None for name, value in record.statistics.items()}
            for record in records
        ],
    }


def netcdf_part(data: Path, path: Path, parameters: Parameters, progress: Progress) -> None:
    """Write a box of the series in a span as NetCDF, with the values of the series.

    Parameters: `box`, west,south,east,north [m]; `from` and `to`; `variables`. Raises StationError.
    """
    selection = _selection(series_in(data), parameters)
    part = Part(path, selection.epochs, "")
    for _ in write_netcdf(selection, [part], lambda _: None, lambda _: progress()):
        progress()


def geotiff_part(data: Path, path: Path, parameters: Parameters, progress: Progress) -> None:
    """Write one variable of one epoch in a box as GeoTIFF, at full resolution.

    Parameters: `box`; `epoch`, a scan's name or a time, by default the newest; `variable`. Raises
    StationError.
    """
    series, name = series_in(data), parameters.get("variable", "elevation_change")
    if name not in RASTERS:
        raise StationError(f"{name}: not a variable of a map: choose from {', '.join(RASTERS)}")
    epoch = find_epoch(series, parameters.get("epoch", "last"))
    span = {"from": f"{epoch.start.isoformat()}", "to": f"{epoch.start.isoformat()}"}
    selection = _selection(series, {**parameters, **span, "variables": name})
    progress()
    values = np.asarray(open_raster(epoch.path, name, epoch.index)[selection.rows, selection.columns])
    filled = np.where(values < 1e30, values, np.nan).astype(np.float32)
    progress()
    tags = {"station": series.station_id, "epoch": epoch.epoch_file}
    write_cog(path, selection.cropped, filled, str(RASTERS[name].long_name), tags)


def _selection(series: Series, parameters: Parameters) -> Selection:
    box = parameters.get("box")
    box_m = parse_box(box, None, None) if box else None
    if box_m is not None and not np.isfinite(box_m).all():
        raise StationError(f"{box}: not a box: write west,south,east,north in metres on the map")
    selection = select(series, _span(series, parameters), box_m, parameters.get("variables"))
    values = len(selection.epochs) * selection.shape[0] * selection.shape[1]
    if values > MAX_VALUES:
        raise StationError(
            f"{values:,} values of each variable, at most {MAX_VALUES:,} at once: choose a smaller box or"
            " fewer epochs, or run station export"
        )
    return selection


def _span(series: Series, parameters: Parameters) -> Span:
    """Return the span between the parameters `from` and `to`; the newest epoch without both."""
    first, last = parameters.get("from"), parameters.get("to")
    if first or last:
        return Span.parse(first, last)
    newest = find_epoch(series, "last").start
    return Span(newest, newest + timedelta(microseconds=1))


def _cells(polygon: shapely.Polygon, series: Series) -> Bools:
    try:
        return to_mask(polygon, series)
    except ValueError as error:  # of a caller in Python, but here of a request
        raise StationError(f"polygon: {error}") from error


def _polygon(text: str) -> shapely.Polygon:
    """Return a polygon on the map of numbers with commas; raise StationError if it is none."""
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) % 2 or len(numbers) < 6 or not np.all(np.abs(numbers) < MAX_COORDINATE_M):
        raise StationError("polygon: write easting,northing in m of at least three corners: E,N,E,N,E,N")
    if len(numbers) > 2 * MAX_CORNERS:
        raise StationError(f"polygon: {len(numbers) // 2} corners, at most {MAX_CORNERS}")
    polygon = shapely.Polygon(np.reshape(numbers, (-1, 2)))
    if not polygon.is_valid:
        raise StationError(f"polygon: {shapely.is_valid_reason(polygon)}")
    return polygon
