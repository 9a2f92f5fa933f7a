"""Boxes over time beside the lean of the scanner.

Fig. 2 of Voordendag et al. (2023) from a station's own data.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import netCDF4
import numpy as np
from scipy import sparse

from station.archive.aggregate import Aggregates, Held
from station.archive.layout import Series
from station.archive.observed import some_epochs
from station.archive.store import Row
from station.quantities import Bools, Grid, Ints
from station.science.calibration import Felt, means, renormalised
from station.science.shared import against
from station.science.terrain import smooth_gradient
from station.science.view import View

BOX_M = 100.0  # Voordendag et al. (2023), section 2.4
BOXES = 20
FULL = 0.6  # share of a box's cells that must be known
LEAN = ("platform_roll", "platform_pitch")


def box_statistics(series: Series, most: int, progress: Callable[[], None]) -> list[dict[str, Any]]:
    """Return mean and scatter of the change in boxes, and the lean of the scanner, epoch by epoch.

    At most so many epochs, spread over the series. Boxes are spread evenly over the ranges that the reference
    knows. Empty where no epoch has a reference.
    """
    some = some_epochs(series, most)
    if not some:
        return []
    held = Aggregates(series)
    known = np.isfinite(held.reference().elevation_m)
    cells, of, weights = _boxes(series.grid, known, _scanner(some[-1])[:2])
    if not cells.any():
        return []
    told: list[dict[str, Any]] = []
    felt: tuple[tuple[object, ...], Felt, list[dict[str, float]]] | None = None
    for row in some:
        one = held.read(row, cells)
        key = one.reference.version, one.scanner
        if felt is None or felt[0] != key:
            places = _places(series.grid, cells, weights, one)
            felt = key, Felt(held.felt(one, cells)), places
        told += _of_epoch(row, one, of, weights, felt[1], felt[2])
        progress()
    return told


def _of_epoch(
    row: Row,
    one: Held,
    of: Ints,
    weights: sparse.csr_array,
    felt: Felt,
    places: list[dict[str, float]],
) -> list[dict[str, Any]]:
    if one.unknown is None:
        return []
    seen = np.isfinite(one.change_m)
    kept, share = renormalised(weights, seen)
    change_m = np.where(seen, one.change_m, 0.0)
    unknown = one.unknown if one.adjusted else against(one.unknown, one.reference.shared)
    mean_m = kept @ change_m
    sigma_m = np.sqrt(felt.sums(kept).variance(np.where(seen, one.random_m**2, 0.0), unknown))
    scatter_m = np.sqrt(kept @ np.where(seen, (change_m - mean_m[of]) ** 2, 0.0))
    with netCDF4.Dataset(row.path) as file:
        lean = {f"{name[9:]}_deg": float(np.ma.filled(file[name][row.index], np.nan)) for name in LEAN}
    start = row.start.strftime("%Y-%m-%dT%H:%M:%SZ")
    return [
        {
            "time": start, **lean, "box": box + 1, **places[box], "seen": float(share[box]),
            "mean_change_m": float(mean_m[box]), "sigma_m": float(sigma_m[box]),
            "scatter_m": float(scatter_m[box]),
        }
        for box in range(len(places)) if share[box] > 0
    ]  # fmt: skip


def _scanner(row: Row) -> tuple[float, float, float]:
    with netCDF4.Dataset(row.path) as file:
        east_m, north_m, height_m = (
            float(np.ma.filled(file[f"scanner_{axis}"][row.index], np.nan))
            for axis in ("east", "north", "height")
        )
    return east_m, north_m, height_m


def _boxes(grid: Grid, known: Bools, eye_m: tuple[float, float]) -> tuple[Bools, Ints, sparse.csr_array]:
    """Choose boxes: their cells (ny, nx), the box of each cell (n,), weights of their means (boxes, n)."""
    nothing = np.zeros(grid.shape, bool), np.empty(0, np.int64), means(np.zeros(1, np.int64))
    if not np.isfinite(eye_m).all():
        return nothing
    size = max(round(BOX_M / grid.cell_m), 1)
    while size > 4 and (grid.ny // size) * (grid.nx // size) < BOXES:
        size //= 2
    rows_, columns = grid.ny // size, grid.nx // size
    if not rows_ or not columns:
        return nothing
    tiles = known[: rows_ * size, : columns * size].reshape(rows_, size, columns, size)
    top, left = np.nonzero(tiles.mean(axis=(1, 3)) >= FULL)
    if not len(top):
        return nothing
    middle = (np.stack([left, top]) + 0.5) * size * grid.cell_m
    range_m = np.hypot(grid.west_m + middle[0] - eye_m[0], grid.north_m - middle[1] - eye_m[1])
    order = np.argsort(range_m)
    chosen = order[np.unique(np.linspace(0, len(order) - 1, min(BOXES, len(order))).astype(np.int64))]
    number = np.full(grid.shape, -1)
    for box, at in enumerate(chosen):
        number[top[at] * size : (top[at] + 1) * size, left[at] * size : (left[at] + 1) * size] = box
    cells = (number >= 0) & known
    of = number[cells]
    return cells, of, means(of)


def _places(grid: Grid, cells: Bools, weights: sparse.csr_array, one: Held) -> list[dict[str, float]]:
    """Say where each box is and how it is seen."""
    row, column = np.nonzero(cells)
    east, north = (
        np.nan_to_num(g[cells].astype(np.float64))
        for g in smooth_gradient(one.reference.elevation_m, grid.cell_m)
    )
    points = grid.x_m[column], grid.y_m[row], one.reference.elevation_m[cells]
    view = View.of(points, (one.scanner[0], one.scanner[1], one.scanner[2]), east, north)
    columns = {
        "east_m": points[0], "north_m": points[1], "range_m": view.range_m,
        "incidence_deg": np.degrees(np.arccos(view.cos_incidence)),
    }  # fmt: skip
    averages = {name: weights @ values for name, values in columns.items()}
    return [
        {name: float(values[box]) for name, values in averages.items()} for box in range(weights.shape[0])
    ]
