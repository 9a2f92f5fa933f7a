"""What a scan costs at the store's side, and how that grows with the epochs stored."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path

import netCDF4
import numpy as np
import xarray as xr
from scipy import ndimage

from benchmarks.cost import STEPS
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
from station.quantities import Bools, Grid, Measurement, Reference, Shared
from station.science.shared import basis
from station.service.content import sha256_of
from station.service.integrity import store_files
from station.service.journal import Entry, Journal, State
from station.service.pictures import Watched
from station.service.show import show
from station.service.tasks import Outcome, areas_of, series_of
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
SEEN = 0.31  # of a grid's cells, in an epoch
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


def epoch_of(grid: Grid, start: datetime, seen: float = SEEN) -> store.Epoch:
    """An epoch that sees so large a share of the grid, in patches, where half of the ground moved."""
    random = np.random.default_rng(int(start.timestamp()) // 3600)
    there = _patchy(np.random.default_rng(1), grid, seen)
    random_m = np.where(there, random.uniform(0.01, 0.03, grid.shape), np.nan).astype(np.float32)
    change_m = random_m * random.normal(size=grid.shape).astype(np.float32)
    change_m -= np.where(_patchy(np.random.default_rng(2), grid, 0.5), np.float32(0.2), np.float32(0.0))
    count = np.where(there, random.poisson(3, grid.shape) + 1, 0).astype(np.int32)
    measured = Measurement.of(
        grid,
        there.astype(np.uint8),
        elevation_m=2800.0 + change_m,
        change_m=change_m,
        uncertainty_m=np.hypot(random_m, 0.01),
        random_uncertainty_m=random_m,
        spread_m=random_m,
        count=count,
    )
    of = basis(grid, (grid.west_m, grid.north_m, 3200.0))
    size = len(of.names)
    return store.Epoch(
        start_s=start.timestamp(),
        end_s=start.timestamp() + 900,
        scan_id=f"{start:%y%m%d_%H%M%S}",
        measurement=measured,
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


def fill(site: Site, epochs: int, *, joined_seen: float = SEEN, until: datetime | None = None) -> datetime:
    """Store so many hourly epochs, the older ones joined as the service does; return the next one's start.

    They take their rasters from a few epochs, joined ones from those that see so large a share of the grid.
    """
    series = series_of(site)
    end = (until or datetime.now(UTC)).replace(minute=0, second=0, microsecond=0) - timedelta(hours=2)
    starts = [end - timedelta(hours=back) for back in range(epochs, 0, -1)]
    by_themselves = starts[-OPEN:]
    joined = starts[:-OPEN]
    for kind, stamp, group in _closed(joined):
        place = series.folder / kind / group[0].strftime("%Y/%m" if kind == "days" else "%Y")
        name = group[0].strftime(stamp)
        held = list((_days if kind == "months" else _turns)(series, group, joined_seen))
        join.write_joined(series, held, place / f"{series.station_id}_{name}_r1.nc", name, lambda: None)
    for source, start in zip(_turns(series, by_themselves, SEEN), by_themselves, strict=True):
        alone(series, source.path, start)
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


def alone(series: Series, like: Path, start: datetime) -> None:
    """Store an epoch file that is another of another time, as quickly as it is copied."""
    path = store.epoch_folder(series, start) / f"{series.station_id}_{start:{store.STAMP}}.nc"
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(like, path)
    with netCDF4.Dataset(path, "a") as file:
        file["time"][:] = start.timestamp() + 450
        file["time_bnds"][:] = (start.timestamp(), start.timestamp() + 900)
        file["epoch_file"][0] = letters_of([path.name], "text")[0]


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
    made = replace(series, folder=series.folder.parent / f"templates-{seen:g}")
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
    path = series.folder.parent / f"templates-{seen:g}" / "day.nc"
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


def cost(site: Site, start: datetime) -> dict[str, float]:
    """Return CPU seconds of what the store, the areas and the page take for an epoch, the best of a few.

    Its file, with a look at it for the page; series and areas; the page.
    """
    taken: dict[str, list[float]] = {}
    for one in range(ROUNDS + 1):
        epoch = epoch_of(site.grid_cells, start + timedelta(hours=one))
        stored = list[Outcome]()
        steps: list[Callable[[], object]] = [
            lambda epoch=epoch, stored=stored: stored.append(_written(site, epoch)),
            lambda: publish(site, lambda: None),
            lambda stored=stored: show(site, stored[0], lambda: None),
        ]
        for name, step in zip(STEPS, steps, strict=True):
            began_s = time.process_time()
            step()
            taken.setdefault(name, []).append(time.process_time() - began_s)
    return {name: min(found[1:]) for name, found in taken.items()}


def _written(site: Site, epoch: store.Epoch) -> Outcome:
    series = series_of(site)
    watched = Watched(site, series, "1")
    path = store.write_epoch(series, epoch, seen=watched.add).path
    name = str(path.relative_to(series.folder))
    return Outcome(epoch.start_s, "", name, 1, "good", "", "1", {}, "", "", watched.look)


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
    measured = epoch_of(FULL, starts[0], SEEN_OF_A_YEAR).measurement
    seen = np.isfinite(measured.laid("change_m")[0])
    share = ndimage.uniform_filter(seen.astype(np.float32), 100)
    row, column = np.unravel_index(np.argmax(share), FULL.shape)  # where all is seen
    box = slice(row - 50, row + 50), slice(column - 50, column + 50)

    def a_map(told: xr.Dataset) -> None:
        told.elevation_change[YEAR // 2].load()

    def a_box(told: xr.Dataset) -> None:
        told.elevation_change[:, box[0], box[1]].load()

    def plainly(path: Path) -> xr.Dataset:
        return xr.open_dataset(path / "series.nc", decode_timedelta=False)

    found = {}
    for name, opened, work in (
        ("map", open_series, a_map), ("box_year", open_series, a_box), ("box_year_plain", plainly, a_box)
    ):  # fmt: skip
        forget(series.folder)
        for state in ("cold", "warm"):
            found |= {
                f"{name}_{state}_{key}": value for key, value in _took(opened, series.folder, work).items()
            }
    return found


def forget(folder: Path) -> None:
    """Have the kernel let go of what it keeps of files: they are read from the disk again."""
    for path in folder.rglob("*.nc"):
        file = os.open(path, os.O_RDONLY)
        os.fsync(file)
        os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(file)


def _took(
    opened: Callable[[Path], xr.Dataset], folder: Path, work: Callable[[xr.Dataset], None]
) -> dict[str, float]:
    began_s, used_s = time.monotonic(), time.process_time()
    with opened(folder) as told:
        work(told)
    return {"s": time.monotonic() - began_s, "cpu_s": time.process_time() - used_s}


def _only(source: Source, names: tuple[str, ...] | None) -> Source:
    return (
        source
        if names is None
        else replace(source, shapes={name: shape for name, shape in source.shapes.items() if name in names})
    )
