"""Cost of the page alone over a day of hourly scans, which are copies of the newest epoch of a station."""

from __future__ import annotations

import gc
import multiprocessing
import time
from datetime import timedelta
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import mean

import numpy as np

from benchmarks.growth import RepeatedBlocks, copy_epoch
from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL, open_raster
from station.archive.epochs import epoch_files
from station.archive.netcdf_layout import CHUNK
from station.archive.series.index import SeriesIndex
from station.archive.series.virtual import build_series
from station.config import Site, read_site
from station.processing.epoch_recorder import page_folder
from station.processing.site_files import series_for
from station.processing.workers.fork_server import PRELOAD
from station.products.gallery import cached_base_map
from station.products.overview import Overview, OverviewBuilder
from station.products.page import PageContext, write_page
from station.products.viewer.value_tiles import CellTiles, write_cells
from station.queries.block_sums import QUALITY, EpochSummer, keep_epoch_sums
from station.queries.blocks import BlockQueries, update_boxes
from station.queries.epoch_cells import EpochReader

MAPS_PER_UPDATE = 8  # at most


def page(site: str, history: int, hours: int) -> dict[str, float]:
    """Return the mean CPU time of the page of hourly scans from midnight on, and the median [s].

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
    seconds = []
    for hour in range(hours):
        path = copy_epoch(series, template.path, midnight + timedelta(hours=hour))
        build_series(series)
        update_boxes(series, BlockQueries(series), lambda: None)
        seconds.append(_cost(settings, path))
    return {"page_s": mean(seconds), "median_s": float(np.median(seconds))}


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
