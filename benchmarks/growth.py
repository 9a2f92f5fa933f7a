"""What a scan costs at the store's side, and how that grows with the epochs stored.

python -m benchmarks.growth [--folder DIR]
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from station.archive import join, store
from station.archive.aggregate import AreaChange
from station.archive.areas import update_areas
from station.archive.layout import Series
from station.archive.reference import write_reference
from station.archive.series import build_series
from station.archive.sources import Source, read_source
from station.config import Site, read_site
from station.quantities import Bools, Grid, Measurement, Reference, Shared, Surface
from station.science.shared import basis
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


def epoch_of(grid: Grid, start: datetime, seen: float = 0.9) -> store.Epoch:
    """An epoch of noise that sees so large a share of the grid, in one piece about its middle."""
    random = np.random.default_rng(int(start.timestamp()) // 3600)
    ny, nx = grid.shape
    high, wide = (round(size * np.sqrt(seen)) for size in (ny, nx))
    where = slice((ny - high) // 2, (ny + high) // 2), slice((nx - wide) // 2, (nx + wide) // 2)
    there = np.zeros(grid.shape, bool)
    there[where] = True
    random_m = np.where(there, random.uniform(0.01, 0.03, grid.shape), np.nan).astype(np.float32)
    change_m = random_m * random.normal(size=grid.shape).astype(np.float32)
    count = np.where(there, 3, 0).astype(np.int32)
    surface = Surface(grid, 2800.0 + change_m, change_m, count, random_m, random_m**2)
    of = basis(grid, (grid.west_m, grid.north_m, 3200.0))
    size = len(of.names)
    return store.Epoch(
        start_s=start.timestamp(),
        end_s=start.timestamp() + 900,
        scan_id=f"{start:%y%m%d_%H%M%S}",
        measurement=Measurement(surface, np.hypot(random_m, 0.01), random_m, there.astype(np.uint8), {}),
        shared=Shared(of.names, of.units, random.normal(size=size) * 1e-5, np.eye(size) * 1e-10, np.zeros(size)),
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


def fill(site: Site, epochs: int, seen: float = 0.9, *, until: datetime | None = None) -> datetime:
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
        held = list(_turns(series, group, seen))
        join.write_joined(series, held, place / f"{series.station_id}_{name}_r1.nc", name, lambda: None)
    for start in by_themselves:
        store.write_epoch(series, epoch_of(site.grid_cells, start, seen))
    with Journal(site.station.data / "journal.sqlite") as journal:
        journal.adopt(_entry(series, start) for start in starts)
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


def _turns(series: Series, starts: list[datetime], seen: float) -> Iterator[Source]:
    """Give sources for epochs at these starts, which take turns with a few rasters."""
    templates = []
    for hour in range(DISTINCT):
        made = replace(series, folder=series.folder.parent / "templates")
        start = datetime(2020, 1, 1, hour, tzinfo=UTC)
        path = store.epoch_folder(made, start) / f"{series.station_id}_{start:{store.STAMP}}.nc"
        if not path.is_file():
            store.write_epoch(made, epoch_of(series.grid, start, seen))
        templates.append(read_source(path, 0, 0, 1))
    for at, start in enumerate(starts):
        template = templates[at % DISTINCT]
        words = dict(template.words)
        words["time"] = np.array([start.timestamp() + 450])
        words["time_bnds"] = np.array([[start.timestamp(), start.timestamp() + 900]])
        for name, value in (
            ("epoch_file", f"{series.station_id}_{start:{store.STAMP}}.nc"),
            ("scan_id", f"{start:%y%m%d_%H%M%S}"),
            ("scan_sha256", np.random.default_rng(at).bytes(32).hex()),
        ):
            letters = np.zeros_like(words[name])
            letters[0, : len(value)] = np.frombuffer(value.encode(), "S1")
            words[name] = letters
        yield replace(template, at=at, words=words)


def _entry(series: Series, start: datetime) -> Entry:
    name = f"{series.station_id}_{start:{store.STAMP}}.nc"
    return Entry(
        name=f"{start:%y%m%d_%H%M%S}.laz", size=1, mtime_ns=1, state=State.STORED, waits_for="", reason="",
        sha256=None, log_sha256="", outcome=State.STORED, verdict="good",
        epoch=f"epochs/{start:%Y/%m/%d}/{name}", start_utc_s=start.timestamp(), revision=1, reference="1",
        figures={"points": 1_000_000, "sigma_median_m": 0.02, "seconds": 3.0}, attempts=0,
        next_try_utc_s=None, seen_utc_s=start.timestamp(), changed_utc_s=start.timestamp(),
    )  # fmt: skip


def cost(site: Site, start: datetime, seen: float = 0.9) -> dict[str, float]:
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
    return found


if __name__ == "__main__":
    main()
