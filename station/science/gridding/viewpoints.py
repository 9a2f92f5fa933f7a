"""Random variance of the shots of a scan from several positions, each with its own scanner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from station.science.geometry.observation import Observation, Points
from station.science.uncertainty import shot_noise

if TYPE_CHECKING:
    from station.quantities import Floats, ScanGeometry, Viewpoint
    from station.science.gridding.gridder import Gridder
    from station.science.gridding.viewing_geometry import ViewingGeometry


def mean_shot_variance(
    shares: Floats,
    points_m: Points,
    gradient: tuple[Floats, Floats],
    viewpoints: Sequence[Viewpoint],
    *,
    published: bool,
) -> Floats:
    """Return the random variance of a shot's height in cells (n,), as the mean over all of their shots [m²].

    `shares` (k, n) are those of the viewpoints in the points of each cell. Source: equations.md, 6.14.
    """
    variance_m2 = np.zeros(len(points_m[0]))
    for share, viewpoint in zip(shares, viewpoints, strict=True):
        seen = np.flatnonzero(share > 0)
        x_m, y_m, z_m, east, north = (values[seen] for values in (*points_m, *gradient))
        observation = Observation.from_points((x_m, y_m, z_m), viewpoint.position_m, east, north)
        variance_m2[seen] += share[seen] * shot_noise.height_variance(
            observation, viewpoint.scanner, published=published
        )
    return variance_m2


def seen_from_viewpoints(
    viewing: ViewingGeometry, gridder: Gridder, scan_geometry: ScanGeometry
) -> ViewingGeometry:
    """Return a viewing geometry with the variances of the shots of a gridded scan.

    They are those of its viewpoints; without any, the geometry is returned as it is.
    """
    if not scan_geometry.viewpoints:
        return viewing
    shot_m2, point_m2 = (np.array(viewing.cells[name][:]) for name in ("shot_m2", "point_variance_m2"))
    grid, factor = viewing.grid, np.asarray(viewing.reference.variance_factor).reshape(-1)
    for first, sector in viewing.sectors():
        cells = slice(first, first + len(sector))
        row, column = grid.row_and_column(sector.cell)
        mean_m2 = mean_shot_variance(
            gridder.viewpoint_shares(np.arange(cells.start, cells.stop, dtype=np.int32)),
            (grid.x_m[column], grid.y_m[row], sector.height_m.astype(np.float64) + viewing.datum_m),
            (sector.east_gradient.astype(np.float64), sector.north_gradient.astype(np.float64)),
            scan_geometry.viewpoints,
            published=scan_geometry.published_budget,
        )
        scale = 1.0 if scan_geometry.published_budget else factor.take(sector.cell)
        point_m2[cells] += (mean_m2 - shot_m2[cells]) * scale
        shot_m2[cells] = mean_m2
    return replace(viewing, cells={**viewing.cells, "shot_m2": shot_m2, "point_variance_m2": point_m2})
