"""Viewing geometry of the reference surface: slope, incidence, range and single-shot variance per cell.

The scanner does not move, so these are the same for all scans. They are computed once per scanner position,
in the order of the head's azimuth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from station.quantities import VERTICAL_AXIS, Bools, Floats32, Grid, Ints, Ints32, Reference, Scanner
from station.science.geometry import terrain
from station.science.geometry.observation import Observation
from station.science.geometry.terrain import BilinearSurface
from station.science.gridding import echo_layers
from station.science.gridding.reference_cells import (
    BLOCK_CELLS,
    CELL_ARRAYS,
    VISIBILITY_ARRAYS,
    Array,
    CellClass,
    Position,
    cell_arrays,
    mark_bare,
    sampled_cells,
    visibility_bins,
    visibility_step,
)
from station.science.uncertainty.jacobian import HeightJacobian, height_jacobian
from station.science.uncertainty.parameters import (
    TILT_KNOTS_PER_REFRACTION,
    ParameterLayout,
    parameter_layout,
)


@dataclass(frozen=True)
class AzimuthSector:
    """Reference cells (n,) between two knots of the tilt, in order of cell index."""

    cell: Ints32  # in the flattened grid
    height_m: Floats32  # mean of the reference over the cell, above its datum
    mean_residual_m: Floats32  # of the reference's scans to its surface
    east_gradient: Floats32
    north_gradient: Floats32
    knot_position: Floats32  # azimuth in tilt knots, fractional
    point_variance_m2: Floats32  # random variance of one point: shot and roughness, times the factor
    reference_variance_m2: Floats32  # random variance of the reference
    point_count: NDArray[np.float16]  # usual number of points in a scan; NaN if unknown
    cell_class: NDArray[np.uint8]
    noise_class: NDArray[np.uint8]

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.cell)

    def take(self, selection: Ints) -> AzimuthSector:
        """Return the selected cells."""
        return AzimuthSector(*(getattr(self, field.name).take(selection) for field in fields(self)))

    def in_class(self, cell_class: CellClass) -> Bools:
        """Return True for cells (n,) in a class."""
        return np.asarray((self.cell_class & np.uint8(cell_class)) > 0)


@dataclass(frozen=True)
class ViewingGeometry:
    """A reference as seen from `position_m`; None if scans come registered on the map without a position.

    `height_above_datum_m` and `cell_index` (ny, nx) are those of `BilinearSurface`, above `datum_m`. `cells`
    are arrays by cell index: the fields of `AzimuthSector` (n,), `shot_m2`, the random variance of one shot,
    and `intensity`. `sector_bounds` divide them into sectors, and each sector into the cells that an
    adjustment uses and the others: of very many cells a sample is enough. Visibility too is kept only for a
    sample, the `sampled` cells: `visibility`, the share of the reference's scans that observed the cell, and
    `visibility_bin`, its bin within `visibility_shape`. Arrays may be lazy, and are read when sliced.
    """

    reference: Reference
    params: ParameterLayout | None
    position_m: Position | None
    datum_m: float
    height_above_datum_m: Floats32
    cell_index: Ints32
    sector_bounds: Ints  # (2 sectors + 1,)
    sampling_step: tuple[int, int]  # an adjustment uses every n-th cell: of moving ground, of stable ground
    cells: Mapping[str, Array]

    @property
    def grid(self) -> Grid:
        """Grid of the reference."""
        return self.reference.grid

    @property
    def visibility_shape(self) -> tuple[int, int]:
        """Number of azimuth sectors and of range bins in which visibility is counted."""
        assert self.params is not None  # noqa: S101 - the callers' case
        assert self.position_m is not None  # noqa: S101 - the callers' case
        return self.params.knot_intervals // TILT_KNOTS_PER_REFRACTION, visibility_bins(
            self.grid, self.position_m
        )

    @property
    def sampled(self) -> slice:
        """Slice of the cells that are counted for visibility."""
        return visibility_step(int(self.sector_bounds[-1]))

    def surface(self) -> BilinearSurface:
        """Return the reference surface for lookups by shots."""
        return BilinearSurface(
            self.grid, self.datum_m, np.asarray(self.height_above_datum_m), self.cell_index
        )

    def layer_thickness(self, *, published: bool) -> NDArray[np.uint8]:
        """Return the thickness of the layers of the cells (n,), as coded by `echo_layers.thickness_code`.

        In the published form, and on an external surface, the roughness is not in the variance.
        """
        is_known = not published and self.reference.shared is not None
        thickness = np.empty(int(self.sector_bounds[-1]), np.uint8)
        for first, sector in self.sectors():
            thickness[first : first + len(sector)] = echo_layers.thickness_code(
                sector.point_variance_m2, self.grid.cell_m, is_roughness_known=is_known
            )
        return thickness

    def sectors(self, *, sampled: bool = False) -> Iterator[tuple[int, AzimuthSector]]:
        """Yield the sectors that contain cells, each with the index of its first cell.

        With `sampled` they contain only the cells that an adjustment uses.
        """
        last = 1 if sampled else 2
        for first, end in zip(
            self.sector_bounds[:-1:2].tolist(), self.sector_bounds[last::2].tolist(), strict=True
        ):
            if end > first:
                columns = {field.name: self.cells[field.name][first:end] for field in fields(AzimuthSector)}
                yield first, AzimuthSector(**columns)

    def select(self, *classes: CellClass) -> Ints:
        """Return the indices (m,) of the cells that belong to all the given classes."""
        mask = np.uint8(sum(classes))
        return np.flatnonzero((self.cells["cell_class"][:] & mask) == mask)

    def offset_m(self, cell: Ints32, height_m: Floats32) -> tuple[Floats32, Floats32, Floats32]:
        """Offset from the scanner to cells (n,) at heights above the datum: east, north and up [m]."""
        assert self.position_m is not None  # noqa: S101 - the callers' case
        row, column = self.grid.row_and_column(cell)
        return (
            self._east_m.take(column),
            self._north_m.take(row),
            height_m + np.float32(self.datum_m - self.position_m[2]),
        )

    def jacobian(self, sector: AzimuthSector) -> HeightJacobian:
        """Jacobian of the heights of cells with respect to the scanner's state."""
        assert self.params is not None  # noqa: S101 - the callers' case
        return height_jacobian(
            self.params,
            self.offset_m(sector.cell, sector.height_m),
            sector.east_gradient,
            sector.north_gradient,
            sector.knot_position,
            sector.in_class(CellClass.STABLE | CellClass.BARE),
        )

    def observation(self, sector: AzimuthSector) -> Observation:
        """Observation geometry of the cells of a sector."""
        x_m, y_m, z_m = (axis.astype(np.float64) for axis in self.offset_m(sector.cell, sector.height_m))
        east, north = (
            gradient.astype(np.float64) for gradient in (sector.east_gradient, sector.north_gradient)
        )
        return Observation.from_points((x_m, y_m, z_m), (0.0, 0.0, 0.0), east, north)

    @cached_property
    def _east_m(self) -> Floats32:
        assert self.position_m is not None  # noqa: S101 - the callers' case
        return (self.grid.x_m - self.position_m[0]).astype(np.float32)

    @cached_property
    def _north_m(self) -> Floats32:
        assert self.position_m is not None  # noqa: S101 - the callers' case
        return (self.grid.y_m - self.position_m[1]).astype(np.float32)


def compute_viewing_geometry(
    reference: Reference,
    stable: Bools,
    scanner: Scanner,
    position_m: Position | None,
    axis: Position = VERTICAL_AXIS,
    *,
    published: bool = False,
) -> ViewingGeometry:
    """Return the viewing geometry of a reference; `stable` (ny, nx) marks ground known to be stable.

    `published`: shot variance of Voordendag et al. (2023), and no roughness.
    """
    grid = reference.grid
    params = parameter_layout(grid, position_m, axis) if position_m else None
    surface = terrain.bilinear_surface(reference)
    count, first = int(surface.cell_index.max()) + 1, 0
    cells = {name: np.empty(count, dtype) for name, dtype in CELL_ARRAYS.items()}
    for rows in terrain.row_blocks(grid.ny):
        arrays = cell_arrays(
            reference, rows, surface, stable[rows], scanner, params, position_m, published=published
        )
        end = first + len(arrays["cell"])
        for name, values in arrays.items():
            cells[name][first:end] = values
        first = end
    if position_m is not None:
        mark_bare(cells, grid, position_m, surface.datum_m, scanner.wavelength_um)
    sampled, sampling_step = sampled_cells(grid, cells["cell"], cells["cell_class"])
    if params is None:  # any small blocks will do
        sector, sectors = np.arange(count, dtype=np.int32) // BLOCK_CELLS, count // BLOCK_CELLS + 1
    else:
        sector, sectors = cells["knot_position"].astype(np.int32), params.knot_intervals
    sort_key = 2 * sector + ~sampled  # within a sector the sampled cells first
    order = np.argsort(sort_key, kind="stable")
    bounds = np.searchsorted(sort_key[order], np.arange(2 * sectors + 1))
    for name in cells:  # one at a time: this is the peak of a scan's memory
        cells[name] = cells[name][order[visibility_step(count)] if name in VISIBILITY_ARRAYS else order]
    cell_index = np.full(grid.shape, -1, np.int32)
    cell_index.reshape(-1)[cells["cell"]] = np.arange(count)
    return ViewingGeometry(
        reference,
        params,
        position_m,
        surface.datum_m,
        surface.height_above_datum_m,
        cell_index,
        bounds,
        sampling_step,
        cells,
    )
