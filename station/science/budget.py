"""The budget of a scan's heights term by term: instrument, atmosphere, geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.quantities import Floats, Scanner, Shared
from station.science import uncertainty
from station.science.shared import Sensitivities
from station.science.view import View

TERMS = ("sigma_instrument", "sigma_atmosphere", "sigma_geometry")
PUBLISHED = ("sigma_voordendag2023", "sigma_hartzell2015")


def terms(
    view: View,
    count: Floats,
    sampling_m2: Floats,
    felt: Sensitivities,
    unknown: Shared,
    scanner: Scanner,
) -> dict[str, Floats]:
    """Split the budget of a scan's own heights [m]: instrument, atmosphere, geometry.

    Their squares add up to the variance as long as no adjustment has tied the shared parameters together.
    """
    by_air = np.array([name.startswith(("range_scale", "refraction")) for name in unknown.names])
    range_m2 = uncertainty.range_variance(view.cos_incidence, view.cos_slope, scanner.range_sigma_m)
    beam_m2 = uncertainty.angle_variance(
        view.range_m, view.cos_incidence, view.cos_slope, uncertainty.sigma_angle(scanner)
    )
    air_m2, other_m2 = (
        felt.variance(
            replace(
                unknown,
                covariance=np.where(np.outer(of, of), unknown.covariance, 0.0),
                noise_variance=np.where(of, unknown.noise_variance, 0.0),
            )
        )
        for of in (by_air, ~by_air)
    )
    return {
        "sigma_instrument": np.sqrt(range_m2 / count + other_m2),
        "sigma_atmosphere": np.sqrt(air_m2),
        "sigma_geometry": np.sqrt(beam_m2 / count + sampling_m2),
    }


def terms_voordendag(view: View, scanner: Scanner) -> dict[str, Floats]:
    """Split the published budget [m], for one point as in the paper's figures."""
    constant_m = np.full_like(view.range_m, uncertainty.SIGMA_ATMOSPHERE_VOORDENDAG_M)
    return {
        "sigma_instrument": uncertainty.sigma_instrument(view.range_m),
        "sigma_atmosphere": constant_m,
        "sigma_geometry": uncertainty.sigma_geometry(
            view.range_m,
            view.cos_incidence,
            view.cos_slope,
            view.offset_m[2] / view.range_m,
            scanner.beam_divergence_rad,
        ),
    }


def published(view: View, count: Floats, scanner: Scanner) -> dict[str, Floats]:
    """Uncertainty of a cell as the papers state it [m]: every error its point's own, over the root of n.

    Source: Voordendag et al. (2023), Eq. 1-2; Hartzell et al. (2015), Eq. 9 and 12, with the tilt's noise as
    part of each point's covariance (EQUATIONS 2.9). For comparison: what points share they take for random.
    """
    seen = view.range_m, view.cos_incidence, view.cos_slope
    voordendag_m2 = uncertainty.shot_variance_voordendag(*seen, view.offset_m[2] / view.range_m, scanner)
    lean_m = np.hypot(view.offset_m[0], view.offset_m[1]) * scanner.inclination_sigma_rad
    hartzell_m2 = uncertainty.shot_variance(*seen, scanner) + lean_m**2
    return {
        "sigma_voordendag2023": np.sqrt(voordendag_m2 / count),
        "sigma_hartzell2015": np.sqrt(hartzell_m2 / count),
    }
