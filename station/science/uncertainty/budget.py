"""Error budget of a scan's heights by the five sources of Voordendag et al. (2023)."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats, Scanner, SharedParameters
from station.science.geometry.observation import Observation
from station.science.uncertainty import shot_noise
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.propagation import restricted_to

TERMS = ("sigma_registration", "sigma_instrument", "sigma_atmosphere", "sigma_geometry", "sigma_raster")
SHARED = {  # shared parameters by prefix of their names
    "sigma_registration": ("translation_", "heading"),
    "sigma_instrument": ("tilt_", "sight_tilt_", "cross_tilt_", "range_bias"),
    "sigma_atmosphere": ("range_scale", "refraction"),
}
PUBLISHED = ("sigma_voordendag2023", "sigma_hartzell2015")


def error_budget(
    observation: Observation,
    count: Floats,
    sampling_m2: Floats,
    jacobian: HeightJacobian,
    posterior: SharedParameters,
    scanner: Scanner,
) -> dict[str, Floats]:
    """Return the error budget of a scan's own heights [m], by the terms of `TERMS`.

    Tilt and range noise belong to the instrument, the beam's width to the geometry. The squares add up to the
    variance as long as no adjustment has correlated the shared parameters.
    """
    shared_m2 = {
        term: jacobian.variance(
            restricted_to(posterior, np.array([name.startswith(prefixes) for name in posterior.names]))
        )
        for term, prefixes in SHARED.items()
    }
    range_m2 = shot_noise.range_variance(
        observation.cos_incidence, observation.cos_slope, scanner.range_sigma_m
    )
    beam_m2 = shot_noise.angle_variance(
        observation.range_m, observation.cos_incidence, observation.cos_slope, shot_noise.sigma_angle(scanner)
    )
    return {
        "sigma_registration": np.sqrt(shared_m2["sigma_registration"]),
        "sigma_instrument": np.sqrt(range_m2 / count + shared_m2["sigma_instrument"]),
        "sigma_atmosphere": np.sqrt(shared_m2["sigma_atmosphere"]),
        "sigma_geometry": np.sqrt(beam_m2 / count),
        "sigma_raster": np.sqrt(sampling_m2),
    }


def terms_voordendag(
    observation: Observation, count: Floats, scanner: Scanner, sigma_registration_m: float
) -> dict[str, Floats]:
    """Return the published error budget by term [m], for one point as in the paper's figures.

    `sigma_raster` is that of a cell with `count` points, to which the registration is added.
    """
    sin_rise = observation.offset_m[2] / observation.range_m
    geometry = observation.range_m, observation.cos_incidence, observation.cos_slope
    point_m2 = shot_noise.shot_variance_voordendag(*geometry, sin_rise, scanner)
    return {
        "sigma_registration": np.full_like(observation.range_m, sigma_registration_m),
        "sigma_instrument": shot_noise.sigma_instrument(observation.range_m),
        "sigma_atmosphere": np.full_like(observation.range_m, shot_noise.SIGMA_ATMOSPHERE_VOORDENDAG_M),
        "sigma_geometry": shot_noise.sigma_geometry(*geometry, sin_rise, scanner.beam_divergence_rad),
        "sigma_raster": np.sqrt(point_m2 / count),
    }


def published_budget(observation: Observation, count: Floats, scanner: Scanner) -> dict[str, Floats]:
    """Uncertainty of a cell as published [m]: all errors independent between its n points, over √n.

    Source: Voordendag et al. (2023), Eq. 1-2; Hartzell et al. (2015), Eq. 9 and 12, with the tilt's noise as
    part of each point's covariance (equations.md, 2.9). For comparison: it takes shared errors for random.
    """
    geometry = observation.range_m, observation.cos_incidence, observation.cos_slope
    voordendag_m2 = shot_noise.shot_variance_voordendag(
        *geometry, observation.offset_m[2] / observation.range_m, scanner
    )
    tilt_m = np.hypot(observation.offset_m[0], observation.offset_m[1]) * scanner.inclination_sigma_rad
    hartzell_m2 = shot_noise.shot_variance(*geometry, scanner) + tilt_m**2
    return {
        "sigma_voordendag2023": np.sqrt(voordendag_m2 / count),
        "sigma_hartzell2015": np.sqrt(hartzell_m2 / count),
    }
