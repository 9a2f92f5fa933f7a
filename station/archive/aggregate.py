"""The uncertainty of anything linear in the cells: a box, an area, a volume, a difference of two epochs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import netCDF4
import numpy as np

from station.archive.layout import Series, strings
from station.archive.rasters import around
from station.archive.reference import open_reference
from station.archive.store import Row, rows
from station.errors import StoreError
from station.quantities import Bools, ChangeErrors, Floats, Grid, Quality, Reals, Reference, Shared
from station.science import ground
from station.science.held import share
from station.science.likeness import common_errors
from station.science.shared import (
    Basis,
    Sensitivities,
    against,
    aggregate_variance,
    basis,
    by_names,
    cell_sensitivities,
)
from station.science.terrain import smooth_gradient
from station.science.voids import area_weights, void_variance

if TYPE_CHECKING:
    import xarray as xr

MARGIN_CELLS = 6  # that a smoothed gradient looks beyond a cell
CHANGE, RANDOM = "elevation_change", "elevation_change_random_uncertainty"


@dataclass(frozen=True)
class AreaChange:
    """How an area changed: mean with its voids interpolated, median of what was seen, one sigma each.

    NaN where nothing was seen.
    """

    mean_m: float
    mean_sigma_m: float
    median_m: float
    median_sigma_m: float
    coverage: float  # share of its cells that have a change


@dataclass(frozen=True)
class Held:
    """What an epoch keeps of some cells (n,)."""

    change_m: Floats
    random_m: Floats
    unknown: Shared | None
    scanner: tuple[float, ...]  # where it stood and what it turned about
    reference: Reference
    adjusted: bool  # to the reference, so that `unknown` is against that
    row: Row


class Aggregates:
    """Means and variances over cells of the epochs of a store, from what each epoch keeps."""

    def __init__(self, series: Series) -> None:
        self._series = series
        self._references: dict[str | None, Reference] = {}
        self._felt: tuple[Held, Bools, Sensitivities] | None = None  # the last, asked for again by the median
        self._unknown: tuple[Row, Shared] | None = None  # of the last epoch, whose areas come one by one

    def reference(self, version: str | None = None) -> Reference:
        """Return a surface that change is measured from, the newest or a version.

        Raises StoreError where it is not there.
        """
        if version not in self._references:
            found = open_reference(self._series, version)
            if found is None:
                raise StoreError(f"{self._series.folder}: no reference {version or 'yet'}: nothing to sum up")
            self._references[version] = found
        return self._references[version]

    def row(self, epoch: int | str | np.datetime64) -> Row:
        """Find an epoch by its place in the series or by the time nearest to its middle (UTC)."""
        found = rows(self._series)
        if not found:
            raise StoreError(f"{self._series.folder}: nothing is stored yet")
        if isinstance(epoch, (int, np.integer)):
            return found[epoch]
        wanted_s = float((np.datetime64(str(epoch)) - np.datetime64(0, "s")) / np.timedelta64(1, "s"))
        return min(found, key=lambda row: abs(row.time_s - wanted_s))

    def variance(self, weights: Floats, row: Row, other: Row | None = None) -> float:
        """Variance of the weighted sum of the change in an epoch, or of its difference to another epoch.

        `weights` (ny, nx), nought outside. The unit is that of the weights squared, times m². Cells without a
        change count nothing. Source: EQUATIONS 6.2.
        """
        cells = weights != 0
        held = self._held(cells, row, other)
        chosen = seen_in_all(held, cells)
        return self._total(held, chosen, weights[chosen], self._random(held, chosen, chosen[cells]))

    def area(self, cells: Bools, row: Row, other: Row | None = None) -> AreaChange:
        """Change of the cells (ny, nx) in an epoch, or from another epoch to it.

        The median's sigma is that of a mean but for its random part, which is √(π/2) as large, as of normal
        errors. Source: EQUATIONS 6.2; voids: Hartzell et al. (2015), see `science.voids`.
        """
        held = self._held(cells, row, other)
        chosen = seen_in_all(held, cells)
        box = _box(cells, 0)
        seen = chosen[box][cells[box]]
        if not seen.any():
            return AreaChange(np.nan, np.nan, np.nan, np.nan, 0.0)
        change_m = held[0].change_m[seen] - (0.0 if other is None else held[1].change_m[seen])
        random_m2 = self._random(held, chosen, seen)
        around_m, noise_m2 = np.full(cells[box].shape, np.nan), np.zeros(cells[box].shape)
        around_m[chosen[box]], noise_m2[chosen[box]] = change_m, np.sum(random_m2, axis=0)
        weights, reach = area_weights(cells[box], chosen[box])
        chosen_weights = weights[chosen[box]]
        variance_m2 = self._total(held, chosen, chosen_weights, random_m2)
        variance_m2 += void_variance(cells[box], reach, around_m, noise_m2)
        same = np.full(len(change_m), 1 / len(change_m))
        of_median_m2 = self._total(held, chosen, same, random_m2, grown=np.pi / 2)
        return AreaChange(
            mean_m=float(chosen_weights @ change_m),
            mean_sigma_m=float(np.sqrt(variance_m2)),
            median_m=float(np.median(change_m)),
            median_sigma_m=float(np.sqrt(of_median_m2)),
            coverage=float(seen.mean()),
        )

    def shared_between(self, row: Row, other: Row, part: Grid, elevation_m: Reals, cells: Bools) -> Floats:
        """Variance (n,) of the change from another epoch to one, as far as points of a scan share it [m²].

        Of the chosen cells (ny, nx) of a surface on a grid of its own: a cell's own noise is not in it.
        Source: EQUATIONS 6.2.
        """
        held = [self.read(one, np.zeros(self._series.grid.shape, np.bool_)) for one in (row, other)]
        told = [(one.scanner, one.unknown) for one in held if one.unknown is not None]
        common = common_of(held)
        if common is not None:
            (scanner, one), (_, another) = told
            covariance = one.covariance + another.covariance - common - common.T
            noise = one.noise_variance + another.noise_variance
            told = [(scanner, replace(one, covariance=covariance, noise_variance=noise))]
        gradient = smooth_gradient(elevation_m, part.cell_m)
        variance_m2 = np.zeros(np.count_nonzero(cells))
        for scanner, unknown in told:
            of, position_m = self._basis(scanner)
            felt = cell_sensitivities(of, part, position_m, elevation_m, gradient, cells)
            variance_m2 += felt.variance(unknown)
        return variance_m2

    def _held(self, cells: Bools, row: Row, other: Row | None) -> list[Held]:
        return [self.read(one, cells) for one in ([row] if other is None else [row, other])]

    def _random(self, held: list[Held], chosen: Bools, seen: Bools) -> list[Floats]:
        """Variance of the chosen cells (n,) in each epoch that is theirs alone [m²]."""
        found = []
        for one in held:
            random_m2 = one.random_m[seen] ** 2
            if len(held) > 1:  # what one reference does not know is in both and goes
                before_m2 = one.reference.random_variance_m2[chosen]
                random_m2 = np.maximum(random_m2 - before_m2, 0.0) + self._apart(held, chosen) * before_m2
            found.append(random_m2)
        return found

    def _total(
        self,
        held: list[Held],
        chosen: Bools,
        weights: Floats,
        random_m2: list[Floats],
        grown: float = 1.0,
    ) -> float:
        """Variance of the weighted sum of the chosen cells (n,), over the epochs; the random part `grown`.

        Of two epochs, what both have wrong goes off, but never what cells have of their own.
        """
        total, least, effects = 0.0, 0.0, []
        for one, alone_m2 in zip(held, random_m2, strict=True):
            unknown, own_m2 = one.unknown, grown * alone_m2
            if unknown is None:
                total, least = (before + float(np.sum(weights**2 * own_m2)) for before in (total, least))
                continue
            if len(held) == 1 and not one.adjusted:
                unknown = against(unknown, one.reference.shared)
            felt = self.felt(one, chosen)
            effects.append(felt.total(weights))
            noise = self.held_share(one, chosen, felt, alone_m2) if len(held) > 1 else None
            total += aggregate_variance(weights, own_m2, felt, unknown, noise)
            least += float(np.sum(weights**2 * own_m2 * (1.0 if noise is None else 1 - noise)))
        common = common_of(held)
        if common is not None:
            total -= 2 * float(effects[0] @ common @ effects[1])
        return max(total, least)

    def held_share(self, one: Held, chosen: Bools, felt: Sensitivities, own_m2: Floats) -> Floats | None:
        """Share (n,) of the chosen cells' own noise that an epoch's estimate holds too; None if unknown.

        Asked for differences alone: against the reference this would take off about as much as the reference
        itself has wrong, a tenth of a millimetre of an area, which nothing else counts.
        """
        index = one.row.index
        with netCDF4.Dataset(one.row.path) as file:
            if not one.adjusted or not set(SLACK) <= set(file.variables):
                return None
            moving, stable = (float(np.ma.filled(file[name][index], np.nan)) for name in SLACK)
            quality = cell_values(file["quality"], index, chosen).astype(np.int64)
        if not np.isfinite([moving, stable]).all():
            return None
        grid, (row, column) = self._series.grid, np.nonzero(chosen)
        kept_out = ground.withheld(grid.x_m[column], grid.y_m[row])
        known = (quality & Quality.STABLE_GROUND) > 0
        smooth = np.hypot(*felt.globals_[3:5]) < ground.MOVING_STEEPEST
        kind = ground.kinds(known, kept_out, smooth, np.zeros_like(known))
        random_m2 = own_m2 + one.reference.random_variance_m2[chosen]
        return share(own_m2, random_m2, kind, (moving, stable))

    def _apart(self, held: list[Held], cells: Bools) -> Bools:
        """Tell where the references of two epochs are not one surface."""
        one, other = (epoch.reference.elevation_m[cells] for epoch in held)
        return np.asarray(one != other)

    def coarsened(self, row: Row, cells: int) -> xr.Dataset:
        """Change in blocks of cells × cells of an epoch, every point counting the same, and one sigma [m].

        `point_count` is the sum. Shared errors are taken as one within a block. Rows and columns that fill
        no block are left out.
        """
        import xarray as xr  # noqa: PLC0415 - the service does without

        grid = self._series.grid
        ny, nx = grid.ny // cells, grid.nx // cells
        if not ny or not nx:
            raise ValueError(f"blocks of {cells} cells do not fit a grid of {grid.ny} by {grid.nx}")
        with netCDF4.Dataset(row.path) as file:
            change_m, random_m, sigma_m, count = (
                np.ma.filled(file[name][row.index].astype(np.float64), np.nan)[: ny * cells, : nx * cells]
                for name in (CHANGE, RANDOM, "elevation_change_uncertainty", "point_count")
            )
        count = np.where(np.isfinite(change_m), count, 0.0)

        def total(values: Floats) -> Floats:
            return np.asarray(np.nansum(values.reshape(ny, cells, nx, cells), axis=(1, 3)))

        points = total(count)
        with np.errstate(invalid="ignore", divide="ignore"):
            random_m2 = total(count**2 * random_m**2) / points**2
            shared_m2 = total(count * (sigma_m**2 - random_m**2)) / points
            rasters = {
                CHANGE: total(count * change_m) / points,
                "elevation_change_uncertainty": np.sqrt(random_m2 + np.maximum(shared_m2, 0.0)),
                RANDOM: np.sqrt(random_m2),
                "point_count": points,
            }
        y_m = grid.y_m[: ny * cells].reshape(ny, cells).mean(axis=1)
        x_m = grid.x_m[: nx * cells].reshape(nx, cells).mean(axis=1)
        return xr.Dataset({name: (("y", "x"), v) for name, v in rasters.items()}, {"y": y_m, "x": x_m})

    def felt(self, held: Held, cells: Bools) -> Sensitivities:
        """Return what the chosen cells (ny, nx) of an epoch feel of its shared parameters."""
        if self._felt is None or self._felt[0] is not held or self._felt[1] is not cells:
            self._felt = held, cells, self._sensitivities(held, cells)
        return self._felt[2]

    def _sensitivities(self, held: Held, cells: Bools) -> Sensitivities:
        grid, elevation_m = self._series.grid, held.reference.elevation_m
        of, position_m = self._basis(held.scanner)
        rows, columns = _box(cells, MARGIN_CELLS)
        corner_m = grid.west_m + columns.start * grid.cell_m, grid.north_m - rows.start * grid.cell_m
        around = elevation_m[rows, columns]
        part = Grid(*corner_m, grid.cell_m, around.shape[1], around.shape[0])
        gradient = smooth_gradient(around, grid.cell_m)
        return cell_sensitivities(of, part, position_m, around, gradient, cells[rows, columns])

    def read(self, row: Row, cells: Bools) -> Held:
        """Read what an epoch keeps of the chosen cells (ny, nx); raise ValueError on another grid."""
        if cells.shape != self._series.grid.shape:
            raise ValueError(f"given {cells.shape} rows and columns, the grid has {self._series.grid.shape}")
        with netCDF4.Dataset(row.path) as file:
            reference = self.reference(str(file["reference_version"][row.index]))
            change_m, random_m = (cell_values(file[name], row.index, cells) for name in (CHANGE, RANDOM))
            scanner = tuple(float(np.ma.filled(file[name][row.index], np.nan)) for name in SCANNER)
            joint = str(file["adjustment"][row.index]) == "joint"
            unknown = self._unknown_in(file, row, scanner)
        return Held(change_m, random_m, unknown, scanner, reference, joint, row)

    def _unknown_in(self, file: netCDF4.Dataset, row: Row, scanner: tuple[float, ...]) -> Shared | None:
        """Read what the cells of an epoch share, the same for any of them; None where it does not say."""
        if "parameter_name" not in file.variables or not np.isfinite(scanner).all():
            return None
        if self._unknown is None or self._unknown[0] != row:
            file.set_auto_chartostring(False)
            names, units = (tuple(strings(np.ma.getdata(file[name][:]))) for name in PARAMETER)
            estimate, covariance, noise, *change = (
                np.ma.filled(file[name][row.index].astype(np.float64), 0.0)  # what other epochs alone name
                for name in (*SHARED, *(CHANGE_ERRORS if set(CHANGE_ERRORS) <= set(file.variables) else ()))
            )
            change_errors = ChangeErrors(*change) if change else None
            found = Shared(names, units, estimate, covariance, noise, change_errors)
            self._unknown = row, by_names(self._basis(scanner)[0], found)
        return self._unknown[1]

    def _basis(self, scanner: tuple[float, ...]) -> tuple[Basis, tuple[float, float, float]]:
        """Return the parameters of a scanner and where it stood."""
        east_m, north_m, height_m, axis_east, axis_north = scanner
        up = float(np.sqrt(max(1 - axis_east**2 - axis_north**2, 0.0)))
        position_m = east_m, north_m, height_m
        return basis(self._series.grid, position_m, (axis_east, axis_north, up)), position_m


SCANNER = ("scanner_east", "scanner_north", "scanner_height", "scanner_axis_east", "scanner_axis_north")
PARAMETER = ("parameter_name", "parameter_unit")
SHARED = ("shared_parameter", "shared_parameter_covariance", "shared_parameter_noise_variance")
CHANGE_ERRORS = ("change_errors", "change_pattern")  # as `ChangeErrors` has them
SLACK = ("adjustment_slack_moving", "adjustment_slack_stable")


def common_of(held: list[Held]) -> Floats | None:
    """Covariance (p, p) between what two epochs have wrong; None where there is none, or of one epoch."""
    one, other = held[0], held[-1]
    if one is other or not (one.adjusted and other.adjusted) or one.unknown is None or other.unknown is None:
        return None
    if one.reference.version != other.reference.version:
        return None
    return common_errors(one.unknown, other.unknown)


def seen_in_all(held: list[Held], cells: Bools) -> Bools:
    """Tell which of the cells (ny, nx) have a change in every epoch, and a reference."""
    chosen, box = np.zeros(cells.shape, np.bool_), _box(cells, 0)
    chosen[box][cells[box]] = np.logical_and.reduce(
        [np.isfinite(one.change_m) & np.isfinite(one.reference.elevation_m[cells]) for one in held]
    )
    return chosen


def cell_values(variable: Any, index: int, cells: Bools) -> Floats:  # noqa: ANN401 - netCDF4 has no types
    """Read the chosen cells (n,) of a raster, and no more of it than their bounding box."""
    if not cells.any():
        return np.empty(0)
    box = _box(cells, 0)
    values = np.ma.filled(variable[(index, *box)].astype(np.float64), np.nan)
    return np.asarray(values[cells[box]])


def _box(cells: Bools, margin: int) -> tuple[slice, slice]:
    """Rows and columns that hold the chosen cells (ny, nx), and so many beyond."""
    rows, columns = around(cells)
    return (
        slice(max(rows.start - margin, 0), rows.stop + margin),
        slice(max(columns.start - margin, 0), columns.stop + margin),
    )
