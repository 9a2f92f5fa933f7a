"""What each input has of the variance of an epoch: maps of its cells, tables of its areas."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from station.archive.aggregate import Aggregates
from station.archive.layout import Series, define, lay_out, written_whole
from station.archive.rasters import rounded, write_rasters
from station.archive.store import Row, said
from station.archive.variables import Variable
from station.errors import StoreError
from station.quantities import Bools, Floats, Ints, Reference, Shared
from station.science import terrain
from station.science.calibration import range_bands
from station.science.moved import Moved
from station.science.sensitivity import INPUTS, apart, cell_shares, interactions, sobol, sum_shares
from station.science.shared import Sensitivities, against

LOOKED_AT = 100_000  # cells at once
SIMULATED_CELLS = 100  # of an area: its shares do not depend on every one
SIMULATED_DRAWS = 64  # of each repetition
INTERACTING = 3  # largest inputs, whose interactions are looked at

ROWS = tuple(
    Variable(
        f"share_{name}", ("y", "x"), "f4", f"share of {name} in the variance of the elevation change", "1",
        digits=3, comment="the shares of a cell add up to 1; negative where errors offset each other",
    )
    for name in INPUTS
)  # fmt: skip


@dataclass(frozen=True)
class Attribution:
    """The cells (ny, nx) of an epoch that have a change, and what makes each of them unsure."""

    series: Series
    row: Row
    cells: Bools
    felt: Sensitivities
    random_m2: Floats
    unknown: Shared
    reference: Reference
    position_m: tuple[float, float, float]

    def shares(self, of: Ints | slice) -> dict[str, Floats]:
        """Share of each input in the variance of the chosen of the cells."""
        return cell_shares(self.felt.some(of), self.random_m2[of], self.unknown)

    @cached_property
    def range_m(self) -> Floats:
        """Horizontal distance of each cell (n,) from the scanner."""
        row, column = np.nonzero(self.cells)
        grid = self.series.grid
        return np.hypot(grid.x_m[column] - self.position_m[0], grid.y_m[row] - self.position_m[1])

    def by_range(self) -> list[dict[str, Any]]:
        """Return the mean share of each input over single cells, by band of range."""
        told = []
        for low_m, high_m in range_bands(self.range_m):
            inside = np.flatnonzero((self.range_m >= low_m) & (self.range_m < high_m))
            inside = inside[:: 1 + len(inside) // LOOKED_AT]
            if len(inside):
                shares = {name: float(values.mean()) for name, values in self.shares(inside).items()}
                shared_m2 = self.felt.some(inside).variance(self.unknown)
                sigma = float(np.median(np.sqrt(shared_m2 + self.random_m2[inside])))
                told.append({"cells": f"{low_m:g}-{high_m:g} m", "sigma_m": sigma, "part": shares})
        return told

    def of_area(self, name: str, chosen: Bools, *, simulate: bool = True) -> dict[str, Any] | None:
        """Return the shares in the variance of the mean change of the chosen cells (ny, nx).

        None where none has a change. With `simulate`, Sobol indices of some of its cells too, and beside them
        the shares of the same cells to first order; both take the inputs as independent of each other.
        """
        inside = chosen[self.cells]
        if not inside.any():
            return None
        variance_m2, shares = sum_shares(inside / inside.sum(), self.random_m2, self.felt, self.unknown)
        told: dict[str, Any] = {
            "area": name,
            "cells": int(inside.sum()),
            "sigma_m": float(np.sqrt(variance_m2)),
        }
        for kind in ("part", "first", "total"):
            told[kind] = {name: asdict(share)[kind] for name, share in shares.items()}
        return told | (self._simulated(np.flatnonzero(inside)) if simulate else {})

    def _simulated(self, inside: np.ndarray[Any, Any]) -> dict[str, Any]:
        chosen = inside[np.linspace(0, len(inside) - 1, min(len(inside), SIMULATED_CELLS)).astype(np.int64)]
        grid = self.series.grid
        row, column = (place[chosen] for place in np.nonzero(self.cells))
        ground = terrain.ground(self.reference)
        height_m = ground.under(column + 0.5, row + 0.5)[0]
        felt, random_m2 = self.felt.some(chosen), self.random_m2[chosen]
        weights = np.full(len(chosen), 1 / len(chosen))
        points = grid.x_m[column], grid.y_m[row], height_m
        moved = Moved(ground, self.position_m, points, weights, felt, self.unknown, random_m2)
        groups = moved.groups()
        found = sobol(moved, moved.draw, groups, SIMULATED_DRAWS)
        largest = np.argsort(-found.total)[:INTERACTING].tolist()
        joint = interactions(moved, moved.draw, [groups[one] for one in largest], SIMULATED_DRAWS)
        _, linear = sum_shares(weights, random_m2, felt, apart(self.unknown))
        told = {
            name: dict(zip(INPUTS, values.tolist(), strict=True)) for name, values in asdict(found).items()
        }
        return {
            "simulated": told | {"linear": {name: share.part for name, share in linear.items()}},
            "interactions": [
                {"inputs": [INPUTS[largest[one]] for one in of], "share": share, "error": error}
                for of, (share, error) in joint.items()
                if len(of) > 1
            ],
        }

    def write(self, path: Path) -> None:
        """Write the shares as maps to a NetCDF file; raise StoreError where it cannot."""
        maps = {row.name: np.full(self.cells.shape, np.nan, np.float32) for row in ROWS}
        place = np.flatnonzero(self.cells)
        for first in range(0, len(place), LOOKED_AT):
            part = slice(first, first + LOOKED_AT)
            for name, share in self.shares(part).items():
                maps[f"share_{name}"].ravel()[place[part]] = share
        with written_whole(path) as beside:
            with netCDF4.Dataset(beside, "w", clobber=False) as file:
                title = (
                    f"What makes the elevation change of {self.series.name or self.series.station_id} unsure"
                )
                lay_out(file, self.series, title, None)
                file.setncattr("epoch_file", self.row.epoch_file)
                for row in ROWS:
                    define(file, row, self.series, 1)
            write_rasters(beside, ROWS, lambda rows: [rounded(row, maps[row.name][rows]) for row in ROWS])


def attribute(series: Series, epoch: int | str) -> Attribution:
    """Read what makes an epoch unsure; raise StoreError where it keeps nothing of it."""
    found = Aggregates(series)
    row = found.row(epoch)
    every = np.ones(series.grid.shape, bool)
    if not said(row.path)["reference_version"]:
        raise StoreError(f"{row.epoch_file}: has no reference yet: its change is not known")
    held = found.read(row, every)
    if held.unknown is None:
        raise StoreError(
            f"{row.epoch_file}: does not say what its points share: the scanner's place is not known"
        )
    seen = (
        np.isfinite(held.change_m)
        & np.isfinite(held.random_m)
        & np.isfinite(np.asarray(held.reference.elevation_m).ravel())
    )
    cells = seen.reshape(series.grid.shape)
    return Attribution(
        series, row, cells, found.felt(held, cells), held.random_m[seen] ** 2,
        held.unknown if held.adjusted else against(held.unknown, held.reference.shared),
        held.reference, (held.scanner[0], held.scanner[1], held.scanner[2]),
    )  # fmt: skip
