"""Quantities of places: means over their cells, volumes, gain and loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from station.archive.epochs import EpochRef
from station.quantities import Bools, Floats
from station.queries.aggregates import Aggregates, ObservedArea
from station.queries.epoch_cells import bounding_box
from station.queries.site_products.surface_scans import SurfaceScans
from station.science.analysis.product_estimates import (
    SIGN_WINDOW_CELLS,
    Estimate,
    SignOfChange,
    sign_of_change,
    thickness_between,
    water_equivalent,
)
from station.sections.product import ProductSection

NEW_SNOW_H = (24, 72)
NET = "net_change"
BUDGET = ("deposition", "erosion", NET)


@dataclass(frozen=True)
class CountedFrom:
    """What the change of an epoch counts from: scans or a raster (ny, nx); without both, the reference."""

    scans: SurfaceScans | None = None
    raster_m: Floats | None = None


def place_quantities(
    aggregates: Aggregates,
    section: ProductSection,
    rasters: Mapping[str, Floats],
    cells: Bools,
    epoch: EpochRef,
    base: CountedFrom,
    earlier: list[EpochRef | None],
) -> tuple[dict[str, Estimate], float]:
    """Return the quantities of a place (ny, nx) in an epoch by name, and the share that was observed.

    `earlier` are the epochs that new snow counts from.
    """
    if section.kind == "volume_between":
        return _volume_between(aggregates, section, rasters, cells, epoch)
    if section.kind == "volume_budget":
        return _volume_budget(aggregates, cells, epoch, base)
    change, coverage = _mean(aggregates, cells, epoch, base)
    if section.kind == "point":
        datum = CountedFrom(raster_m=datum_of(aggregates))
        return {"elevation": _mean(aggregates, cells, epoch, datum)[0], "elevation_change": change}, coverage
    quantities: dict[str, Estimate] = {section.kind: mapped_quantity(section, change)}
    if section.kind == "snow_depth":
        for hours, before in zip(NEW_SNOW_H, earlier, strict=True):
            quantities[f"new_snow_{hours}h"] = _new_snow(aggregates, cells, epoch, before)
    return quantities, coverage


def mapped_quantity(section: ProductSection, change: Estimate) -> Estimate:
    """Return snow depth, melt or surface mass balance from a change, of a place or of cells (n,)."""
    if section.kind == "snow_depth":
        return change.with_offset(section.offset_m, section.offset_sigma_m)
    mass = water_equivalent(change, section.density_kg_m3 or 0.0, section.density_sigma_kg_m3)
    return mass if section.kind == "surface_mass_balance" else mass.scaled(-1.0)


def datum_of(aggregates: Aggregates) -> Floats:
    """Return the surface (ny, nx) that heights count from [m]."""
    return np.broadcast_to(0.0, aggregates.grid.shape)


def observe_change(
    aggregates: Aggregates, cells: Bools, epoch: EpochRef, base: CountedFrom
) -> tuple[ObservedArea | None, Floats | float]:
    """Return the change of the observed cells (n,) of a place, and the factors by which it counts."""
    if base.scans is None:
        return aggregates.observe(cells, epoch, surface_m=base.raster_m), 1.0
    other = base.scans.others(epoch)
    area = aggregates.observe(cells, epoch, other)
    return area, 1.0 if area is None else base.scans.share_of_others(epoch, other, area.cells)


def _new_snow(aggregates: Aggregates, cells: Bools, epoch: EpochRef, before: EpochRef | None) -> Estimate:
    area = aggregates.observe(cells, epoch, before) if before else None
    return Estimate() if area is None else _sum(aggregates, area, area.weights, area.value_m, area.void_m2)


def _mean(aggregates: Aggregates, cells: Bools, epoch: EpochRef, base: CountedFrom) -> tuple[Estimate, float]:
    """Return the mean change or height of a place with its voids interpolated, and its coverage."""
    area, share = observe_change(aggregates, cells, epoch, base)
    if area is None:
        return Estimate(), 0.0
    return _sum(aggregates, area, area.weights * share, area.value_m, area.void_m2), area.coverage


def _sum(
    aggregates: Aggregates, area: ObservedArea, weights: Floats, value_m: Floats, void_variance: float,
    derivative: Floats | float = 1.0,
) -> Estimate:  # fmt: skip
    random, total = aggregates.sum_variance(area, weights * derivative)
    return Estimate(float(weights @ value_m), random, total - random + void_variance)


def _volume_between(
    aggregates: Aggregates,
    section: ProductSection,
    rasters: Mapping[str, Floats],
    cells: Bools,
    epoch: EpochRef,
) -> tuple[dict[str, Estimate], float]:
    area = aggregates.observe(cells, epoch, surface_m=datum_of(aggregates))
    if area is None:
        return {"volume": Estimate()}, 0.0
    levels = {"low": -np.inf, "high": np.inf} | section.levels
    low_m, high_m = (
        rasters[key][area.cells] if key in rasters else np.array(levels[key]) for key in ("low", "high")
    )
    thickness_m, derivative = thickness_between(area.value_m, low_m, high_m)
    size_m2 = np.count_nonzero(cells) * aggregates.grid.cell_m**2
    void_m6 = size_m2**2 * area.void_m2
    volume = _sum(aggregates, area, size_m2 * area.weights, thickness_m, void_m6, derivative)
    return {"volume": volume}, area.coverage


def _volume_budget(
    aggregates: Aggregates, cells: Bools, epoch: EpochRef, base: CountedFrom
) -> tuple[dict[str, Estimate], float]:
    """Return gain, loss and net of an area; each cell counts in one class, so they close exactly.

    The systematic error of cells that may have gained or lost is in both.
    """
    area, counted = observe_change(aggregates, cells, epoch, base)
    near, _ = observe_change(aggregates, deciding_cells(cells), epoch, base)
    if area is None or near is None:
        return dict.fromkeys(BUDGET, Estimate()), 0.0
    sign = _sign_of_change(aggregates, near, area.cells)
    count = np.count_nonzero(cells)
    size_m2, in_voids = count * aggregates.grid.cell_m**2, area.weights - 1 / count
    budget = {}
    for name, chosen in zip(BUDGET, (sign.gained, ~sign.gained, np.ones_like(sign.gained)), strict=True):
        share = in_voids[chosen].sum() / in_voids.sum() if area.void_m2 else 0.0  # of the voids
        weights, void_m6 = size_m2 * area.weights * counted, (share * size_m2) ** 2 * area.void_m2
        chosen_sum = _sum(aggregates, area, np.where(chosen, weights, 0.0), area.value_m, void_m6)
        possible = ~chosen & ~sign.certain
        if name != NET and possible.any():
            random, total = aggregates.sum_variance(area, np.where(chosen | possible, weights, 0.0))
            chosen_sum = Estimate(
                chosen_sum.value,
                chosen_sum.random_variance + np.where(possible, weights**2, 0.0) @ sign.random_m2,
                total - random + void_m6,
            )
        budget[name] = chosen_sum
    return budget, area.coverage


def deciding_cells(cells: Bools) -> Bools:
    """Return the cells (ny, nx) whose changes tell which cells of an area gained: it and those around."""
    deciding, bounds = np.zeros_like(cells), bounding_box(cells, SIGN_WINDOW_CELLS // 2)
    deciding[bounds] = ndimage.binary_dilation(cells[bounds], np.ones((SIGN_WINDOW_CELLS,) * 2, np.bool_))
    return deciding


def _sign_of_change(aggregates: Aggregates, near: ObservedArea, cells: Bools) -> SignOfChange:
    """Return the sign of the change of some cells (n,) of an observed area."""
    bounds = bounding_box(near.cells, 0)
    change_m, random_m2, systematic_m2 = np.full((3, *near.cells[bounds].shape), np.nan)
    for raster, values in (
        (change_m, near.value_m),
        (random_m2, np.sum(near.random_m2, axis=0)),
        (systematic_m2, aggregates.cell_variances(near)[1]),
    ):
        raster[near.cells[bounds]] = values
    sign = sign_of_change(change_m, random_m2, systematic_m2)
    inside = cells[bounds]
    return SignOfChange(sign.gained[inside], sign.certain[inside], sign.random_m2[inside])
