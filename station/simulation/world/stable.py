"""Polygons of a simulated station: stable ground, and areas to watch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from station.quantities import Bools, Floats, Grid
from station.simulation.scenario import Mark, Scenario
from station.simulation.truth import TrueSurface, map_from_enu
from station.simulation.world import beach, rock_face, snow_slope
from station.simulation.world.change import DEPOSIT, ON_STABLE_GROUND, SurfaceChange
from station.simulation.world.places import RIDGE_DEG, RIDGE_FROM_M, ROCK_ICE, hut_cells, hut_m
from station.simulation.world.terrain import Valley

BLOCK_M = {"valley": 50.0, "mammoth": 3.0, "low-cost-snow": 3.0, "beach": 5.0, "rockfall": 5.0}  # times size
GLACIER = (-700.0, 1020.0, 280.0, 280.0)  # octagon on the ice: east, north, half axes, times size [m]
ROCK = (-250.0, 1850.0, 100.0)  # square on the northern wall: east, north, half length, times size [m]


@dataclass(frozen=True)
class Rectangle:
    """Whole cells of the map's grid known to be stable; ends are exclusive."""

    name: str
    row: int
    row_end: int
    column: int
    column_end: int

    def ring_m(self, grid: Grid) -> Floats:
        """Return easting and northing of its corners, counter-clockwise, the first also last (5, 2)."""
        west, east = (grid.west_m + grid.cell_m * column for column in (self.column, self.column_end))
        north, south = (grid.north_m - grid.cell_m * row for row in (self.row, self.row_end))
        return np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])


def stable_ground(
    scenario: Scenario, valley: Valley, changes: tuple[SurfaceChange, ...], surface: TrueSurface
) -> list[Rectangle]:
    """Return the stable ground: rock that neither melts nor is overrun, though snow may fall on it.

    "good": blocks all round. "poor": the blocks of a far ridge, and a hut.
    """
    block = max(1, round(BLOCK_M[scenario.kind] * scenario.size / scenario.cell_m))
    whole = _whole_blocks(_bare_rock(changes, surface), block)
    if scenario.stable_ground == "good":
        return _merge_blocks("rock", whole, block)
    ridge = _merge_blocks("far ridge", whole & _on_ridge(scenario, valley, surface, block), block)
    return [*ridge, _hut(scenario, valley, surface.grid)]


def inside_rectangles(grid: Grid, rectangles: list[Rectangle]) -> Bools:
    """Return a mask of the cells inside the rectangles (ny, nx)."""
    inside = np.zeros(grid.shape, dtype=np.bool_)
    for rectangle in rectangles:
        inside[rectangle.row : rectangle.row_end, rectangle.column : rectangle.column_end] = True
    return inside


def areas(scenario: Scenario, valley: Valley) -> dict[str, Floats]:
    """Return the rings of the areas to watch on the map (n, 2).

    In the valley they are glacier, avalanche deposit and rock.
    """
    if scenario.kind == "rockfall":
        return {name: _ring(*place_m, corners=4) for name, place_m in rock_face.AREAS_M.items()}
    if scenario.kind != "valley":
        places_m = beach.AREAS_M if scenario.kind == "beach" else snow_slope.AREAS_M
        return {
            name: _on_map(scenario.mark, valley, _ring(east, north, half_x, half_y, corners=4))
            for name, (east, north, half_x, half_y) in places_m.items()
        }
    mark, (east, north, length, width) = scenario.mark, DEPOSIT
    size_factor = scenario.avalanche_size
    corner = np.sqrt(2) * ROCK[2]
    return {
        "glacier": _on_map(mark, valley, _ring(*GLACIER, corners=8)),
        "deposit": _on_map(
            mark, valley, _ring(east, north, size_factor * length, size_factor * width, corners=16)
        ),
        "rock": _on_map(mark, valley, _ring(ROCK[0], ROCK[1], corner, corner, corners=4)),
    }


def _bare_rock(changes: tuple[SurfaceChange, ...], surface: TrueSurface) -> Bools:
    touched = np.zeros(surface.grid.shape, dtype=np.bool_)
    for change, pattern_m in zip(changes, surface.pattern_m, strict=True):
        if change.name not in ON_STABLE_GROUND:
            touched |= pattern_m != 0
    return (surface.ice < ROCK_ICE) & ~touched


def _whole_blocks(suitable: Bools, block: int) -> Bools:
    """Return a mask of the square blocks in which every cell is suitable (blocks down, blocks across)."""
    down, across = (cells // block for cells in suitable.shape)
    cells = suitable[: down * block, : across * block].reshape(down, block, across, block)
    return np.asarray(cells.all(axis=(1, 3)))


def _on_ridge(scenario: Scenario, valley: Valley, surface: TrueSurface, block: int) -> Bools:
    """Return a mask of the blocks entirely on the far ridge (blocks down, blocks across)."""
    grid = surface.grid
    east_m, north_m, _ = map_from_enu(scenario.mark).transform(
        *np.meshgrid(grid.x_m, grid.y_m), surface.elevation_m, direction="INVERSE"
    )
    bearing_deg = np.degrees(np.arctan2(north_m, east_m))
    in_sector = (bearing_deg > RIDGE_DEG[0]) & (bearing_deg < RIDGE_DEG[1])
    return _whole_blocks(in_sector & (np.hypot(east_m, north_m) > valley.size * RIDGE_FROM_M), block)


def _merge_blocks(name: str, blocks: Bools, block: int) -> list[Rectangle]:
    """Return the blocks as rectangles, merging adjacent blocks of a row."""
    runs = [(row, *run) for row in range(len(blocks)) for run in _runs(blocks[row])]
    return [
        Rectangle(f"{name} {number}", row * block, (row + 1) * block, first * block, end * block)
        for number, (row, first, end) in enumerate(runs, start=1)
    ]


def _runs(line: Bools) -> Iterator[tuple[int, int]]:
    """Yield start and end of each contiguous run."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], line, [False])).astype(np.int8)))
    return ((int(first), int(end)) for first, end in list(pairwise(edges))[::2])


def _hut(scenario: Scenario, valley: Valley, grid: Grid) -> Rectangle:
    ((easting_m, northing_m),) = _on_map(
        scenario.mark, valley, np.array([hut_m(scenario, valley)]) / valley.size
    )
    cells = hut_cells(scenario)
    row = round((grid.north_m - northing_m) / grid.cell_m - cells / 2)
    column = round((easting_m - grid.west_m) / grid.cell_m - cells / 2)
    return Rectangle("hut", row, row + cells, column, column + cells)


def _ring(east_m: float, north_m: float, half_x_m: float, half_y_m: float, corners: int) -> Floats:
    """Return a polygon inscribed in an ellipse, counter-clockwise, the first corner also last (n, 2)."""
    turn_rad = 2 * np.pi * (np.arange(corners + 1) % corners + 0.5) / corners
    return np.stack((east_m + half_x_m * np.cos(turn_rad), north_m + half_y_m * np.sin(turn_rad)), axis=1)


def _on_map(mark: Mark, valley: Valley, at_full_size_m: Floats) -> Floats:
    """Return easting and northing of places on the ground, given east and north at full size (n, 2)."""
    east_m, north_m = valley.size * at_full_size_m.T
    easting_m, northing_m, _ = map_from_enu(mark).transform(
        east_m, north_m, valley.ground.at(east_m, north_m)
    )
    return np.stack((easting_m, northing_m), axis=1)
