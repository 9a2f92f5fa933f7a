"""Scans in RIEGL's database format (RDBX), read with RIEGL's library, which each user installs.

Source: RIEGL, RDB library, Python bindings: rdb_open, select, attributes of points, statistics, as
pylidar-tls-canopy (riegl_io.py) calls them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

from station.errors import NotReadyError, ScanError
from station.readers.formats.point_tables import Contents, Table, TableScan

XYZ = "riegl.xyz"
# Attributes that are read if they are there, with what they hold; targets are counted from 1.
ATTRIBUTES = {
    "riegl.timestamp": "time",
    "riegl.reflectance": "reflectance",
    "riegl.target_index": "return_number",
    "riegl.target_count": "number_of_returns",
    "riegl.class": "classification",
}


def _library() -> Any:  # noqa: ANN401 - a module
    """Return RIEGL's library; raise NotReadyError if it is not installed."""
    try:
        import riegl.rdb  # type: ignore[import-not-found] # noqa: PLC0415 - installed by the user
    except ImportError as error:
        raise NotReadyError(
            "RDBX needs RIEGL's RDB library (rdblib): install its Python wheel from RIEGL's download page"
        ) from error
    return riegl.rdb


class RdbxScan(TableScan):
    """An RDBX file (see `ScanReader`): points in the scanner's frame with time and reflectance."""

    suffixes: ClassVar[tuple[str, ...]] = (".rdbx",)

    def _open(self) -> Contents:
        with _library().rdb_open(str(self.path)) as rdb:
            names = {attribute.name for attribute in rdb.point_attributes.values()}
            if XYZ not in names:
                raise ScanError(f"has no {XYZ}, but {', '.join(sorted(names))}")
            self._attributes = [name for name in ATTRIBUTES if name in names]
            with rdb.stat as stat:
                self._count = int(stat.point_count_total)
        return Contents(self._count)

    def _tables(self, size: int) -> Iterator[Table]:
        remaining = self._count  # the arrays of the last chunk may be longer than it
        with _library().rdb_open(str(self.path)) as rdb:
            for points in rdb.select("", attributes=[XYZ, *self._attributes], chunk_size=size):
                count = min(remaining, len(points[XYZ]))
                remaining -= count
                x_m, y_m, z_m = np.array(points[XYZ][:count], dtype=np.float64).T
                table: Table = {"x": x_m, "y": y_m, "z": z_m}
                for name in self._attributes:
                    table[ATTRIBUTES[name]] = np.array(points[name][:count])
                yield table
