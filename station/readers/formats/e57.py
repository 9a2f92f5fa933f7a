"""Scans in the ASTM E57 format (E2807), read with the extra `e57`.

Each scan of a file has its own frame and a pose that leads to the frame of the file. For scans in the
scanner's frame the pose is not applied and the file must contain one scan; on the map it is, to all of them.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from datetime import datetime
from typing import Any, ClassVar

import numpy as np

from station.errors import NotReadyError, ScanError
from station.quantities import Floats
from station.readers.formats.point_tables import Contents, Table, TableScan
from station.readers.scan import gps_to_utc

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
# Other fields that are read, with what they hold and their type; pye57 0.4 fills wider integers wrongly.
OTHERS = {
    "intensity": ("intensity", "f8"),
    "timeStamp": ("time", "f8"),
    "returnIndex": ("return_number", "i2"),
    "returnCount": ("number_of_returns", "i2"),
    "cartesianInvalidState": ("invalid", "i2"),
    "sphericalInvalidState": ("invalid", "i2"),
}
MAX_POINTS_PER_BYTE = 8  # a point takes at least a bit
EARLIEST_START_S = 7e8  # GPS seconds in 2002; scanners without a clock write less


def _library() -> Any:  # noqa: ANN401 - a module
    """Return the library; raise NotReadyError if it is not installed."""
    try:
        import pye57  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise NotReadyError("E57 needs a library: pip install 'tls-station[e57]'") from error
    return pye57


class E57Scan(TableScan):
    """An E57 file (see `ScanReader`)."""

    suffixes: ClassVar[tuple[str, ...]] = (".e57",)

    def _open(self) -> Contents:
        with _library().E57(str(self.path)) as file:
            headers = [file.get_header(index) for index in range(file.scan_count)]
            if not headers:
                raise ScanError("contains no scan")
            if self._range_max_m is not None and len(headers) > 1:
                raise ScanError(
                    f"contains {len(headers)} scans: a scan in the scanner's frame needs a file of its own"
                )
            count = sum(header.point_count for header in headers)
            if count > MAX_POINTS_PER_BYTE * self.path.stat().st_size:
                raise ScanError(f"states {count:,} points, more than a file of its size can hold")
            metadata = _value(file.root, "coordinateMetadata")
            return Contents(
                count,
                intensity_limits=_intensity_limits(headers[0]),
                crs_wkt=metadata if isinstance(metadata, str) and "[" in metadata else None,
                start_utc=_start(headers[0]),
            )

    def _tables(self, size: int) -> Iterator[Table]:
        with _library().E57(str(self.path)) as file:
            for index in range(file.scan_count):
                header = file.get_header(index)
                pose = _pose(header) if self._range_max_m is None else None
                yield from _scan_tables(file, header, size, pose)


def _scan_tables(
    file: Any,  # noqa: ANN401 - of a library without types
    header: Any,  # noqa: ANN401
    size: int,
    pose: tuple[Floats, Floats] | None,
) -> Iterator[Table]:
    """Yield the points of a scan of a file; `pose` (rotation, translation) leads to the frame of the file."""
    fields = set(header.point_fields)
    axes = CARTESIAN if fields.issuperset(CARTESIAN) else SPHERICAL
    if not fields.issuperset(axes):
        raise ScanError(f"has neither cartesian nor spherical coordinates, but {', '.join(sorted(fields))}")
    types = dict.fromkeys(axes, "f8") | {name: kind for name, (_, kind) in OTHERS.items() if name in fields}
    arrays = {name: np.empty(size, kind) for name, kind in types.items()}
    libe57 = _library().libe57
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, size, True, True))
    reader = header.points.reader(buffers)
    while count := reader.read():
        columns = {name: array[:count].copy() for name, array in arrays.items()}
        table = _coordinates([columns[axis] for axis in axes], pose, is_spherical=axes is SPHERICAL)
        for name, (key, _) in OTHERS.items():
            if name in columns:
                table[key] = columns[name] + (name == "returnIndex")  # it counts from zero
        yield table
    reader.close()


def _coordinates(axes: list[Floats], pose: tuple[Floats, Floats] | None, *, is_spherical: bool) -> Table:
    """Return x, y and z [m]. Source: ASTM E2807-11, 8.4.4.1: elevation is from the x-y plane."""
    x_m, y_m, z_m = axes
    if is_spherical:
        range_m, azimuth_rad, elevation_rad = axes
        x_m = range_m * np.cos(elevation_rad) * np.cos(azimuth_rad)
        y_m = range_m * np.cos(elevation_rad) * np.sin(azimuth_rad)
        z_m = range_m * np.sin(elevation_rad)
    if pose is not None:
        rotation, translation_m = pose
        x_m, y_m, z_m = rotation @ np.stack([x_m, y_m, z_m]) + translation_m[:, None]
    return {"x": x_m, "y": y_m, "z": z_m}


def _pose(header: Any) -> tuple[Floats, Floats] | None:  # noqa: ANN401 - of a library without types
    return (header.rotation_matrix, header.translation.astype(np.float64)) if header.has_pose() else None


def _value(node: Any, *names: str) -> float | str | None:  # noqa: ANN401
    """Return the value of a node, None if it does not exist."""
    with contextlib.suppress(_library().libe57.E57Exception, KeyError, AttributeError):
        for name in names:
            node = node[name]
        value: float | str = node.value()
        return value
    return None


def _intensity_limits(header: Any) -> tuple[float, float] | None:  # noqa: ANN401
    limits = [_value(header.node, "intensityLimits", f"intensity{end}") for end in ("Minimum", "Maximum")]
    low, high = (float(limit) if isinstance(limit, int | float) else math.nan for limit in limits)
    return (low, high) if low < high else None


def _start(header: Any) -> datetime | None:  # noqa: ANN401
    """Return the start that a scan states; None if its scanner had no clock."""
    seconds = _value(header.node, "acquisitionStart", "dateTimeValue")
    if not isinstance(seconds, int | float) or not EARLIEST_START_S < seconds < math.inf:
        return None
    return gps_to_utc(float(seconds))
