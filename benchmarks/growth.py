"""Costs of the store with few epochs and with a year of them, and of reading, compaction and start-up.

python -m benchmarks.growth [--folder DIR]

The epochs of a store are copies of a few rasters. A year on the full grid takes 15 GB.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import groupby
from multiprocessing.connection import Connection
from pathlib import Path
from unittest import mock

import netCDF4
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import ndimage

from benchmarks.process_cost import cpu_of, family, peak_of
from station.archive import epochs
from station.archive.areas import AreaChange, update_areas
from station.archive.derived.boxes import Rasters
from station.archive.netcdf_layout import Series, encode_text
from station.archive.reference_files import write_reference
from station.archive.series import compaction
from station.archive.series.epoch_reader import EpochSource, read_source
from station.archive.series.index import SeriesIndex
from station.archive.series.lazy import open_series
from station.archive.series.virtual import build_series
from station.config import Site, read_site
from station.inbox.file_hash import sha256_file
from station.inbox.journal import Journal
from station.inbox.journal_reader import Entry, State
from station.processing.epoch_recorder import EpochRecorder
from station.processing.integrity import store_files
from station.processing.scan_tasks import StoredResult
from station.processing.site_files import load_areas, series_for
from station.processing.store_tasks import update_series
from station.quantities import Bools, Grid, Measurement, Reference, SharedParameters
from station.queries.blocks import BlockQueries, update_boxes
from station.queries.events import EventQueries
from station.science.gridding.stored_precision import quantum, round_total
from station.science.uncertainty.parameters import parameter_layout
from station.service.publishing import publish

YEAR = 8760  # hourly scans
FEW = 60  # as many as any search for events looks at
OPEN_EPOCHS = 37  # most epochs in files of their own: a day, and the hours until it is compacted
SMALL = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=60, ny=45)
FULL = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=1.0, nx=4000, ny=5000)
TEMPLATES = 3  # different rasters of a store
ROUNDS = 3
PAGE_UPDATES = 20  # until all maps are drawn
READ_VARIABLES = ("elevation_change", "elevation_change_uncertainty")  # of the year on the full grid
SYSTEMATIC_M = 0.01
COVERAGE = 0.31  # share of the cells of a grid that an epoch observes
READ_COVERAGE = 0.02  # of the year that is read: other cells are neither stored nor read
SITE = """
[station]
id = "hef"
data = "data"
[scans]
inbox = "inbox"
[map]
crs = "EPSG:32632"
[scanner]
model = "riegl-vz-6000"
[[sop]]
from = 2024-10-01T00:00:00Z
file = "sop.dat"
[grid]
bounds_m = {{ west = {west}, south = {south}, east = {east}, north = {north} }}
cell_m = {cell}
[adjustment]
method = "joint"
[areas]
file = "areas.geojson"
"""


def station_of(folder: Path, grid: Grid) -> Site:
    """Return the site of a new station on a grid, with two areas and a reference but no scan."""
    (folder / "inbox").mkdir(parents=True)
    south_m, east_m = grid.north_m - grid.ny * grid.cell_m, grid.west_m + grid.nx * grid.cell_m
    text = SITE.format(west=grid.west_m, south=south_m, east=east_m, north=grid.north_m, cell=grid.cell_m)
    (folder / "site.toml").write_text(text)
    np.savetxt(folder / "sop.dat", np.eye(4))
    boxes = [_box(grid, "first", 0.1), _box(grid, "second", 0.5)]
    (folder / "areas.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": boxes}))
    site = read_site(folder / "site.toml")
    row, column = np.indices(grid.shape)
    elevation_m = 2800 + 0.2 * row + 20 * np.sin(column / 60)
    reference = replace(
        Reference.from_elevation(grid, "1", elevation_m, elevation_m > 2820),
        random_variance_m2=np.full(grid.shape, 0.005**2, np.float32),
    )
    write_reference(series_for(site), reference)
    return site


def _box(grid: Grid, name: str, share: float) -> dict[str, object]:
    """Return an area with a side of 100 m, or of a tenth of a small grid."""
    side_m = min(100.0, grid.nx * grid.cell_m / 10)
    west_m = grid.west_m + share * grid.nx * grid.cell_m
    south_m = grid.north_m - share * grid.ny * grid.cell_m - side_m
    corners = ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))
    ring = [[west_m + side_m * x, south_m + side_m * y] for x, y in corners]
    return {
        "type": "Feature",
        "properties": {"name": name},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }


def synthetic_epoch(grid: Grid, start: datetime, coverage: float = COVERAGE) -> epochs.Epoch:
    """Return an epoch that observes a share of the grid, in patches; half of the ground has changed."""
    random = np.random.default_rng(int(start.timestamp()) // 3600)
    observed = _patches(np.random.default_rng(1), grid, coverage)
    random_m = np.where(observed, random.uniform(0.01, 0.03, grid.shape), np.nan).astype(np.float32)
    change_m = random_m * random.normal(size=grid.shape).astype(np.float32)
    change_m -= np.where(_patches(np.random.default_rng(2), grid, 0.5), np.float32(0.2), np.float32(0.0))
    change_m = np.rint(change_m / quantum(random_m)) * quantum(random_m)
    systematic_m = np.where(observed, np.float32(SYSTEMATIC_M), np.float32(np.nan))
    count = np.where(observed, random.poisson(3, grid.shape) + 1, 0).astype(np.int32)
    measurement = Measurement.from_rasters(
        grid,
        observed.astype(np.uint8),
        elevation_m=2800.0 + change_m,
        change_m=change_m,
        uncertainty_m=round_total(random_m, systematic_m),
        systematic_uncertainty_m=systematic_m,
        spread_m=random_m,
        count=count,
    )
    params = parameter_layout(grid, (grid.west_m, grid.north_m, 3200.0))
    size = len(params.names)
    return epochs.Epoch(
        start_s=start.timestamp(),
        end_s=start.timestamp() + 900,
        scan_id=f"{start:%y%m%d_%H%M%S}",
        measurement=measurement,
        shared=SharedParameters(
            params.names, params.units, random.normal(size=size) * 1e-5, np.eye(size) * 1e-10, np.zeros(size)
        ),
        verdict="good",
        verdict_reason="",
        scalars={
            "platform_roll": 0.1, "platform_pitch": -0.2, "air_temperature": -3.5, "air_pressure": 690.0,
            "relative_humidity": 60.0, "point_total": 1e6, "coverage": coverage, "stable_median": 0.001,
            "stable_nmad": 0.02, "stable_z_std": 1.02, "scanner_east": grid.west_m,
            "scanner_north": grid.north_m, "scanner_height": 3200.0, "scanner_axis_east": 0.0,
            "scanner_axis_north": 0.0,
        },
        provenance={
            "reference_version": "1", "adjustment": "joint", "sop_id": "sop-1", "science_hash": "0" * 16,
            "scan_sha256": random.bytes(32).hex(), "log_sha256": random.bytes(32).hex(),
        },
    )  # fmt: skip


def _patches(random: np.random.Generator, grid: Grid, share: float) -> Bools:
    """Return a share of the cells (ny, nx), in patches of a fiftieth of the grid."""
    side = max(grid.nx // 50, 1)
    shape = grid.ny // side + 1, grid.nx // side + 1
    coarse = ndimage.gaussian_filter(random.normal(size=shape), 1.5)
    fine = np.repeat(np.repeat(coarse, side, axis=0), side, axis=1)[: grid.ny, : grid.nx]
    return np.asarray(fine >= np.quantile(coarse, 1 - share))


def fill(
    site: Site, count: int, *, compacted_coverage: float = COVERAGE, until: datetime | None = None
) -> datetime:
    """Store `count` hourly epochs, the older ones compacted as by the service; return the next start.

    Their rasters are those of a few epochs; `compacted_coverage` is the share of the grid that the compacted
    ones observe.
    """
    series = series_for(site)
    end = (until or datetime.now(UTC)).replace(minute=0, second=0, microsecond=0) - timedelta(hours=2)
    starts = [end - timedelta(hours=back) for back in range(count, 0, -1)]
    open_starts = starts[-OPEN_EPOCHS:]
    compacted = starts[:-OPEN_EPOCHS]
    for kind, stamp, group in _closed_periods(compacted):
        place = series.folder / kind / group[0].strftime("%Y/%m" if kind == "days" else "%Y")
        name = group[0].strftime(stamp)
        sources = list((_days if kind == "months" else _hours)(series, group, compacted_coverage))
        compaction.write_compacted(
            series, sources, place / f"{series.station_id}_{name}_r1.nc", name, lambda: None
        )
    for source, start in zip(_hours(series, open_starts, COVERAGE), open_starts, strict=True):
        copy_epoch(series, source.path, start)
    with Journal(site.station.data / "journal.sqlite") as journal:
        journal.import_entries(_entry(series, start) for start in starts)
        journal.add_checksums(
            {str(path.relative_to(series.folder)): sha256_file(path) for path in store_files(series)}
        )
    build_series(series)
    update_areas(series, load_areas(site), _InstantAggregator(), lambda: None)
    update_boxes(series, RepeatedBlocks(series), lambda: None)
    with mock.patch.object(EventQueries, "_search", return_value=[]):  # of a year it would take half an hour
        update_series(site, lambda: None)
    for _ in range(PAGE_UPDATES):
        publish(site, None, lambda: None)
    return end


def copy_epoch(series: Series, template: Path, start: datetime) -> Path:
    """Store a copy of an epoch file under another time; return its path."""
    path = epochs.epoch_folder(series, start) / f"{series.station_id}_{start:{epochs.TIME_FORMAT}}.nc"
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(template, path)
    with netCDF4.Dataset(path, "a") as file:
        file["time"][0] = start.timestamp() + 450
        file["time_bnds"][0] = (start.timestamp(), start.timestamp() + 900)
        file["epoch_file"][0] = encode_text([path.name], "text")[0]
    return path


class _InstantAggregator:
    """Aggregator that reads no epoch."""

    def area(self, cells: Bools, epoch: epochs.EpochRef) -> AreaChange:
        """Return a change that depends on the time only."""
        value_m = epoch.time_s % 1e5 / 1e5 + cells[0, 0]
        return AreaChange(value_m, 0.01, value_m, 0.01, 1.0)


class RepeatedBlocks(BlockQueries):
    """Blocks of the newest epoch, for all epochs and days."""

    def __init__(self, series: Series) -> None:
        """Read the newest epoch."""
        super().__init__(series)
        newest = SeriesIndex(series)[-1]
        self._boxes, self._mean = super().boxes(newest), super().daily_mean([newest])
        self._single = super().single(newest)

    def single(self, epoch: epochs.EpochRef) -> Rasters:  # noqa: ARG002
        """Return the blocks of the newest epoch."""
        return self._single

    def boxes(self, epoch: epochs.EpochRef) -> Rasters:  # noqa: ARG002 - all epochs are alike
        """Return the boxes of the newest epoch."""
        return self._boxes

    def daily_mean(self, day: Sequence[epochs.EpochRef]) -> Rasters:  # noqa: ARG002
        """Return the blocks of the newest epoch."""
        return self._mean


def _closed_periods(starts: list[datetime]) -> Iterator[tuple[str, str, list[datetime]]]:
    """Yield kind, name format and epochs of each closed period: months, and the days of the newest month."""
    if not starts:
        return
    newest = starts[-1].strftime("%Y%m")
    for month, group in groupby(starts, lambda start: start.strftime("%Y%m")):
        if month != newest:
            yield "months", "%Y%m", list(group)
        else:
            for _, day in groupby(group, lambda start: start.date()):
                yield "days", "%Y%m%d", list(day)


def _hours(
    series: Series, starts: list[datetime], coverage: float, names: tuple[str, ...] | None = None
) -> Iterator[EpochSource]:
    """Yield sources of epochs at these starts, which repeat a few rasters."""
    templates = replace(series, folder=series.folder.parent / f"templates-{coverage:g}")
    for index, start in enumerate(starts):
        template = datetime(2020, 1, 1, index % TEMPLATES, tzinfo=UTC)
        path = (
            epochs.epoch_folder(templates, template)
            / f"{series.station_id}_{template:{epochs.TIME_FORMAT}}.nc"
        )
        if not path.is_file():
            epochs.write_epoch(templates, synthetic_epoch(series.grid, template, coverage))
        yield _select(_dated(read_source(path, 0, index, 1), series, [start]), names)


def _days(
    series: Series, starts: list[datetime], coverage: float, names: tuple[str, ...] | None = None
) -> Iterator[EpochSource]:
    """Yield sources of the days of a month, all copies of one compacted day."""
    path = series.folder.parent / f"templates-{coverage:g}" / "day.nc"
    if not path.is_file():
        day = [datetime(2020, 1, 1, hour, tzinfo=UTC) for hour in range(24)]
        compaction.write_compacted(
            series, list(_hours(series, day, coverage, names)), path, "a day", lambda: None
        )
    index = 0
    for _, group in groupby(starts, lambda start: start.date()):
        day = list(group)
        yield _dated(read_source(path, 0, index, len(day)), series, day)
        index += len(day)


def _dated(source: EpochSource, series: Series, starts: list[datetime]) -> EpochSource:
    """Return a source with other start times of its epochs."""
    scalars, start_s = dict(source.scalars), np.array([start.timestamp() for start in starts])
    scalars["time"], scalars["time_bnds"] = start_s + 450, np.stack([start_s, start_s + 900], axis=-1)
    for name, values in (
        ("epoch_file", [f"{series.station_id}_{start:{epochs.TIME_FORMAT}}.nc" for start in starts]),
        ("scan_id", [f"{start:%y%m%d_%H%M%S}" for start in starts]),
        ("scan_sha256", [np.random.default_rng(int(second)).bytes(32).hex() for second in start_s]),
    ):
        scalars[name] = encode_text(values, "text")
    return replace(source, scalars=scalars)


def _entry(series: Series, start: datetime) -> Entry:
    name = f"{series.station_id}_{start:{epochs.TIME_FORMAT}}.nc"
    return Entry(
        name=f"{start:%y%m%d_%H%M%S}.laz", size=1, mtime_ns=1, state=State.STORED, waiting_reason="",
        reason="", sha256=None, log_sha256="", outcome=State.STORED, verdict="good",
        epoch=f"epochs/{start:%Y/%m/%d}/{name}", start_utc_s=start.timestamp(), revision=1, reference="1",
        metrics={"points": 1_000_000, "sigma_median_m": 0.02, "seconds": 3.0}, attempts=0,
        next_try_utc_s=None, first_seen_utc_s=start.timestamp(), changed_utc_s=start.timestamp(),
    )  # fmt: skip


def cost(site: Site, start: datetime) -> dict[str, float]:
    """Return CPU seconds of storing an epoch, the best of a few, by step.

    `write_s`: its file, with the preview for the page; `update_s`: series and areas; `publish_s`: the page.
    """
    seconds: dict[str, list[float]] = {"write_s": [], "update_s": [], "publish_s": []}
    for hour in range(ROUNDS + 1):
        epoch = synthetic_epoch(site.grid_cells, start + timedelta(hours=hour))
        ends_s = [time.process_time()]
        stored = _write(site, epoch)
        ends_s.append(time.process_time())
        update_series(site, lambda: None)
        ends_s.append(time.process_time())
        publish(site, stored, lambda: None)
        ends_s.append(time.process_time())
        for values, step_s in zip(seconds.values(), np.diff(ends_s), strict=True):
            values.append(float(step_s))
    return {name: min(values[1:]) for name, values in seconds.items()}


def _write(site: Site, epoch: epochs.Epoch) -> StoredResult:
    series = series_for(site)
    recorder = EpochRecorder(site, series, "1")
    path = epochs.write_epoch(series, epoch, on_rows=recorder.add).path
    recorder.keep(path)
    name = str(path.relative_to(series.folder))
    return StoredResult(epoch.start_s, "", name, 1, "good", "", "1", {}, "", "", recorder.overview)


def reading(folder: Path) -> dict[str, float]:
    """Return time to read a map, and a year of a 100 m box, on the full grid with few observed cells [s]."""
    series = Series(folder / "data", "hef", FULL, "EPSG:32632")
    end = datetime(2026, 7, 1, tzinfo=UTC)
    starts = [end - timedelta(hours=back) for back in range(YEAR, 0, -1)]
    for kind, stamp, group in _closed_periods(starts):
        name = group[0].strftime(stamp)
        path = series.folder / kind / f"{series.station_id}_{name}_r1.nc"
        sources = (_days if kind == "months" else _hours)(series, group, READ_COVERAGE, READ_VARIABLES)
        compaction.write_compacted(series, list(sources), path, name, lambda: None)
    build_series(series)
    measurement = synthetic_epoch(FULL, starts[0], READ_COVERAGE).measurement
    observed = np.isfinite(measurement.to_rasters("change_m")[0])
    share = ndimage.uniform_filter(observed.astype(np.float32), 100)
    row, column = np.unravel_index(np.argmax(share), FULL.shape)  # a box that is observed completely
    box = slice(None), slice(row - 50, row + 50), slice(column - 50, column + 50)

    figures = {}
    for name, selection in (("map", (YEAR // 2,)), ("box_year", box)):
        forget(series.folder)
        for state in ("cold", "warm"):
            start_s, start_cpu_s = time.monotonic(), time.process_time()
            with open_series(series.folder) as dataset:
                dataset.elevation_change[selection].load()
            figures[f"{name}_{state}_s"] = time.monotonic() - start_s
            figures[f"{name}_{state}_cpu_s"] = time.process_time() - start_cpu_s
    return figures


def forget(folder: Path) -> None:
    """Drop files from the page cache, so that they are read from the disk again."""
    for path in folder.rglob("*.nc"):
        file = os.open(path, os.O_RDONLY)
        os.fsync(file)
        os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(file)


def compacting(folder: Path) -> dict[str, float]:
    """Return time and peak memory of compacting a day on the full grid."""
    series = Series(folder / "data", "hef", FULL, "EPSG:32632")
    templates = replace(series, folder=folder / "templates")
    day = datetime(2026, 7, 1, tzinfo=UTC)
    for hour in range(TEMPLATES):
        epochs.write_epoch(templates, synthetic_epoch(FULL, day + timedelta(hours=hour)))
    for hour in range(24):
        template = epochs.epoch_files(templates)[hour % TEMPLATES].path
        copy_epoch(series, template, day + timedelta(hours=hour))
    build_series(series)
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe()
    child = context.Process(target=_compact_once, args=(series, sender))
    child.start()
    sender.close()  # so that a failed child is an error here
    figures = receiver.recv()
    child.join()
    return dict(zip(("compact_day_s", "compact_day_cpu_s", "compact_day_gb"), figures, strict=True))


def _compact_once(series: Series, sender: Connection) -> None:
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    compaction.compact(series, datetime(2026, 7, 3, tzinfo=UTC), lambda: None)
    sender.send((time.monotonic() - start_s, time.process_time() - start_cpu_s, peak_of(os.getpid())))


def starting(site_file: Path) -> dict[str, float]:
    """Return time until the service is ready, and CPU time of all its processes [s].

    `cold`: the files of the store are read from the disk.
    """
    figures = {}
    for state in ("cold", "warm"):
        if state == "cold":
            forget(site_file.parent)
        start_s = time.monotonic()
        command = [sys.executable, "-m", "station", "run", str(site_file)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service:
            assert service.stderr is not None  # noqa: S101 - it is a pipe
            if not any("service=running" in line for line in service.stderr):
                raise RuntimeError(f"the service does not start: {site_file}")
            figures[f"ready_{state}_s"] = time.monotonic() - start_s
            figures[f"ready_{state}_cpu_s"] = cpu_of(family(service.pid))
            service.send_signal(signal.SIGTERM)
            service.communicate()
    return figures


def store_costs(folder: Path) -> dict[str, float]:
    """Return the cost of an epoch with few and with a year stored, of reading, compaction and start-up."""
    figures: dict[str, float] = {}
    # On the full grid the rasters of compacted epochs are empty: storing an epoch does not read them.
    for grid, coverage, size in ((SMALL, COVERAGE, "small"), (FULL, 0.0, "full")):
        for word, count in (("few", FEW), ("year", YEAR)):
            place = folder / f"{size}-{word}"
            shutil.rmtree(place, ignore_errors=True)
            site = station_of(place, grid)
            costs = cost(site, fill(site, count, compacted_coverage=coverage))
            figures |= {f"{name}_{size}_{word}": value for name, value in costs.items()}
    figures |= starting(folder / "small-year" / "site.toml")
    for work in (compacting, reading):
        place = folder / work.__name__
        shutil.rmtree(place, ignore_errors=True)
        figures |= work(place)
    return figures


def main() -> None:
    """Print all costs of the store."""
    parser = argparse.ArgumentParser(
        description="Costs of the store with few epochs and with a year of them."
    )
    parser.add_argument("--folder", type=Path, help="folder that keeps the stores")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        figures = store_costs(arguments.folder or Path(temporary))
    table = Table("figure", "value", title="Growth")
    for name, value in figures.items():
        table.add_row(name, f"{value:.3g}")
    Console(width=100).print(table)


def _select(source: EpochSource, names: tuple[str, ...] | None) -> EpochSource:
    """Return a source of some of its rasters; None for all."""
    if names is None:
        return source
    shapes = {name: shape for name, shape in source.raster_shapes.items() if name in names}
    return replace(source, raster_shapes=shapes)


if __name__ == "__main__":
    main()
