"""Tables of events: as CSV, as text and as GeoParquet."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime
from pathlib import Path

import pyproj
import shapely

from station.archive.atomic_files import atomic_write
from station.archive.derived.event_table import EVENT_COLUMNS, Event, read_events, read_outlines
from station.archive.netcdf_layout import Series
from station.archive.series.index import series_in
from station.config import Site
from station.errors import StationError
from station.products.area_tables import Span, text_table
from station.science.geometry.robust_statistics import NORMAL_95

TIMES = ("after", "begin", "confirmed", "end")


def select_events(site: Site, span: Span, kind: str | None = None) -> list[Event]:
    """Return the events of a station that began in a span, of one kind or all, the oldest first.

    Raises StoreError if there is no series, or the table is damaged.
    """
    return [
        event
        for event in read_events(series_in(site.station.data).folder)
        if kind in {None, event.kind} and datetime.fromisoformat(event.begin) in span
    ]


def as_csv(events: Iterable[Event]) -> str:
    """Return a CSV table with one sigma of each volume; a missing value is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(EVENT_COLUMNS)
    writer.writerows(["" if value is None else value for value in asdict(event).values()] for event in events)
    return stream.getvalue()


def write_geoparquet(series: Series, events: Iterable[Event], path: Path) -> None:
    """Write events with their outlines by GeoParquet 1.1; times are UTC timestamps, missing values null.

    Raises StationError if pyarrow is not installed, StoreError if the table is damaged or the file cannot be
    written.
    """
    try:
        import pyarrow as pa  # noqa: PLC0415 - an extra
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise StationError("GeoParquet needs pyarrow: pip install 'tls-station[parquet]'") from error
    outlines = {event.id: shape for event, shape in read_outlines(series.folder)}
    rows = [asdict(event) for event in events]
    shapes = [outlines[row["id"]] for row in rows]
    numeric = {name for name, field in Event.__dataclass_fields__.items() if "float" in str(field.type)}
    columns = {}
    for name in EVENT_COLUMNS:
        values = [row[name] for row in rows]
        if name in TIMES:
            moments = [datetime.fromisoformat(value) for value in values]
            columns[name] = pa.array(moments, pa.timestamp("ms", "UTC"))
        else:
            known = [None if value == "" else value for value in values]
            columns[name] = pa.array(known, pa.float64() if name in numeric else pa.string())
    columns["geometry"] = pa.array(shapely.to_wkb(shapes).tolist(), pa.binary())
    about: dict[str, object] = {
        "encoding": "WKB",
        "geometry_types": sorted({shape.geom_type for shape in shapes}),
        "crs": pyproj.CRS(series.crs).to_json_dict() if series.crs is not None else None,
    }
    if shapes:
        about["bbox"] = shapely.total_bounds(shapes).tolist()
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": about}}
    with atomic_write(path) as tmp_path:
        parquet.write_table(pa.table(columns).replace_schema_metadata({"geo": json.dumps(geo)}), tmp_path)


def as_text(events: Iterable[Event], *, on_map: bool) -> str:
    """Return a text table with 95 % intervals."""
    axes = ("east, m", "north, m") if on_map else ("along, m", "up, m")
    header = (
        "begin, UTC", "end, UTC", "kind", "state", *axes, "area, m²", "depth, m",
        "volume, m³", "95 %", "balance, m³",
    )  # fmt: skip
    body = [
        (
            _minute(event.begin),
            _minute(event.end),
            event.kind.replace("_", " "),
            event.state,
            f"{event.east_m:.0f}",
            f"{event.north_m:.0f}",
            f"{event.area_m2:.0f}",
            f"{event.mean_depth_m:+z.2f}",
            f"{event.volume_m3:+z.0f}",
            f"±{NORMAL_95 * event.volume_sigma_m3:.0f}",
            _balance(event),
        )
        for event in events
    ]  # fmt: skip
    return text_table(header, body, left_aligned=(0, 1, 2, 3)) if body else "no events"


def _balance(event: Event) -> str:
    if event.balance_m3 is None or event.balance_sigma_m3 is None:
        return ""
    return f"{event.balance_m3:+z.0f} ±{NORMAL_95 * event.balance_sigma_m3:.0f}"


def _minute(time: str) -> str:
    return time[:16].replace("T", " ")
