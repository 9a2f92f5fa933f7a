"""What a scan costs at the store's side, and how that grows with the epochs stored.

python -m benchmarks.growth [--folder DIR]
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
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import groupby
from multiprocessing.connection import Connection
from pathlib import Path

import netCDF4
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import ndimage

from station.archive import join, store
from station.archive.aggregate import AreaChange
from station.archive.areas import update_areas
from station.archive.layout import Series
from station.archive.layout import text as letters_of
from station.archive.opened import open_series
from station.archive.reference import write_reference
from station.archive.series import build_series
from station.archive.sources import Source, read_source
from station.config import Site, read_site
from station.quantities import Bools, Grid, Measurement, Reference, Shared, Surface
from station.science.shared import basis
from station.service.content import sha256_of
from station.service.integrity import store_files
from station.service.journal import Entry, Journal, State
from station.service.show import show
from station.service.tasks import areas_of, series_of
from station.service.upkeep import publish

YEAR = 8760  # hourly scans
FEW = 10
OPEN = 37  # the most that lie by themselves where scans come hourly: a day, and until the day after is joined
SMALL = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=60, ny=45)
FULL = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=1.0, nx=4000, ny=5000)
DISTINCT = 3  # rasters that the epochs of a store take turns with
ROUNDS = 3
SHOWN = 20
READ = ("elevation", "elevation_change")  # variables of the year on the full grid
SEEN_OF_A_YEAR = 0.02  # of its cells: the rest is neither stored nor read
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
    """Write a site of that grid, with two areas and a reference, and no scan."""
    (folder / "inbox").mkdir(parents=True)
    south_m, east_m = grid.north_m - grid.ny * grid.cell_m, grid.west_m + grid.nx * grid.cell_m
    told = SITE.format(west=grid.west_m, south=south_m, east=east_m, north=grid.north_m, cell=grid.cell_m)
    (folder / "site.toml").write_text(told)
    np.savetxt(folder / "sop.dat", np.eye(4))
    boxes = [_box(grid, "one", 0.1), _box(grid, "other", 0.5)]
    (folder / "areas.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": boxes}))
    site = read_site(folder / "site.toml")
    row, column = np.indices(grid.shape)
    elevation_m = 2800 + 0.2 * row + 20 * np.sin(column / 60)
    known = replace(
        Reference.given(grid, "1", elevation_m, elevation_m > 2820),
        random_variance_m2=np.full(grid.shape, 0.005**2, np.float32),
    )
    write_reference(series_of(site), known)
    return site


def _box(grid: Grid, name: str, share: float) -> dict[str, object]:
    """An area of a hundred metres, or of a tenth of a small grid."""
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


def epoch_of(grid: Grid, start: datetime, seen: float = 0.31) -> store.Epoch:
    """An epoch that sees so large a share of the grid, in patches, where half of the ground moved."""
    random = np.random.default_rng(int(start.timestamp()) // 3600)
    there = _patchy(np.random.default_rng(1), grid, seen)
    random_m = np.where(there, random.uniform(0.01, 0.03, grid.shape), np.nan).astype(np.float32)
    change_m = random_m * random.normal(size=grid.shape).astype(np.float32)
    change_m -= np.where(_patchy(np.random.default_rng(2), grid, 0.5), np.float32(0.2), np.float32(0.0))
    count = np.where(there, random.poisson(3, grid.shape) + 1, 0).astype(np.int32)
    surface = Surface(grid, 2800.0 + change_m, change_m, count, random_m)
    of = basis(grid, (grid.west_m, grid.north_m, 3200.0))
    size = len(of.names)
    return store.Epoch(
        start_s=start.timestamp(),
        end_s=start.timestamp() + 900,
        scan_id=f"{start:%y%m%d_%H%M%S}",
        measurement=Measurement(surface, np.hypot(random_m, 0.01), random_m, there.astype(np.uint8), {}),
        shared=Shared(
            of.names, of.units, random.normal(size=size) * 1e-5, np.eye(size) * 1e-10, np.zeros(size)
        ),
        verdict="good",
        verdict_reason="",
        numbers={
            "platform_roll": 0.1, "platform_pitch": -0.2, "air_temperature": -3.5, "air_pressure": 690.0,
            "relative_humidity": 60.0, "point_total": 1e6, "coverage": seen, "stable_median": 0.001,
            "stable_nmad": 0.02, "stable_z_std": 1.02, "scanner_east": grid.west_m,
            "scanner_north": grid.north_m, "scanner_height": 3200.0, "scanner_axis_east": 0.0,
            "scanner_axis_north": 0.0,
        },
        provenance={
            "reference_version": "1", "adjustment": "joint", "sop_id": "sop-1", "science_hash": "0" * 16,
            "scan_sha256": random.bytes(32).hex(), "log_sha256": random.bytes(32).hex(),
        },
    )  # fmt: skip


def _patchy(random: np.random.Generator, grid: Grid, share: float) -> Bools:
    """Cells in patches of a fiftieth of the grid, so large a share of all."""
    side = max(grid.nx // 50, 1)
    shape = grid.ny // side + 1, grid.nx // side + 1
    coarse = ndimage.gaussian_filter(random.normal(size=shape), 1.5)
    fine = np.repeat(np.repeat(coarse, side, axis=0), side, axis=1)[: grid.ny, : grid.nx]
    return np.asarray(fine >= np.quantile(coarse, 1 - share))


def fill(site: Site, epochs: int, seen: float = 0.31, *, until: datetime | None = None) -> datetime:
    """Store so many hourly epochs, the older ones joined as the service does; return the next one's start.

    Joined files take their rasters from a few epochs.
    """
    series = series_of(site)
    end = (until or datetime.now(UTC)).replace(minute=0, second=0, microsecond=0) - timedelta(hours=2)
    starts = [end - timedelta(hours=back) for back in range(epochs, 0, -1)]
    by_themselves = starts[-OPEN:]
    joined = starts[:-OPEN]
    for kind, stamp, group in _closed(joined):
        place = series.folder / kind / group[0].strftime("%Y/%m" if kind == "days" else "%Y")
        name = group[0].strftime(stamp)
        held = list((_days if kind == "months" else _turns)(series, group, seen))
        join.write_joined(series, held, place / f"{series.station_id}_{name}_r1.nc", name, lambda: None)
    for start in by_themselves:
        store.write_epoch(series, epoch_of(site.grid_cells, start, seen))
    with Journal(site.station.data / "journal.sqlite") as journal:
        journal.adopt(_entry(series, start) for start in starts)
        journal.note_files(
            {str(path.relative_to(series.folder)): sha256_of(path) for path in store_files(series)}
        )
    build_series(series)
    update_areas(series, areas_of(site), _Quick(), lambda: None)
    publish(site, lambda: None)
    for _ in range(SHOWN):  # until all maps are drawn
        show(site, None, lambda: None)
    return end


class _Quick:
    """Tells of areas without looking."""

    def area(self, cells: Bools, row: store.Row) -> AreaChange:
        """How an area changed, by the time alone."""
        value_m = row.time_s % 1e5 / 1e5 + cells[0, 0]
        return AreaChange(value_m, 0.01, value_m, 0.01, 1.0)


def _closed(starts: list[datetime]) -> Iterator[tuple[str, str, list[datetime]]]:
    """Group what is closed by months, and the newest month by days."""
    if not starts:
        return
    newest = starts[-1].strftime("%Y%m")
    for month, group in groupby(starts, lambda start: start.strftime("%Y%m")):
        if month != newest:
            yield "months", "%Y%m", list(group)
        else:
            for _, day in groupby(group, lambda start: start.date()):
                yield "days", "%Y%m%d", list(day)


def _turns(
    series: Series, starts: list[datetime], seen: float, names: tuple[str, ...] | None = None
) -> Iterator[Source]:
    """Give sources for epochs at these starts, which take turns with a few rasters."""
    made = replace(series, folder=series.folder.parent / "templates")
    for at, start in enumerate(starts):
        like = datetime(2020, 1, 1, at % DISTINCT, tzinfo=UTC)
        path = store.epoch_folder(made, like) / f"{series.station_id}_{like:{store.STAMP}}.nc"
        if not path.is_file():
            store.write_epoch(made, epoch_of(series.grid, like, seen))
        yield _only(_dated(read_source(path, 0, at, 1), series, [start]), names)


def _days(
    series: Series, starts: list[datetime], seen: float, names: tuple[str, ...] | None = None
) -> Iterator[Source]:
    """Give sources for the days of a month, each of which is the same day that was joined before."""
    path = series.folder.parent / "templates" / "day.nc"
    if not path.is_file():
        day = [datetime(2020, 1, 1, hour, tzinfo=UTC) for hour in range(24)]
        join.write_joined(series, list(_turns(series, day, seen, names)), path, "a day", lambda: None)
    at = 0
    for _, group in groupby(starts, lambda start: start.date()):
        day = list(group)
        yield _dated(read_source(path, 0, at, len(day)), series, day)
        at += len(day)


def _dated(source: Source, series: Series, starts: list[datetime]) -> Source:
    """Return a source as if its epochs were of these starts."""
    words, start_s = dict(source.words), np.array([start.timestamp() for start in starts])
    words["time"], words["time_bnds"] = start_s + 450, np.stack([start_s, start_s + 900], axis=-1)
    for name, values in (
        ("epoch_file", [f"{series.station_id}_{start:{store.STAMP}}.nc" for start in starts]),
        ("scan_id", [f"{start:%y%m%d_%H%M%S}" for start in starts]),
        ("scan_sha256", [np.random.default_rng(int(one)).bytes(32).hex() for one in start_s]),
    ):
        words[name] = letters_of(values, "text")
    return replace(source, words=words)


def _entry(series: Series, start: datetime) -> Entry:
    name = f"{series.station_id}_{start:{store.STAMP}}.nc"
    return Entry(
        name=f"{start:%y%m%d_%H%M%S}.laz", size=1, mtime_ns=1, state=State.STORED, waits_for="", reason="",
        sha256=None, log_sha256="", outcome=State.STORED, verdict="good",
        epoch=f"epochs/{start:%Y/%m/%d}/{name}", start_utc_s=start.timestamp(), revision=1, reference="1",
        figures={"points": 1_000_000, "sigma_median_m": 0.02, "seconds": 3.0}, attempts=0,
        next_try_utc_s=None, seen_utc_s=start.timestamp(), changed_utc_s=start.timestamp(),
    )  # fmt: skip


def cost(site: Site, start: datetime, seen: float = 0.31) -> dict[str, float]:
    """Return CPU seconds of what follows the measuring of a scan, the best of a few scans."""
    series = series_of(site)
    taken: dict[str, list[float]] = {}
    for one in range(ROUNDS + 1):
        begun = start + timedelta(hours=one)
        store.write_epoch(series, epoch_of(site.grid_cells, begun, seen))
        steps: dict[str, Callable[[], object]] = {
            "publish_s": lambda: publish(site, lambda: None),
            "show_s": lambda begun=begun: show(site, begun.timestamp(), lambda: None),
        }
        for name, step in steps.items():
            began_s = time.process_time()
            step()
            taken.setdefault(name, []).append(time.process_time() - began_s)
    return {name: min(found[1:]) for name, found in taken.items()}


def reading(folder: Path) -> dict[str, float]:
    """Return how long a map and a year of a 100 m box take on the full grid, where few cells are seen."""
    series = Series(folder / "data", "hef", FULL, "EPSG:32632")
    end = datetime(2026, 7, 1, tzinfo=UTC)
    starts = [end - timedelta(hours=back) for back in range(YEAR, 0, -1)]
    for kind, stamp, group in _closed(starts):
        name = group[0].strftime(stamp)
        path = series.folder / kind / f"{series.station_id}_{name}_r1.nc"
        made = _days if kind == "months" else _turns
        held = list(made(series, group, SEEN_OF_A_YEAR, READ))
        join.write_joined(series, held, path, name, lambda: None)
    build_series(series)
    seen = np.isfinite(epoch_of(FULL, starts[0], SEEN_OF_A_YEAR).measurement.surface.change_m)
    share = ndimage.uniform_filter(seen.astype(np.float32), 100)
    row, column = np.unravel_index(np.argmax(share), FULL.shape)  # where all is seen
    box = slice(row - 50, row + 50), slice(column - 50, column + 50)

    def open_map() -> object:
        with open_series(series.folder) as told:
            return told.elevation_change[YEAR // 2].load()

    def open_box() -> object:
        with open_series(series.folder) as told:
            return told.elevation_change[:, box[0], box[1]].load()

    return {"map_s": _wall(open_map), "box_year_s": _wall(open_box)}


def _only(source: Source, names: tuple[str, ...] | None) -> Source:
    return (
        source
        if names is None
        else replace(source, shapes={name: shape for name, shape in source.shapes.items() if name in names})
    )


def _wall(work: Callable[[], object]) -> float:
    began_s = time.monotonic()
    work()
    return time.monotonic() - began_s


def joining(folder: Path, seen: float = 0.31) -> dict[str, float]:
    """Return how long the joining of a day takes on the full grid, and the most memory it needs."""
    series = Series(folder / "data", "hef", FULL, "EPSG:32632")
    templates = replace(series, folder=folder / "templates")
    day = datetime(2026, 7, 1, tzinfo=UTC)
    for hour in range(DISTINCT):
        store.write_epoch(templates, epoch_of(FULL, day + timedelta(hours=hour), seen))
    for hour in range(24):
        start = day + timedelta(hours=hour)
        given = store.epochs(templates)[hour % DISTINCT].path
        path = store.epoch_folder(series, start) / f"{series.station_id}_{start:{store.STAMP}}.nc"
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(given, path)
        with netCDF4.Dataset(path, "a") as file:
            file["time"][:] = start.timestamp() + 450
            file["time_bnds"][:] = (start.timestamp(), start.timestamp() + 900)
            file["epoch_file"][0] = letters_of([path.name], "text")[0]
    build_series(series)
    here, there = multiprocessing.get_context("spawn").Pipe()
    child = multiprocessing.get_context("spawn").Process(target=_join_once, args=(series, there))
    child.start()
    taken = here.recv()
    child.join()
    return dict(zip(("join_day_s", "join_day_cpu_s", "join_day_gb"), taken, strict=True))


def _join_once(series: Series, there: Connection) -> None:
    began_s, before_s = time.monotonic(), time.process_time()
    join.join_closed(series, datetime(2026, 7, 3, tzinfo=UTC), lambda: None)
    taken = time.monotonic() - began_s, time.process_time() - before_s
    told = (
        Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
    )  # kB; rusage tells the parent's
    there.send((*taken, int(told) / 2**20))


def starting(site_file: Path) -> dict[str, float]:
    """Return how long the service takes until it says that it runs, wall and CPU [s]."""
    before_s = os.times()
    began_s = time.monotonic()
    command = [sys.executable, "-m", "station.cli", "run", str(site_file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service:
        assert service.stderr is not None  # noqa: S101 - asked for
        for line in service.stderr:
            if "service=running" in line:
                break
        ready_s = time.monotonic() - began_s
        service.send_signal(signal.SIGTERM)
        service.communicate()
    after_s = os.times()
    cpu_s = after_s.children_user + after_s.children_system
    return {"ready_s": ready_s, "run_cpu_s": cpu_s - before_s.children_user - before_s.children_system}


def main() -> None:
    """Print what a scan costs at few epochs and at a year of them."""
    parser = argparse.ArgumentParser(description="What a scan costs as the store grows.")
    parser.add_argument("--folder", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        folder = asked.folder or Path(passing)
        found = growth(folder)
    table = Table(title="Growth")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in found.items():
        table.add_row(name, f"{value:.3g}")
    Console(width=100).print(table)


def growth(folder: Path) -> dict[str, float]:
    """Return what a scan costs after it was measured, at few epochs and at a year of them, and the ratios."""
    found: dict[str, float] = {}
    for word, epochs in (("few", FEW), ("year", YEAR)):
        place = folder / word
        shutil.rmtree(place, ignore_errors=True)
        site = station_of(place, SMALL)
        found |= {f"{name}_{word}": value for name, value in cost(site, fill(site, epochs)).items()}
    found |= {
        name.replace("_s_few", "_ratio"): found[name.replace("_few", "_year")] / value
        for name, value in found.items()
        if name.endswith("_few")
    }
    found |= starting(folder / "year" / "site.toml")
    for work in (joining, reading):
        place = folder / work.__name__
        shutil.rmtree(place, ignore_errors=True)
        found |= work(place)
    return found


if __name__ == "__main__":
    main()
