"""Scans open for reading: the files of one scan position, or of several that are one epoch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from station.config import Site
from station.errors import ScanError
from station.inbox.file_hash import distinct_files, sha256_files
from station.inbox.listing import ScanFile
from station.readers.formats.conversion import open_site_scan
from station.readers.formats.several_files import as_one
from station.readers.scan import ScanReader, utc_interval
from station.readers.sop import sops_of_file, valid_sop
from station.scan_names import path_stem, start_in_name
from station.science.geometry.pose import horizontal_crs, is_same_map
from station.sections.inputs import SopSection


@dataclass(frozen=True)
class PositionScan:
    """What was scanned from one position at one time: a file, or several that are its tiles."""

    scan: str  # the scan that it is part of, without suffix
    name: str  # of its first file
    reader: ScanReader
    logs: tuple[Path, ...]
    matrix: Path | None  # its registration
    sop: SopSection | None  # None if the points are on the map, or the map is local
    start: datetime
    end: datetime


@dataclass(frozen=True)
class OpenScan:
    """A scan, open for reading: most often of one position."""

    positions: tuple[PositionScan, ...]
    file_count: int

    @property
    def start(self) -> datetime:
        """Its start (UTC)."""
        return min(position.start for position in self.positions)

    @property
    def end(self) -> datetime:
        """Its end (UTC)."""
        return max(position.end for position in self.positions)

    @property
    def point_count(self) -> int:
        """Number of points in its files."""
        return sum(position.reader.header.point_count for position in self.positions)


@contextmanager
def open_scan_for(site: Site, scan: ScanFile) -> Iterator[OpenScan]:
    """Yield a scan with the settings of the site; files with the same bytes are read once.

    Files of an epoch with one SOP, one start in their names, and the same registration are tiles of one scan.
    Raises ScanError or NotReadyError.
    """
    kept = set(distinct_files(scan.paths)) if scan.parts else {scan.path}
    groups: dict[tuple[SopSection | None, datetime | None, str], list[tuple[ScanFile, ScanReader]]] = {}
    with ExitStack() as stack:
        for file in scan.files:
            if file.path not in kept:
                continue
            try:
                reader = stack.enter_context(_open_file(site, file))
                start, _, _ = utc_interval(reader, site.scans.pattern, file.name)
                is_on_map = site.scans.frame == "map"
                sop = None if is_on_map else valid_sop(site.sop, start, file.name)
                name_start = None if is_on_map else start_in_name(file.name, site.scans.pattern)
                key = sop, name_start, sha256_files(file.matrices)
            except ScanError as error:
                if len(scan.files) == 1:
                    raise
                raise type(error)(f"{file.name}: {error}") from error
            groups.setdefault(key, []).append((file, reader))
        name = path_stem(scan.name)
        positions = tuple(_position(site, name, sop, files) for (sop, *_), files in groups.items())
        yield OpenScan(positions, len(kept))


def _position(
    site: Site, scan: str, sop: SopSection | None, files: list[tuple[ScanFile, ScanReader]]
) -> PositionScan:
    reader = as_one([reader for _, reader in files])
    start, end, _ = utc_interval(reader, site.scans.pattern, files[0][0].name)
    logs = dict.fromkeys(file.log for file, _ in files if file.log is not None)
    return PositionScan(scan, files[0][0].name, reader, tuple(logs), files[0][0].matrix, sop, start, end)


@contextmanager
def open_files(site: Site, files: Sequence[ScanFile]) -> Iterator[ScanReader]:
    """Yield a reader of files of one position; raises as `open_scan_for`."""
    with ExitStack() as stack:
        yield as_one([stack.enter_context(_open_file(site, file)) for file in files])


@contextmanager
def _open_file(site: Site, file: ScanFile) -> Iterator[ScanReader]:
    """Yield a reader of a file with the settings of the site; raises ScanError or NotReadyError."""
    range_max_m = None
    if site.scans.frame == "scanner":  # the time, which tells the SOP, is not known before the file is open
        sops: Sequence[SopSection | None] = sops_of_file(site.sop, file.name) or (None,)
        range_max_m = max(site.scanner_of(sop).range_max_m for sop in sops)
    work_folder = site.station.data
    with open_site_scan(file.path, site.scans, range_max_m=range_max_m, work_folder=work_folder) as reader:
        if site.scans.frame == "map" and site.map.crs and reader.header.crs_wkt:
            _require_same_map(reader.header.crs_wkt, site.map.crs)
        yield reader


def _require_same_map(declared_wkt: str, crs: str) -> None:
    """Raise ScanError if a scan declares another projected or geographic CRS than the site."""
    declared, expected = horizontal_crs(declared_wkt), horizontal_crs(crs)
    if (declared.is_projected or declared.is_geographic) and not is_same_map(declared, expected):
        raise ScanError(f"the file is in {declared.name}, map.crs is {expected.name}: export it to that map")
