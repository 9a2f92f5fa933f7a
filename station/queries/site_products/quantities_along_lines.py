"""Quantities along lines: heights and changes of a profile, the position of a contour or a crest."""

from __future__ import annotations

import numpy as np

from station.archive.epochs import EpochRef
from station.quantities import Floats
from station.queries.aggregates import Aggregates
from station.queries.site_products.profile_lines import Line
from station.queries.site_products.quantities_of_places import datum_of
from station.science.analysis.product_estimates import Estimate, crest, crossing

Parts = tuple[Floats, Floats, Floats]  # value (k,), random and systematic variance of each sample


def profile(aggregates: Aggregates, line: Line, epoch: EpochRef) -> dict[str, Parts]:
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
        columns[name] = value, random_m2, systematic_m2
    return columns


def contour(aggregates: Aggregates, line: Line, epoch: EpochRef, height_m: float | str | None) -> Estimate:
    """Return the distance along a line at which the surface crosses a height, or of its crest [m]."""
    area = aggregates.observe(line.cells, epoch, surface_m=datum_of(aggregates))
    if area is None:
        return Estimate()
    interpolation, complete = line.weights(area.cells)
    profile_m = np.where(complete, interpolation @ area.value_m, np.nan)
    found = (
        crossing(line.distance_m, profile_m, height_m)
        if isinstance(height_m, float)
        else crest(line.distance_m, profile_m)
    )
    if found is None:
        return Estimate()
    random, total = aggregates.sum_variance(area, found.sensitivity @ interpolation[found.samples])
    return Estimate(found.distance_m, max(random, found.scatter_variance), total - random)
