"""A permanently mounted laser scanner as a measuring instrument.

`station.open(site_or_folder)` gives the whole series of a station as one lazy `xarray.Dataset`;
`station.variance(site_or_folder, weights, epoch)` how sure any mean, volume or difference of it is;
`station.volume(site_or_folder, area, epoch)` a volume, and which cells make it unsure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import numpy.typing as npt
    import shapely
    import xarray as xr

    Epoch = int | str | np.datetime64

__version__ = "0.1.0"


def open(site_or_folder: str | Path) -> xr.Dataset:  # noqa: A001 - reads well as station.open(...)
    """Return the whole series of a station: one lazy dataset, at any moment, also while it is written.

    Takes a site file or the station's data folder; raises StoreError where there is no series yet.
    """
    from station.archive.opened import open_series  # noqa: PLC0415 - importing station stays cheap

    return open_series(site_or_folder)


def variance(
    site_or_folder: str | Path, weights: npt.ArrayLike, epoch: Epoch, epoch2: Epoch | None = None
) -> float:
    """Variance of a weighted sum of the elevation change in an epoch, or of its difference to a second one.

    `weights` (y, x), rows from north to south, nought outside: 1/n in n cells for a mean, a cell's size for a
    volume. An epoch is its place in the series or a time (the nearest is taken). What all cells of a scan
    share is in it, at every scale. Raises StoreError where there is no series or no reference yet, ValueError
    where the weights are not on its grid.
    Source: EQUATIONS 6.2.
    """
    import numpy as np  # noqa: PLC0415

    from station.archive.aggregate import Aggregates  # noqa: PLC0415
    from station.archive.store import series_in  # noqa: PLC0415

    found = Aggregates(series_in(site_or_folder))
    other = None if epoch2 is None else found.row(epoch2)
    return found.variance(np.asarray(weights, dtype=np.float64), found.row(epoch), other)


def coarsened(site_or_folder: str | Path, epoch: Epoch, cells: int) -> xr.Dataset:
    """Elevation change of an epoch in blocks of cells × cells, with its uncertainty, for cells of few points.

    Raises StoreError where there is no series.
    """
    from station.archive.aggregate import Aggregates  # noqa: PLC0415
    from station.archive.store import series_in  # noqa: PLC0415

    found = Aggregates(series_in(site_or_folder))
    return found.coarsened(found.row(epoch), cells)


def volume(
    site_or_folder: str | Path,
    area: npt.ArrayLike | shapely.Geometry,
    epoch: Epoch,
    epoch2: Epoch | None = None,
) -> xr.Dataset:
    """Volume of the change over an area in an epoch, or of its difference to a second one, with its sigmas.

    `area` is cells (y, x), rows from north to south, or a polygon on the map. With what cells share, and as
    Hartzell et al. (2015) have it, each cell's error its own; and as maps which cell adds how much to the
    variance. Cells without a change are interpolated, as in `areas.nc`. Raises StoreError where there is no
    series, no reference or no change.
    """
    from station.archive.store import series_in  # noqa: PLC0415
    from station.archive.volume import Volumes, cells_of  # noqa: PLC0415

    series = series_in(site_or_folder)
    found = Volumes(series)
    other = None if epoch2 is None else found.row(epoch2)
    return found.change(cells_of(area, series.grid), found.row(epoch), other)


def point_covariance(site: str | Path, points_m: npt.ArrayLike, epoch: Epoch) -> npt.NDArray[np.float64]:
    """Covariance (n, 3, 3) of points (n, 3) on the map, as the scan of an epoch measures them [m²].

    Of the shot: range, beam, encoder. Of all shots alike: pose, lean, ranges and air as the adjustment of the
    epoch leaves them, against the reference. `station.science.beam.error_ellipse` draws it. It is a site file
    that is wanted, for the scanner; raises StoreError where there is no series.
    Source: Hartzell et al. (2015), Eq. 9; EQUATIONS 6.2.
    """
    import numpy as np  # noqa: PLC0415

    from station.archive.store import series_in  # noqa: PLC0415
    from station.archive.volume import Volumes  # noqa: PLC0415
    from station.config import read_site  # noqa: PLC0415

    found = Volumes(series_in(site))
    points = np.atleast_2d(np.asarray(points_m, dtype=np.float64))
    return found.point_covariance(points, found.row(epoch), read_site(site).instrument)
