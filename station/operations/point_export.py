"""`station export SITE points`: the corrected points of scans on the map, for other programs."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import laspy
import netCDF4
import numpy as np
from pyproj import CRS

from station.archive.atomic_files import atomic_write
from station.archive.epochs import EpochRef
from station.archive.reference_files import open_reference
from station.archive.series.index import list_epochs
from station.config import Site
from station.errors import StationError
from station.inbox.journal_reader import JournalReader
from station.inbox.listing import ScanFile
from station.processing.pipeline import stacking_inputs, to_map
from station.processing.provenance import stored_epochs
from station.processing.scans.adjusted_scan import grid_and_adjust, load_viewing_geometry
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import OpenScan, open_scan_for
from station.processing.scans.scan_files import find_scan
from station.processing.scans.scan_inputs import ScanInputs
from station.processing.site_files import series_for
from station.processing.usable_inputs import usable_site
from station.processing.workers import isolation
from station.processing.workers.worker_process import Progress
from station.products.area_tables import Span
from station.products.exports.copc import write_copc
from station.quantities import Floats, Floats32, Shots
from station.scan_names import scan_id

POINT_FORMAT = 6  # LAS 1.4, with time
SCALE_M = 0.0001
EXTRA_BYTES = {  # of each point, those of its cell
    "elevation_change": ("f4", "above the reference [m]"),
    "elevation_change_uncertainty": ("f4", "1 sigma of a cell [m]"),
    "quality": ("u1", "flags of the cell"),
}
MAX_INTENSITY = 65535
SUFFIXES = {"laz": ".laz", "copc": ".copc.laz"}

Track = Callable[[list[EpochRef]], Iterable[EpochRef]]


def export_points(
    site: Site, span: Span | None, folder: Path, track: Track = iter, file_format: str = "laz"
) -> Iterator[Path]:
    """Yield a file for each epoch of a span, by default the newest, when it is written.

    `file_format` is laz or copc. Raises StationError if there is no such epoch, or its scan no longer exists;
    else as processing a scan.
    """
    series = series_for(site)
    epochs = list_epochs(series)
    chosen = epochs[-1:] if span is None else [epoch for epoch in epochs if epoch.start in span]
    if not chosen:
        raise StationError("no epoch in this span")
    with JournalReader(site.station.data / "journal.sqlite") as journal:
        names = {scan_id(entry.name): entry.name for entry in journal.rows()}
    folder.mkdir(parents=True, exist_ok=True)
    usable = usable_site(site)
    stored = {epoch.ref.epoch_file: epoch for epoch in stored_epochs(series, chosen)}
    for epoch in track(chosen):
        stored_id = stored[epoch.epoch_file].provenance.scan_id
        scan = find_scan(site, names.get(stored_id, stored_id), epoch.start.timestamp())
        if scan is None:
            raise StationError(
                f"{epoch.epoch_file}: its scan {stored_id} is neither in the inbox nor archived"
            )
        path = folder / f"{Path(epoch.epoch_file).stem}{SUFFIXES[file_format]}"
        isolation.TaskRunner().run(
            write_points,
            usable,
            scan,
            epoch,
            stored[epoch.epoch_file].reference,
            path,
            memory_gb=site.service.memory_gb,
            timeout_s=site.scans.timeout_s,
        )
        yield path


def write_points(
    site: Site, scan: ScanFile, epoch: EpochRef, version: str, path: Path, progress: Progress
) -> None:
    """Write the points of a scan on the grid; `version` is its reference, '' if it has none."""
    with open_scan_for(site, scan) as opened:
        inputs = load_scan_inputs(site, opened, save_tilt_offset=False)
        cells, method = _cells(epoch)
        inputs, correction_m = _adjusted(site, opened, inputs, version if method == "joint" else "", progress)
        header = _header(site)

        def blocks() -> Iterator[laspy.ScaleAwarePointRecord]:
            for shots in inputs.shots(opened, site.scans.intensity):
                yield _records(site, header, shots, to_map(shots, inputs.pose), correction_m, cells)
                progress()

        write = _write_octree if path.name.endswith(SUFFIXES["copc"]) else _write_laz
        with atomic_write(path) as tmp_path:
            write(tmp_path, header, blocks())


def _write_laz(path: Path, header: laspy.LasHeader, blocks: Iterable[laspy.ScaleAwarePointRecord]) -> None:
    with path.open("wb") as file, laspy.LasWriter(file, header, do_compress=True, closefd=False) as writer:
        for records in blocks:
            writer.write_points(records)


def _write_octree(path: Path, header: laspy.LasHeader, blocks: Iterable[laspy.ScaleAwarePointRecord]) -> None:
    """Write COPC; its points are sorted through a temporary file. Raises StationError if there are none."""
    with tempfile.TemporaryFile(dir=path.parent) as unsorted:
        for records in blocks:
            unsorted.write(records.array.tobytes())
        if not unsorted.tell():
            raise StationError(f"{path.name}: no point of the scan is on the grid")
        unsorted.flush()
        with path.open("w+b") as file:
            write_copc(file, header, np.memmap(unsorted, header.point_format.dtype(), mode="r"))


def _adjusted(
    site: Site, scan: OpenScan, inputs: ScanInputs, version: str, progress: Progress
) -> tuple[ScanInputs, Floats32]:
    """Return the inputs as an adjustment used them, and what it subtracts from heights (ny, nx) [m].

    Without an adjustment nothing is subtracted.
    """
    reference = open_reference(series_for(site), version) if version else None
    if reference is None:
        return inputs, np.zeros(site.grid_cells.shape, np.float32)
    viewing = load_viewing_geometry(site, inputs.geometry, reference)
    result = grid_and_adjust(site, scan, inputs, viewing, progress)
    adjustment = None if inputs.is_given else result.adjustment
    return result.inputs, stacking_inputs(result.gridder, viewing, adjustment)[1]


def _cells(epoch: EpochRef) -> tuple[dict[str, np.ndarray[Any, Any]], str]:
    """Return the stored rasters of an epoch by name (ny, nx), NaN without a value, and its adjustment."""
    with netCDF4.Dataset(epoch.path) as file:
        floats = {
            name: np.ma.filled(file[name][epoch.index].astype(np.float32), np.float32(np.nan))
            for name in ("elevation_change", "elevation_change_uncertainty")
        }
        quality = np.ma.filled(file["quality"][epoch.index], 0).astype(np.uint8)
        return floats | {"quality": quality}, str(file["adjustment"][epoch.index])


def _header(site: Site) -> laspy.LasHeader:
    header = laspy.LasHeader(point_format=POINT_FORMAT, version="1.4")
    grid = site.grid_cells
    corner_m = grid.plane.to_map(np.array([grid.west_m, grid.north_m, 0.0]))
    header.scales, header.offsets = np.full(3, SCALE_M), np.round(corner_m)
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, kind, text) for name, (kind, text) in EXTRA_BYTES.items()]
    )
    for field in header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs:
        # laspy would state extremes of one block, or impossible ones, which viewers refuse
        field.options &= ~(field.MIN_BIT_MASK | field.MAX_BIT_MASK)
    if site.map.crs is not None:
        header.add_crs(CRS.from_user_input(site.map.crs))
    return header


def _records(
    site: Site,
    header: laspy.LasHeader,
    shots: Shots,
    points_m: Floats,
    correction_m: Floats32,
    cells: dict[str, np.ndarray[Any, Any]],
) -> laspy.ScaleAwarePointRecord:
    """Return the points (3, n) of the map that lie on the grid, corrected, with the values of their cells."""
    grid = site.grid_cells
    on_grid_m = grid.plane.from_map(points_m)
    column = np.floor((on_grid_m[0] - grid.west_m) / grid.cell_m).astype(np.int64)
    row = np.floor((grid.north_m - on_grid_m[1]) / grid.cell_m).astype(np.int64)
    inside = np.flatnonzero((column >= 0) & (column < grid.nx) & (row >= 0) & (row < grid.ny))
    cell = row[inside], column[inside]
    records = laspy.ScaleAwarePointRecord.zeros(len(inside), header=header)
    corrected_m = on_grid_m[:, inside]
    corrected_m[2] -= correction_m[cell]
    records.x, records.y, records.z = grid.plane.to_map(corrected_m)
    records.return_number[:] = records.number_of_returns[:] = 1
    if shots.time_s is not None:
        records.gps_time = shots.time_s[inside]
    if shots.intensity is not None:
        records.intensity = np.round(shots.intensity[inside] * MAX_INTENSITY).astype(np.uint16)
    for name in EXTRA_BYTES:
        records[name] = cells[name][cell]
    return records
