"""A permanently mounted laser scanner as a measuring instrument.

`station.open(site_or_folder)` returns the whole series of a station as one lazy `xarray.Dataset`,
`station.variance(site_or_folder, weights, epoch)` the variance of any mean, volume or difference in it, and
`station.volume(site_or_folder, area, epoch)` a volume with its uncertainty and each cell's share in it.
`station.view(site_or_folder)` shows the page in a notebook.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from station._version import __version__ as __version__

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import numpy.typing as npt
    import shapely
    import xarray as xr

    from station.archive.series.lazy import Chunks
    from station.operations.notebook_view import View
    from station.queries.grid_arrays import Epoch


def open(site_or_folder: str | Path, chunks: Chunks = None) -> xr.Dataset:  # noqa: A001 - reads well as station.open(...)
    """Return the whole series of a station as one lazy dataset, also while the service is writing.

    Takes a site file, the station's data folder, or its `series.nc`. `chunks` are those of
    `xarray.open_dataset`, `{}` for chunks of 24 MB. The dataset has the coordinate system for rioxarray, can
    be written in any part with `to_netcdf`, and answers queries with `ds.station`: `variance`, `volume`,
    `between`, `at`, `error_structure`. Raises StoreError if there is no series yet or a file is missing, and
    if one vanishes while the dataset is in use.
    """
    import station.queries.accessor  # noqa: F401 - registers ds.station
    from station.archive.series.lazy import open_series

    return open_series(site_or_folder, chunks)


def variance(
    site_or_folder: str | Path, weights: npt.ArrayLike, epoch: Epoch, epoch2: Epoch | None = None
) -> float:
    """Return the variance of a weighted sum of elevation change [m² times squared weights].

    The sum is over one epoch, or over its difference to a second epoch. `weights` (y, x) are zero outside the
    area: 1/n in each of n cells gives a mean, the cell size a volume; a mask stands for the mean of its cells
    with a change. A DataArray is aligned by its coordinates; an array has the rows from north to south. An
    epoch is an index in the series or a time, which stands for the nearest epoch within 12 h. Errors that all
    cells of a scan share are included at every scale. Raises StoreError if there is no series or no reference
    yet, StationError if there is no such epoch, ValueError if the weights do not fit the grid or are NaN.
    Source: equations.md, 6.2.
    """
    from station.archive.series.index import series_in
    from station.queries.aggregates import Aggregates
    from station.queries.grid_arrays import to_grid

    aggregates = Aggregates(series_in(site_or_folder))
    other = None if epoch2 is None else aggregates.find_epoch(epoch2)
    return aggregates.variance(to_grid(weights, aggregates.grid), aggregates.find_epoch(epoch), other)


def coarsen(site_or_folder: str | Path, epoch: Epoch, cells: int) -> xr.Dataset:
    """Return the elevation change of an epoch in blocks of `cells` × `cells`, with its uncertainty [m].

    Meant for cells with few points. Raises StoreError if there is no series.
    """
    from station.archive.series.index import series_in
    from station.queries import blocks
    from station.queries.epoch_cells import EpochReader

    series = series_in(site_or_folder)
    return blocks.coarsen(series, EpochReader(series).find_epoch(epoch), cells)


def volume(
    site_or_folder: str | Path,
    area: str | npt.ArrayLike | shapely.Geometry,
    epoch: Epoch,
    epoch2: Epoch | None = None,
) -> xr.Dataset:
    """Return the volume change of an area with its uncertainty [m³].

    The volume is that of one epoch, or of its difference to a second epoch. `area` is the name of an area in
    `areas.nc`, a mask (y, x), or a polygon in map coordinates. A mask is aligned as weights are. One sigma is
    given with the shared errors included and once as in Hartzell et al. (2015), with every cell's error
    independent; maps hold the share of each cell in the variance. Cells without a change are interpolated,
    as in `areas.nc`. Raises StoreError if there is no series, no reference or no change, StationError if
    there is no area of this name.
    """
    from station.archive.series.index import series_in
    from station.queries.grid_arrays import to_mask
    from station.queries.volumes import Volumes

    volumes = Volumes(series_in(site_or_folder))
    other = None if epoch2 is None else volumes.find_epoch(epoch2)
    return volumes.volume_change(to_mask(area, volumes.series), volumes.find_epoch(epoch), other)


def levels(
    site_or_folder: str | Path,
    area: str | npt.ArrayLike | shapely.Geometry,
    every: Literal["1D", "1M"] = "1D",
) -> xr.Dataset:
    """Return level [m] and rate [m/d] of the cells of an area at the end of each day, with their uncertainty.

    The level is the elevation change filtered over time, cell by cell, from all usable epochs; the rate is
    its slope without steps. Both have a random uncertainty, independent between cells, and a systematic one,
    which cells have in common. `coverage` is the share of the day's epochs that saw the cell: where it is 0
    the level is extrapolated, with an uncertainty to match. `area` is that of `station.volume`. Days in
    `levels/` are read; the others are computed from their epochs, with the same values. With `every` "1M"
    there is one entry for each month in `levels/`, and the rate is the mean of the month, steps included.
    Raises StoreError if there is no series, no usable epoch with a reference or no such month, StationError
    if there is no area of this name. Source: equations.md, 6.12.
    """
    from station.archive.series.index import series_in
    from station.queries.grid_arrays import to_mask
    from station.queries.levels import filter_levels

    series = series_in(site_or_folder)
    return filter_levels(series, to_mask(area, series), lambda: None, monthly=every == "1M")


def product(site_or_folder: str | Path, name: str, epoch: Epoch | None = None) -> xr.Dataset:
    """Return a product of the site file over time, with one sigma and its random and systematic part.

    Also from a copy of the store: it is the content of `products/NAME.nc`. Places are selected by name, as in
    `station.product(folder, "snow depth").sel(place="bowl").snow_depth`. Scans whose `verdict` is 2 must not
    be used. With an epoch, as that of `station.variance`, the snow depth, melt or mass balance of each cell
    (y, x) is computed, with the sigma of a cell; that needs the site file. Raises StationError if there is no
    product of this name, no such epoch or no map of it.
    """
    from station.archive.derived.product_files import open_product
    from station.archive.series.index import data_folder

    if epoch is not None:
        from station.config import read_site
        from station.processing.site_files import load_product, series_for
        from station.queries.site_products.product_maps import map_dataset
        from station.queries.site_products.product_queries import ProductQueries

        site = read_site(site_or_folder)
        queries = ProductQueries(series_for(site))
        return map_dataset(queries, load_product(site, name), queries.find_epoch(epoch))
    return open_product(data_folder(site_or_folder), name)


def view(site_or_folder: str | Path, height_px: int = 900) -> View:
    """Return the page of a station for a notebook, which shows it as the value of a cell.

    A web server in this process serves it to this machine until it is closed (`view.close()`), with the
    answers of `station serve`. Needs `tls-station[serve]`. Raises StationError without it, or if there is no
    page yet; StoreError if there is no series.
    """
    from station.operations.notebook_view import show

    return show(site_or_folder, height_px)


def point_covariance(
    site_or_folder: str | Path, points_m: npt.ArrayLike, epoch: Epoch
) -> npt.NDArray[np.float64]:
    """Return the covariance (n, 3, 3) of map points (n, 3) as measured by the scan of an epoch [m²].

    It is the sum of the independent error of each shot (range, beam, encoder) and the error all shots share
    (pose, tilt, range, air): the posterior of the epoch's adjustment, relative to the reference. The scanner
    is that of the site file, or of `series.nc`. `beam.error_ellipse` turns the result into error ellipses.
    Raises StoreError if there is no series, or if an older version wrote it and no site file is given.
    Source: Hartzell et al. (2015), Eq. 9; equations.md, 6.2.
    """
    import numpy as np

    from station.archive.series.index import series_in
    from station.queries.volumes import Volumes

    volumes = Volumes(series_in(site_or_folder))
    points = np.atleast_2d(np.asarray(points_m, dtype=np.float64))
    return volumes.point_covariance(points, volumes.find_epoch(epoch))
