"""The formats that contain or describe the series."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from station.products.exports import netcdf, references, servers, zarr_store
from station.products.exports.contents import Advance
from station.products.exports.selection import Part, Selection


@dataclass(frozen=True)
class SeriesFormat:
    """A format: the suffix of its files, and how they are recognised and written."""

    suffix: str
    read_fingerprint: Callable[[Path], str | None]
    write: Callable[[Selection, list[Part], Callable[[Path], None], Advance], Iterator[Path]]


FORMATS = {
    "erddap": SeriesFormat(".xml", servers.recognise_erddap, servers.write_erddap),
    "ncml": SeriesFormat(".ncml", servers.recognise_ncml, servers.write_ncml),
    "netcdf": SeriesFormat(".nc", netcdf.read_fingerprint, netcdf.write_netcdf),
    "references": SeriesFormat(".json", references.read_fingerprint, references.write_references),
    "zarr": SeriesFormat(".zarr", zarr_store.read_fingerprint, zarr_store.write_zarr),
}
