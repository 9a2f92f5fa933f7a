"""Errors that epochs have in common: those of the reference above all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from station.archive.epochs import EpochRef
from station.quantities import Bools, Floats, SharedParameters
from station.queries.epoch_cells import EpochCells, layout_of_scanner
from station.science.gridding.reference_surface import errors_of_sop_scan, errors_on_map
from station.science.uncertainty.common_mode import cross_covariance
from station.science.uncertainty.propagation import difference_to_reference

if TYPE_CHECKING:
    from station.queries.aggregates import Aggregates

PAIRS = 8  # of consecutive epochs, spread over the series


def shared_of(
    epochs: list[EpochCells], epoch_cells: EpochCells, *, above_surface: bool
) -> SharedParameters | None:
    """Return the shared parameters of one of the epochs whose cells are summed; None if it has none.

    Those of an adjusted epoch are relative to the reference, those of another one to the scan that the SOP is
    from. The errors of the reference, or of that scan, are added where they take part and do not cancel.
    """
    shared, reference = epoch_cells.shared, epoch_cells.reference
    if shared is None or len(epochs) > 1:
        return shared
    if not above_surface:
        return shared if epoch_cells.adjusted else difference_to_reference(shared, reference.shared)
    params, _ = layout_of_scanner(reference.grid, epoch_cells.scanner)
    if epoch_cells.adjusted:
        return difference_to_reference(shared, errors_on_map(reference, params))
    return shared + errors_of_sop_scan(shared, reference, params)


def common_error_covariance(epochs: list[EpochCells]) -> Floats | None:
    """Return the error covariance (p, p) between two epochs; None if there is none, or for one epoch."""
    first, second = epochs[0], epochs[-1]
    if (
        first is second
        or not (first.adjusted and second.adjusted)
        or first.shared is None
        or second.shared is None
    ):
        return None
    if first.reference.version != second.reference.version:
        return None
    covariances = [
        covariance
        for covariance in (
            cross_covariance(first.shared, shared) for shared in second.members or (second.shared,)
        )
        if covariance is not None
    ]
    return np.mean(covariances, axis=0) if covariances else None


def common_error_share(aggregates: Aggregates, cells: Bools, epochs: list[EpochRef]) -> float:
    """Return the share of the variance of the mean change over cells (ny, nx) that epochs have in common [1].

    It is the median correlation of the errors of pairs of epochs, from the variances of both and of their
    difference; 0 for a single epoch. Source: equations.md, 6.10.
    """
    shares = []
    for first in np.unique(np.linspace(0, len(epochs) - 2, PAIRS).astype(int)).tolist() if epochs[1:] else ():
        pair = epochs[first], epochs[first + 1]
        variances = [aggregates.variance(cells, epoch) for epoch in pair]
        covariance = (sum(variances) - aggregates.variance(cells, pair[1], pair[0])) / 2
        if np.isfinite(covariance) and min(variances) > 0:
            shares.append(covariance / np.sqrt(variances[0] * variances[1]))
    return float(np.clip(np.median(shares), 0.0, 1.0)) if shares else 0.0
