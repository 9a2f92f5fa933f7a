"""Time series of the change in boxes and of the tilt of the scanner.

The data of Fig. 2 of Voordendag et al. (2023), from the epochs of a station.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
from scipy import sparse

from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.small_variables import read_number
from station.quantities import Bools, Grid, Ints
from station.queries.aggregates import Aggregates
from station.queries.epoch_cells import EpochCells, read_scanner
from station.queries.stable_ground import sample_epochs
from station.science.analysis.calibration import SparseJacobian, group_means, renormalise
from station.science.geometry.observation import Observation
from station.science.geometry.terrain import smooth_gradient
from station.science.uncertainty.propagation import difference_to_reference

BOX_M = 100.0  # Voordendag et al. (2023), section 2.4
MAX_BOXES = 20
MIN_KNOWN_SHARE = 0.6  # share of the cells of a box that the reference must contain
TILT_VARIABLES = ("platform_roll", "platform_pitch")


def box_statistics(series: Series, max_epochs: int, progress: Callable[[], None]) -> list[dict[str, Any]]:
    """Return mean and scatter of the change in boxes [m] and the tilt of the scanner [°], by epoch.

    Uses at most `max_epochs` epochs, spread over the series. Boxes are spread evenly over the ranges of the
    reference. Empty if no epoch has a reference.
    """
    epochs = sample_epochs(series, max_epochs)
    if not epochs:
        return []
    aggregates = Aggregates(series)
    known = np.isfinite(aggregates.reference().elevation_m)
    with h5py.File(epochs[-1].path, "r") as file:
        scanner_m = read_scanner(file, epochs[-1].index, series.grid)[:3]
    cells, box_index, weights = _choose_boxes(series.grid, known, scanner_m)
    if not cells.any():
        return []
    table: list[dict[str, Any]] = []
    cached: tuple[tuple[object, ...], SparseJacobian, list[dict[str, float]]] | None = None
    for epoch in epochs:
        epoch_cells = aggregates.read_cells(epoch, cells)
        key = epoch_cells.reference.version, epoch_cells.scanner
        if cached is None or cached[0] != key:
            geometry = _box_geometry(series.grid, cells, weights, epoch_cells)
            cached = key, SparseJacobian(aggregates.jacobian(epoch_cells, cells)), geometry
        table += _epoch_statistics(epoch, epoch_cells, box_index, weights, cached[1], cached[2])
        progress()
    return table


def _epoch_statistics(
    epoch: EpochRef,
    epoch_cells: EpochCells,
    box_index: Ints,
    weights: sparse.csr_array,
    jacobian: SparseJacobian,
    geometry: list[dict[str, float]],
) -> list[dict[str, Any]]:
    if epoch_cells.shared is None:
        return []
    observed = np.isfinite(epoch_cells.change_m)
    observed_weights, share = renormalise(weights, observed)
    change_m = np.where(observed, epoch_cells.change_m, 0.0)
    shared = (
        epoch_cells.shared
        if epoch_cells.adjusted
        else difference_to_reference(epoch_cells.shared, epoch_cells.reference.shared)
    )
    mean_m = observed_weights @ change_m
    sigma_m = np.sqrt(
        jacobian.sums(observed_weights).variance(np.where(observed, epoch_cells.random_m**2, 0.0), shared)
    )
    scatter_m = np.sqrt(observed_weights @ np.where(observed, (change_m - mean_m[box_index]) ** 2, 0.0))
    with h5py.File(epoch.path, "r") as file:
        tilt = {f"{name[9:]}_deg": read_number(file, name, epoch.index) for name in TILT_VARIABLES}
    start = epoch.start.strftime("%Y-%m-%dT%H:%M:%SZ")
    return [
        {
            "time": start, **tilt, "box": box + 1, **geometry[box], "coverage": float(share[box]),
            "mean_change_m": float(mean_m[box]), "sigma_m": float(sigma_m[box]),
            "scatter_m": float(scatter_m[box]),
        }
        for box in range(len(geometry)) if share[box] > 0
    ]  # fmt: skip


def _choose_boxes(
    grid: Grid, known: Bools, scanner_m: tuple[float, ...]
) -> tuple[Bools, Ints, sparse.csr_array]:
    """Return the cells of all boxes (ny, nx), the box of each cell (n,), and mean weights (boxes, n)."""
    no_boxes = np.zeros(grid.shape, bool), np.empty(0, np.int64), group_means(np.zeros(1, np.int64))
    if not np.isfinite(scanner_m).all():
        return no_boxes
    size = max(round(BOX_M / grid.cell_m), 1)
    while size > 4 and (grid.ny // size) * (grid.nx // size) < MAX_BOXES:
        size //= 2
    block_rows, block_columns = grid.ny // size, grid.nx // size
    if not block_rows or not block_columns:
        return no_boxes
    blocks = known[: block_rows * size, : block_columns * size].reshape(block_rows, size, block_columns, size)
    block_row, block_column = np.nonzero(blocks.mean(axis=(1, 3)) >= MIN_KNOWN_SHARE)
    if not len(block_row):
        return no_boxes
    centre_m = (np.stack([block_column, block_row]) + 0.5) * size * grid.cell_m
    range_m = grid.plane.horizontal_m(
        (
            grid.west_m + centre_m[0] - scanner_m[0],
            grid.north_m - centre_m[1] - scanner_m[1],
            np.full(1, -scanner_m[2]),
        )
    )
    order = np.argsort(range_m)
    chosen = order[np.unique(np.linspace(0, len(order) - 1, min(MAX_BOXES, len(order))).astype(np.int64))]
    box_of_cell = np.full(grid.shape, -1)
    for box, block in enumerate(chosen):
        box_of_cell[
            block_row[block] * size : (block_row[block] + 1) * size,
            block_column[block] * size : (block_column[block] + 1) * size,
        ] = box
    cells = (box_of_cell >= 0) & known
    box_index = box_of_cell[cells]
    return cells, box_index, group_means(box_index)


def _box_geometry(
    grid: Grid, cells: Bools, weights: sparse.csr_array, epoch_cells: EpochCells
) -> list[dict[str, float]]:
    """Return mean position, range [m] and incidence angle [°] of each box."""
    row, column = np.nonzero(cells)
    east, north = (
        np.nan_to_num(gradient[cells].astype(np.float64))
        for gradient in smooth_gradient(epoch_cells.reference.elevation_m, grid.cell_m)
    )
    points = grid.x_m[column], grid.y_m[row], epoch_cells.reference.elevation_m[cells]
    observation = Observation.from_points(
        points, (epoch_cells.scanner[0], epoch_cells.scanner[1], epoch_cells.scanner[2]), east, north
    )
    columns = {
        "east_m": points[0], "north_m": points[1], "range_m": observation.range_m,
        "incidence_deg": np.degrees(np.arccos(observation.cos_incidence)),
    }  # fmt: skip
    averages = {name: weights @ values for name, values in columns.items()}
    return [
        {name: float(values[box]) for name, values in averages.items()} for box in range(weights.shape[0])
    ]
