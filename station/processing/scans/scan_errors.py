"""Errors of a gridded scan, as its uncertainty is computed from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.processing.pipeline import ScanAdjustment
from station.processing.scans.scan_inputs import ScanInputs
from station.processing.scans.scan_residuals import variance_factors, with_motion_seen
from station.processing.workers.worker_process import trim_heap
from station.quantities import Floats, Reference, SharedParameters, VarianceComponents
from station.science.adjustment.prior import globals_sigma
from station.science.gridding.gridder import Gridder
from station.science.gridding.viewing_geometry import ViewingGeometry
from station.science.gridding.viewpoints import PositionErrors, position_errors
from station.science.uncertainty.variance_factors import UNIT_FACTORS, VarianceFactors


@dataclass(frozen=True)
class ScanErrors:
    """Parameters that all points of a scan share, errors of its positions, and the factors of variances.

    Parameters and errors of positions already contain the systematic factor.
    """

    shared: SharedParameters | None
    positions: PositionErrors | None = None
    factors: VarianceFactors = UNIT_FACTORS

    def stored_parameters(self, viewing: ViewingGeometry | None) -> SharedParameters | None:
        """Return the shared parameters as an epoch stores them, with the errors of positions."""
        if self.shared is None or self.positions is None or viewing is None:
            return self.shared
        return self.positions.added_to(self.shared, viewing)


def scan_errors(
    inputs: ScanInputs,
    gridder: Gridder,
    viewing: ViewingGeometry | None,
    adjustment: ScanAdjustment | None,
    components: VarianceComponents,
) -> ScanErrors:
    """Return the errors of a gridded scan, adjusted or not; `components` are its usual motion."""
    if adjustment is None or viewing is None:
        return ScanErrors(inputs.log_only_shared(components))
    shared = adjustment.state.shared
    if inputs.geometry.published_budget:
        return ScanErrors(shared)
    variance = _motion_variance(viewing.reference, components)
    positions = position_errors(gridder, inputs.geometry, viewing, variance)
    if positions is not None:
        positions = with_motion_seen(positions, gridder, viewing, adjustment, shared)
    factors = variance_factors(gridder, viewing, adjustment, shared, positions)
    trim_heap()
    factor = factors.systematic
    return ScanErrors(shared.scaled(factor), positions and positions.scaled(factor), factors)


def _motion_variance(reference: Reference, components: VarianceComponents) -> Floats:
    """Return the variance (n,) of the usual motion of a position from its mean state in the reference."""
    variance = globals_sigma(components, weather_known=True) ** 2
    if reference.scan_ids:
        variance += globals_sigma(reference.components, weather_known=True) ** 2 / len(reference.scan_ids)
    return np.asarray(variance)
