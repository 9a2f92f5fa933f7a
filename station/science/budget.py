"""The budget of a scan's heights by the five sources of Voordendag et al. (2023)."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats, Scanner, Shared
from station.science import uncertainty
from station.science.sensitivity import only
from station.science.shared import Sensitivities
from station.science.view import View

TERMS = ("sigma_registration", "sigma_instrument", "sigma_atmosphere", "sigma_geometry", "sigma_raster")
SHARED = {  # parameters by how their names begin
    "sigma_registration": ("translation_", "heading"),
    "sigma_instrument": ("tilt_", "lean_", "range_bias"),
    "sigma_atmosphere": ("range_scale", "refraction"),
}
PUBLISHED = ("sigma_voordendag2023", "sigma_hartzell2015")


def terms(
    view: View,
    count: Floats,
    sampling_m2: Floats,
    felt: Sensitivities,
    unknown: Shared,
    scanner: Scanner,
) -> dict[str, Floats]:
    """Split the budget of a scan's own heights [m]: registration, instrument, atmosphere, geometry, raster.

    Lean and range noise are the instrument's, the beam's width is geometry. Their squares add up to the
    variance as long as no adjustment has tied the shared parameters together.
    """
    shared_m2 = {
        name: felt.variance(only(unknown, np.array([one.startswith(begins) for one in unknown.names])))
        for name, begins in SHARED.items()
    }
    range_m2 = uncertainty.range_variance(view.cos_incidence, view.cos_slope, scanner.range_sigma_m)
    beam_m2 = uncertainty.angle_variance(
        view.range_m, view.cos_incidence, view.cos_slope, uncertainty.sigma_angle(scanner)
    )
    return {
        "sigma_registration": np.sqrt(shared_m2["sigma_registration"]),
        "sigma_instrument": np.sqrt(range_m2 / count + shared_m2["sigma_instrument"]),
        "sigma_atmosphere": np.sqrt(shared_m2["sigma_atmosphere"]),
        "sigma_geometry": np.sqrt(beam_m2 / count),
        "sigma_raster": np.sqrt(sampling_m2),
    }


def terms_voordendag(
    view: View, count: Floats, scanner: Scanner, sigma_registration_m: float
) -> dict[str, Floats]:
    """Split the published budget [m], for one point as in the paper's figures.

    `sigma_raster` is that of a cell of `count` points, to which the registration is added.
    """
    rise = view.offset_m[2] / view.range_m
    seen = view.range_m, view.cos_incidence, view.cos_slope
    point_m2 = uncertainty.shot_variance_voordendag(*seen, rise, scanner)
    return {
        "sigma_registration": np.full_like(view.range_m, sigma_registration_m),
        "sigma_instrument": uncertainty.sigma_instrument(view.range_m),
        "sigma_atmosphere": np.full_like(view.range_m, uncertainty.SIGMA_ATMOSPHERE_VOORDENDAG_M),
        "sigma_geometry": uncertainty.sigma_geometry(*seen, rise, scanner.beam_divergence_rad),
        "sigma_raster": np.sqrt(point_m2 / count),
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
