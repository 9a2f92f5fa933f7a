"""Cells of a scan outside the reference, with terrain gradients from the scan itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from station.quantities import Floats, Floats32, Grid, Ints32, ScanGeometry
from station.science.geometry.terrain import HALO_ROWS, gradient_at
from station.science.gridding.gridder import Gridder
from station.science.gridding.viewing_geometry import ViewingGeometry

BAND_ROWS = 64  # rows whose cells outside the reference are read at once
BLOCK_CELLS = 50_000  # cells outside the reference that are estimated at once


@dataclass(frozen=True)
class CellsOutside:
    """Cells (n,) outside the reference, with terrain gradients from the scan itself."""

    cell_index: Ints32
    cell: Ints32  # in the flattened grid
    east_gradient: Floats
    north_gradient: Floats

    @classmethod
    def concatenate(cls, parts: list[CellsOutside]) -> CellsOutside:
        """Return the parts concatenated."""
        return cls(
            *(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(cls))
        )

    def split(self) -> Iterator[CellsOutside]:
        """Yield blocks of cells that are estimated at once."""
        for first in range(0, len(self.cell), BLOCK_CELLS):
            yield CellsOutside(
                *(getattr(self, column.name)[first : first + BLOCK_CELLS] for column in fields(self))
            )


def iter_cells_outside(
    gridder: Gridder, scan_geometry: ScanGeometry, viewing: ViewingGeometry | None
) -> Iterator[CellsOutside]:
    """Yield the cells outside the reference, in blocks whose intermediate results stay in the cache."""
    new_cells = gridder.new_cells()
    heights = _HeightWindow(gridder, viewing, new_cells, scan_geometry.min_points)
    parts: list[CellsOutside] = []
    for top in range(0, scan_geometry.grid.ny, BAND_ROWS):
        rows = slice(top, min(top + BAND_ROWS, scan_geometry.grid.ny))
        parts.append(
            _cells_outside(
                gridder, scan_geometry, heights, rows, _rows_slice(new_cells, rows, scan_geometry.grid)
            )
        )
        if sum(len(part.cell) for part in parts) > BLOCK_CELLS or rows.stop == scan_geometry.grid.ny:
            yield from CellsOutside.concatenate(parts).split()
            parts = []


def _rows_slice(cell: Ints32, rows: slice, grid: Grid) -> Ints32:
    """Return those of the ascending flattened cells (n,) that lie in the given rows."""
    # In the dtype of the cells: otherwise numpy would convert all of them.
    edges = np.array([rows.start * grid.nx, rows.stop * grid.nx], cell.dtype)
    first, last = np.searchsorted(cell, edges)
    return cell[first:last]


def _cells_outside(
    gridder: Gridder, scan_geometry: ScanGeometry, heights: _HeightWindow, rows: slice, cell: Ints32
) -> CellsOutside:
    """Return the cells (n,) of some rows outside the reference, with their gradients."""
    east, north = np.zeros((2, len(cell)))
    if scan_geometry.position_m is not None:
        window_m, inner = heights.window(rows)
        if len(cell):
            row, column = scan_geometry.grid.row_and_column(cell)
            row += inner.start - rows.start
            gradient = gradient_at(window_m, scan_geometry.grid.cell_m, row, column)
            east, north = (np.nan_to_num(component.astype(np.float64)) for component in gradient)
    return CellsOutside(gridder.cell_index.reshape(-1).take(cell), cell, east, north)


class _HeightWindow:
    """Heights above one datum, row by row, read from the sums of cells before these are overwritten."""

    def __init__(
        self, gridder: Gridder, viewing: ViewingGeometry | None, new_cells: Ints32, min_points: int
    ) -> None:
        """Start north of the grid; `new_cells` (n,) are the cells outside the reference, ascending."""
        self._gridder, self._viewing = gridder, viewing
        self._new_cells, self._min_points = new_cells, min_points
        self._datum_offset_m = 0.0 if viewing is None else gridder.datum_m - viewing.datum_m
        self._rows = slice(0, 0)
        self._height_m = np.empty((0, gridder.grid.nx), np.float32)

    def window(self, rows: slice) -> tuple[Floats32, slice]:
        """Return heights (r, nx) of some rows and adjacent ones, NaN where empty, and the slice of the rows.

        Calls must proceed southward: sums that were read once are not read again.
        """
        window_rows = slice(max(rows.start - HALO_ROWS, 0), min(rows.stop + HALO_ROWS, self._gridder.grid.ny))
        kept_m = self._height_m[window_rows.start - self._rows.start :]
        self._height_m = np.concatenate([kept_m, self._read(slice(self._rows.stop, window_rows.stop))])
        self._rows = window_rows
        return self._height_m, slice(rows.start - window_rows.start, rows.stop - window_rows.start)

    def _read(self, rows: slice) -> Floats32:
        """Return heights (r, nx) of some rows: of the reference if known, otherwise means of the scan."""
        gridder, grid = self._gridder, self._gridder.grid
        cell_index = gridder.cell_index[rows]
        if self._viewing is None:
            height_m = np.full(cell_index.shape, np.nan, np.float32)
        else:
            # The reference's own heights are better where known. Cells outside get all bits set: NaN.
            outside = cell_index.view(np.uint32) >= np.uint32(gridder.reference_cells)
            bits = np.negative(outside.view(np.int8), dtype=np.int32)
            bits |= self._viewing.height_above_datum_m[rows].view(np.int32)
            height_m = bits.view(np.float32)
        cell = _rows_slice(self._new_cells, rows, grid) - rows.start * grid.nx
        sums = gridder.take(cell_index.reshape(-1).take(cell))
        enough = sums.count >= self._min_points
        height_m.reshape(-1)[cell] = np.where(enough, sums.mean_residual() + self._datum_offset_m, np.nan)
        return height_m
