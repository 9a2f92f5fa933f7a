"""Quantities along lines: heights and changes of a profile, the position of a contour or a crest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.archive.epochs import EpochRef
from station.quantities import Bools, Floats, SharedParameters
from station.queries.aggregates import Aggregates
from station.queries.common_errors import common_error_covariance
from station.queries.epoch_cells import EpochCells
from station.queries.site_products.profile_lines import Line
from station.queries.site_products.quantities_of_places import CountedFrom, datum_of
from station.science.analysis.product_estimates import Estimate, crest, crossing
from station.science.gridding.reference_surface import errors_of_sop_scan, errors_on_map
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.parameters import ParameterLayout
from station.science.uncertainty.propagation import aggregate_variance

HeightOrCrest = float | str | None


def profile(aggregates: Aggregates, line: Line, epoch: EpochRef) -> dict[str, Estimate]:
    """Return elevation and change of the samples (k,) of a line by name; NaN where not observed."""
    columns = {}
    for name, surface_m in (("elevation", datum_of(aggregates)), ("elevation_change", None)):
        area = aggregates.observe(line.cells, epoch, surface_m=surface_m)
        value, random_m2, systematic_m2 = np.full((3, len(line.distance_m)), np.nan)
        if area is not None:
            weights, complete = line.weights(area.cells)
            cell_random_m2, cell_systematic_m2 = aggregates.cell_variances(area)
            value[complete] = (weights @ area.value_m)[complete]
            random_m2[complete] = (weights.power(2) @ cell_random_m2)[complete]
            systematic_m2[complete] = (weights @ np.sqrt(cell_systematic_m2))[complete] ** 2
        columns[name] = Estimate(value, random_m2, systematic_m2)
    return columns


def contour(
    aggregates: Aggregates, line: Line, epoch: EpochRef, height_m: HeightOrCrest, base: CountedFrom
) -> dict[str, Estimate]:
    """Return the distance along a line at which the surface crosses a height, or of its crest [m].

    And how far it has moved away from the start of the line since the surface that changes count from.
    """
    scan = aggregates.read_cells(epoch, line.cells)
    reference_m = aggregates.mean_elevation(scan, line.cells)
    here = _find(line, reference_m + scan.change_m, _own_variance(scan, line.cells), height_m)
    if here is None:
        return {"distance": Estimate(), "distance_change": Estimate()}
    random_m2, systematic_m2 = _variances(aggregates, line, scan, here.cells)
    relief_m2 = here.relief_m2 * here.relief @ here.relief
    return {
        "distance": Estimate(here.distance_m, random_m2 + relief_m2, systematic_m2),
        "distance_change": _movement(aggregates, line, scan, reference_m, here, height_m, base),
    }


@dataclass(frozen=True)
class _Found:
    """A place along a line, and how far it moves by the height of each cell (n,) of the line [m/m]."""

    distance_m: float
    cells: Floats
    relief: Floats  # (k,) likewise by the relief of each sample
    relief_m2: float  # variance of that


def _find(line: Line, heights_m: Floats, noise_m2: Floats, height_m: HeightOrCrest) -> _Found | None:
    """Return where heights (n,) of the cells of a line cross one or are highest; None if nowhere.

    Heights are NaN where unknown; `noise_m2` (n,) is their random variance.
    """
    known = np.zeros_like(line.cells)
    known[line.cells] = np.isfinite(heights_m)
    weights, complete = line.weights(known)
    profile_m = np.where(complete, weights @ heights_m[np.isfinite(heights_m)], np.nan)
    profile_noise_m2 = line.interpolation.power(2) @ np.nan_to_num(noise_m2)
    found = (
        crossing(line.distance_m, profile_m, profile_noise_m2, height_m)
        if isinstance(height_m, float)
        else crest(line.distance_m, profile_m, profile_noise_m2)
    )
    if found is None:
        return None
    samples, relief = np.zeros((2, len(line.distance_m)))
    samples[found.samples], relief[found.samples] = found.sensitivity, found.relief
    return _Found(found.distance_m, samples @ line.interpolation, relief, found.relief_m2)


def _movement(
    aggregates: Aggregates, line: Line, scan: EpochCells, reference_m: Floats, here: _Found,
    height_m: HeightOrCrest, base: CountedFrom,
) -> Estimate:  # fmt: skip
    """Return how far a contour or a crest moved away from the start of the line since a surface [m].

    Source: equations.md, 6.18.
    """
    other, share = None, np.ones(len(reference_m))
    surface_m = reference_m
    if base.raster_m is not None:
        surface_m = base.raster_m[line.cells]
    elif base.scans is not None:
        before = base.scans.others(scan.epoch)
        other = aggregates.read_cells(before, line.cells)
        own = np.isfinite(scan.change_m)
        share[own] = np.broadcast_to(base.scans.share_of_others(scan.epoch, before, line.cells), own.shape)[
            own
        ]
        change_m = np.where(share < 1.0, (1 - share) * np.nan_to_num(scan.change_m), 0.0)
        surface_m = aggregates.mean_elevation(other, line.cells) + change_m + share * other.change_m
    fixed = base.raster_m is not None  # without errors
    noise_m2 = _base_variance(scan, other, line.cells)
    there = _find(line, surface_m, 0.0 * noise_m2 if fixed else noise_m2, height_m)
    if there is None:
        return Estimate()
    random_m2, systematic_m2 = _variances(
        aggregates,
        line,
        scan,
        here.cells - (1 - share) * there.cells,
        0.0 * share if fixed else share * there.cells,
        other,
    )
    moved = here.relief - there.relief
    relief_m2 = (here.relief_m2 + there.relief_m2) / 2 * moved @ moved
    return Estimate(here.distance_m - there.distance_m, random_m2 + relief_m2, systematic_m2)


def _variances(
    aggregates: Aggregates,
    line: Line,
    scan: EpochCells,
    weights: Floats,
    base_weights: Floats | None = None,
    base: EpochCells | None = None,
) -> tuple[float, float]:
    """Return the random and the systematic variance of a weighted sum of heights less that of a surface.

    Weights (n,) are those of the cells of a line. The surface is the reference or the mean of scans. All
    adjusted scans share the errors of the reference. Source: equations.md, 6.2 and 6.18.
    """
    base_weights = np.zeros(len(weights)) if base_weights is None else base_weights
    base_m2 = _base_variance(scan, base, line.cells)
    random = float(
        np.sum(weights**2 * np.where(weights != 0, _own_variance(scan, line.cells), 0.0))
        + np.sum(base_weights**2 * np.where(base_weights != 0, base_m2, 0.0))
    )
    used = (weights != 0) | (base_weights != 0)
    if scan.shared is None or not used.any():
        return random, 0.0
    cells = np.zeros_like(line.cells)
    cells[line.cells] = used
    weights, base_weights = weights[used], base_weights[used]
    jacobian = aggregates.jacobian(scan, cells)
    params = jacobian.params
    errors: list[tuple[HeightJacobian, SharedParameters, Floats]] = [(jacobian, scan.shared, weights)]
    common = 0.0
    if base is not None and base.shared is not None:
        base_jacobian = aggregates.jacobian(base, cells)
        errors.append((base_jacobian, base.shared, base_weights))
        covariance = common_error_covariance([scan, base])
        if covariance is not None:
            factor = 1.0 if base.jacobian_factor is None else base.jacobian_factor[cells]
            common = float(
                jacobian.aggregate(weights) @ covariance @ base_jacobian.aggregate(base_weights / factor)
            )
    of_reference = weights * scan.adjusted, base_weights * (base is None or base.adjusted)
    if base is None or base.reference.version == scan.reference.version:
        errors.append((jacobian, _reference_errors(scan, params), of_reference[0] - of_reference[1]))
    else:
        errors.append((jacobian, _reference_errors(scan, params), of_reference[0]))
        errors.append((jacobian, _reference_errors(base, params), of_reference[1]))
    if not scan.adjusted:
        sop_errors = errors_of_sop_scan(scan.shared, scan.reference, params)
        errors.append((jacobian, sop_errors, weights - base_weights))
    zeros = np.zeros(len(weights))
    total = sum(aggregate_variance(of, zeros, matrix, shared) for matrix, shared, of in errors)
    return random, max(total - 2 * common, 0.0)


def _own_variance(scan: EpochCells, cells: Bools) -> Floats:
    """Return the random variance (n,) of the heights of cells, without that of the reference [m²]."""
    reference_m2 = scan.reference.random_variance_m2[cells]
    return np.asarray(np.maximum(scan.random_m**2 - reference_m2, 0.0))


def _base_variance(scan: EpochCells, base: EpochCells | None, cells: Bools) -> Floats:
    """Return the random variance (n,) of the heights of a surface, without one of the reference [m²]."""
    if base is not None:
        return _own_variance(base, cells)
    return np.asarray(scan.reference.random_variance_m2[cells], np.float64)


def _reference_errors(scan: EpochCells, params: ParameterLayout) -> SharedParameters:
    """Return the shared parameters of the reference of a scan; those of the scan if they are of another kind.

    Without errors if the reference has none. Those on the map if the scan is adjusted: of another one, the
    errors of the scan of the SOP count on their own.
    """
    assert scan.shared is not None  # noqa: S101 - the caller has looked
    reference = errors_on_map(scan.reference, params) if scan.adjusted else scan.reference.shared
    if reference is None:
        return scan.shared.scaled(0.0)
    return reference if reference.names == scan.shared.names else scan.shared
