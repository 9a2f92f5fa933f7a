"""Cost of the page alone over a day of hourly scans, and size of its folder after a year of them.

The scans are copies of the epochs of a station.
"""

from __future__ import annotations

import gc
import multiprocessing
import shutil
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from importlib import import_module
from itertools import chain
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import mean

import numpy as np

from benchmarks.growth import RepeatedBlocks, copy_epoch
from benchmarks.process_cost import job_cost
from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL, open_raster
from station.archive.epochs import epoch_files
from station.archive.netcdf_layout import CHUNK, Series
from station.archive.raster_io import Array, write_rasters
from station.archive.schema import BY_NAME, FILL
from station.archive.series.index import SeriesIndex
from station.archive.series.virtual import build_series
from station.config import Site, read_site
from station.processing.epoch_recorder import page_folder
from station.processing.site_files import series_for
from station.processing.workers.fork_server import PRELOAD
from station.products.gallery import cached_base_map, retention_indices
from station.products.overview import Overview, OverviewBuilder
from station.products.page import PageContext, write_page
from station.products.viewer.block_curves import curve_tiers
from station.products.viewer.value_tiles import CellTiles, write_cells
from station.queries.block_sums import QUALITY, EpochSummer, keep_epoch_sums
from station.queries.blocks import BlockQueries, update_boxes
from station.queries.epoch_cells import EpochReader
from station.science.gridding.stored_precision import quantum

MAPS_PER_UPDATE = 8  # at most
LOST = 0.05  # share of the cells that a copy with other noise lacks


def page(site: str, scan: str, history: int, hours: int) -> dict[str, float]:
    """Return the mean CPU time of the page of hourly scans from midnight on, and the median [s].

    `decode_s` is the mean of decoding a scan just before each: the speed of machines varies.
    With 49 hours of history maps are no longer kept after two days, and all tiers have curves.
    Forming the overview and the tiles of cells counts, as a station does it while it writes the epoch;
    writing and reading it, and the sums of blocks, which events and boxes need as well, do not.
    """
    settings = read_site(Path(site))
    series = series_for(settings)
    template = epoch_files(series)[-1]
    midnight = template.start.replace(hour=0, minute=0, second=0, microsecond=0) + timedelta(days=4)
    for hour in range(-history, 0):
        copy_epoch(series, template.path, midnight + timedelta(hours=hour))
    build_series(series)
    update_boxes(series, RepeatedBlocks(series), lambda: None)
    for _ in range(history // MAPS_PER_UPDATE + 1):
        _write(settings, {})
    seconds, decoding = [], []
    for hour in range(hours):
        path = copy_epoch(series, template.path, midnight + timedelta(hours=hour))
        build_series(series)
        update_boxes(series, BlockQueries(series), lambda: None)
        decoding.append(job_cost("benchmarks.peers", "decode", settings.path.parent, scan=scan)[0].cpu_s)
        seconds.append(_cost(settings, path))
    return {"page_s": mean(seconds), "median_s": float(np.median(seconds)), "decode_s": mean(decoding)}


def page_year(site: str, days: int) -> dict[str, float]:
    """Return the size of the page's folder after so many days of hourly scans, in all and of each part [GB].

    Only the epochs are stored that the page keeps then, each with noise of its own in every cell.
    """
    settings = read_site(Path(site))
    series, folder = series_for(settings), page_folder(settings)
    shutil.rmtree(folder, ignore_errors=True)  # what is no longer kept would stay for an hour
    templates = epoch_files(series)
    for number, start in enumerate(kept_hours(templates[-1].start, days)):
        _noisy_copy(series, templates[number % len(templates)].path, start)
    build_series(series)
    update_boxes(series, RepeatedBlocks(series), lambda: None)
    maps = -1
    while maps < (maps := len(list((folder / "maps").glob("*.webp")))):
        _write(settings, {})
    parts = {path.name: _disk_gb(path) for path in folder.iterdir()}
    return {"disk_gb": sum(parts.values())} | parts


def kept_hours(after: datetime, days: int) -> list[datetime]:
    """Return the times of hourly scans whose maps or curves are kept at the end of some days."""
    midnight = after.replace(hour=0, minute=0, second=0, microsecond=0) + timedelta(days=1)
    start_s = midnight.timestamp() + 3600 * np.arange(24.0 * days)
    retained = retention_indices(start_s)
    kept = {*retained, *chain.from_iterable(curve_tiers(start_s, retained).values())}
    return [midnight + timedelta(hours=hour) for hour in sorted(kept)]


def _noisy_copy(series: Series, template: Path, start: datetime) -> None:
    """Store a copy of an epoch under another time, with other noise, and without some of its cells."""
    path, random = copy_epoch(series, template, start), np.random.default_rng(int(start.timestamp()))
    change, sigma = (open_raster(template, name, 0) for name in (CHANGE, RANDOM))

    def noisy(rows: slice) -> Iterator[Array]:
        change_m, sigma_m = np.asarray(change[rows]), np.asarray(sigma[rows])
        seen = (change_m < FILL / 2) & (random.random(change_m.shape, np.float32) >= LOST)
        values_m = np.full(change_m.shape, np.float32(FILL))
        known_m = sigma_m[seen]
        noise_m = known_m * random.standard_normal(len(known_m), np.float32)
        step_m = quantum(known_m)
        values_m[seen] = np.rint((change_m[seen] + noise_m) / step_m) * step_m
        yield values_m

    write_rasters(path, [BY_NAME[CHANGE]], noisy)


def _disk_gb(path: Path) -> float:
    """Return the size on the disk of a file, or of all files and folders in a folder [GB]."""
    paths = [path, *path.rglob("*")]
    return sum(item.stat().st_blocks for item in paths) * 512 / 1e9


def _cost(site: Site, epoch: Path) -> float:
    """Return the CPU time of the page of a new epoch [s], in a process of its own as in the service."""
    receiver, sender = multiprocessing.Pipe()
    for module in PRELOAD:  # as the server has, from which the service's workers are forked
        import_module(module)
    child = multiprocessing.get_context("fork").Process(target=_measure, args=(site, epoch, sender))
    child.start()
    sender.close()  # so that a failed child is an error here
    seconds = receiver.recv()
    child.join()
    return float(seconds)


def _measure(site: Site, epoch: Path, sender: Connection) -> None:
    series, folder = series_for(site), page_folder(site)
    rasters = {
        name: np.asarray(open_raster(epoch, name, 0)[:, :]) for name in (CHANGE, TOTAL, RANDOM, QUALITY)
    }
    bands = [
        (rows, {name: raster[rows] for name, raster in rasters.items()})
        for rows in (slice(top, min(top + CHUNK, series.grid.ny)) for top in range(0, series.grid.ny, CHUNK))
    ]
    summer = EpochSummer(series.grid)
    for rows, band in bands:
        summer.add(rows, band)
    keep_epoch_sums(series, epoch, summer)
    version = EpochReader(series).read_shared(SeriesIndex(series)[-1]).reference.version
    gc.freeze()
    start_s = time.process_time()
    base = cached_base_map(series, folder, version, site.products.quicklook_width_px)
    builder, tiles = OverviewBuilder(base), CellTiles(base)
    for rows, band in bands:
        builder.add(rows, band)
        if base.factor > 1:
            tiles.add(rows, band)
    if base.factor > 1:
        write_cells(folder, epoch.name, tiles)
    _write(site, {epoch.name: builder.build()})
    sender.send(time.process_time() - start_s)


def _write(site: Site, overviews: dict[str, Overview]) -> None:
    context = PageContext("", "", time.time(), 3600.0, [], [], [], {}, overviews=overviews)
    width_px, limit_m = site.products.quicklook_width_px, site.products.change_limit_m
    write_page(series_for(site), page_folder(site), context, width_px, limit_m, lambda: None)
