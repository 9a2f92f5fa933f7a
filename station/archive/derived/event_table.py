"""`events.geojson`: where and when the surface changed, one feature an event, and what it was found from.

The table is written with each epoch, from the regions that each scan shows. These are kept beside it
with the names of the scans that they were found in, so that only what a new or late scan touches is searched
again.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from station.archive.atomic_files import atomic_write
from station.archive.checksums import read_checked_json, to_checked_json
from station.archive.derived.fingerprints import is_intact, write_fingerprints
from station.archive.netcdf_layout import Series
from station.errors import StoreError
from station.quantities import Bools, Grid

FILE_NAME, FOUND_NAME = "events.geojson", ".event_regions.json"
FORMAT = 9  # of the kept regions
KEY_LENGTH = 32
CLASSES = ("loss", "gain", "paired", "melt_front", "snowfall")


@dataclass(frozen=True)
class Event:
    """An event: where, when and how much; times are middles of scans [ISO 8601, UTC]."""

    id: str
    kind: str  # one of CLASSES
    state: str  # "active" or "closed"
    after: str  # the last scan before it
    begin: str  # the first scan that shows it
    confirmed: str  # the second scan that shows it
    end: str  # the last scan in which it grew
    east_m: float
    north_m: float
    area_m2: float
    volume_m3: float
    volume_sigma_m3: float
    mean_depth_m: float
    sigmas: float  # of its most significant part
    reference_version: str
    partner: str = ""  # of a pair: the id of scar or deposit
    balance_m3: float | None = None  # of a pair: deposit less scar
    balance_sigma_m3: float | None = None


EVENT_COLUMNS = tuple(Event.__dataclass_fields__)


@dataclass(frozen=True)
class Found:
    """What was found in the windows of scans that were searched.

    `keys` are those of the windows, in order of their last scans, `scans` is a hash of these scans, and
    `values` has what was found in a window, or measured of an event, by its key; nothing where it has none.
    """

    scans: str = ""
    keys: list[str] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)


def encode_blocks(blocks: Bools) -> str:
    """Return blocks (by, bx) as a short text."""
    return base64.b64encode(zlib.compress(np.packbits(blocks).tobytes(), 6)).decode()


def decode_blocks(text: str, shape: tuple[int, int]) -> Bools:
    """Return the blocks (by, bx) of a text of `encode_blocks`."""
    packed = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    return np.unpackbits(packed, count=shape[0] * shape[1]).reshape(shape).astype(np.bool_)


def outline(blocks: Bools, grid: Grid) -> shapely.Geometry:
    """Return the outline of blocks (by, bx) of a grid of blocks, on the map."""
    row, column = np.nonzero(blocks)
    west_m, north_m = grid.west_m + column * grid.cell_m, grid.north_m - row * grid.cell_m
    boxes = shapely.box(west_m, north_m - grid.cell_m, west_m + grid.cell_m, north_m)
    return shapely.normalize(shapely.union_all(boxes))


def read_found(series: Series) -> Found:
    """Return what was found before; nothing if the file is missing or damaged."""
    content = read_checked_json(series.folder / FOUND_NAME)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        return Found()
    keys = content["keys"]
    starts = range(0, len(keys), KEY_LENGTH)
    return Found(content["scans"], [keys[start : start + KEY_LENGTH] for start in starts], content["values"])


def write_found(series: Series, found: Found) -> None:
    """Keep what was found; skipped without an error if the disk is full."""
    path = series.folder / FOUND_NAME
    keys = "".join(found.keys)  # one text: reading a list takes ten times as long
    content = {"format": FORMAT, "scans": found.scans, "keys": keys, "values": found.values}
    with suppress(StoreError), atomic_write(path) as tmp_path:
        tmp_path.write_text(to_checked_json(content), encoding="ascii")


def write_events(series: Series, events: Iterable[tuple[Event, shapely.Geometry]]) -> Path:
    """Write the table unless it is the same already and intact; raise StoreError if it cannot be written."""
    path = series.folder / FILE_NAME
    features = [
        {
            "type": "Feature",
            "id": event.id,
            "properties": asdict(event),
            "geometry": json.loads(shapely.to_geojson(shape)),
        }
        for event, shape in events
    ]
    crs = {"crs": {"type": "name", "properties": {"name": series.crs}}} if series.crs is not None else {}
    lines = ",\n".join(json.dumps(feature) for feature in features)
    head = json.dumps({"type": "FeatureCollection", **crs})[:-1]
    text = f'{head}, "features": [\n{lines}\n]}}\n'
    with suppress(OSError):
        if is_intact(path) and path.read_text(encoding="utf-8") == text:
            return path
    with atomic_write(path) as tmp_path:
        tmp_path.write_text(text, encoding="utf-8")
        write_fingerprints(path, tmp_path)
    return path


def read_events(folder: Path) -> list[Event]:
    """Return the events of a store, the oldest first; [] without a table, StoreError if it is damaged."""
    return [event for event, _ in read_outlines(folder)]


def read_outlines(folder: Path) -> list[tuple[Event, shapely.Geometry]]:
    """Return the events of a store and their outlines on the map; as `read_events`."""
    path = folder / FILE_NAME
    if not path.is_file():
        return []
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        shapes = [shapely.from_geojson(json.dumps(feature["geometry"])) for feature in features]
        events = [Event(**feature["properties"]) for feature in features]
        return list(zip(events, shapes, strict=True))
    except (OSError, ValueError, KeyError, TypeError, shapely.errors.ShapelyError) as error:
        raise StoreError(f"{path}: damaged, cannot be read: {error}: the service builds it again") from error
