"""Variance components of a station: re-estimated from the adjustments of its scans, and widened by motion."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, replace

import numpy as np

from station.quantities import Floats, VarianceComponents
from station.science.adjustment.prior import LineTimes, tilt_correlations, tilt_covariance
from station.science.uncertainty.parameters import GLOBAL, ParameterLayout

INITIAL = VarianceComponents()
PRIOR_SCANS = 8  # weight of the initial values, in scans
ICE_PRIOR_SCANS = 2  # of `refraction_ice`: from site to site it differs tenfold (Hirt et al., 2010)
EM_STEPS = 10
MOUNT_CREEP_RAD, MOUNT_CREEP_M = math.radians(0.005), 0.001  # in a day, growing with the root of time
UNUSUAL_SIGMAS = 3.0  # of the usual motion
TILT_COMPONENTS = ("tilt_drift_rad", "tilt_jitter_rad", "line_jitter_rad")
MIN_TREND_SCANS = 3
ICE = [name for name, _ in GLOBAL].index("refraction_ice")
COMPONENT_SLICES = {  # variance components by the global parameters they describe
    "tilt_rad": slice(2),
    "heading_rad": slice(2, 3),
    "translation_m": slice(3, 6),
    "range_bias_m": slice(6, 7),
    "range_scale_ppm": slice(7, 8),
    "refraction": slice(8, 9),
    "refraction_ice": slice(9, 10),
}


def estimate_variance_components(
    start: VarianceComponents, params: ParameterLayout, scans: Iterable[tuple[LineTimes, Floats, Floats]]
) -> VarianceComponents:
    """Return the variance components shown by estimates (u,) and covariances (u, u) of several scans.

    Each variance is the mean of estimate squared plus posterior variance, shrunk towards its initial value as
    if that came from `PRIOR_SCANS` scans. The tilt components differ in their correlation in time and are
    separated by expectation-maximisation from `start`, which is returned with fewer than two scans. Of the
    refraction over ice a trend from scan to scan, which are in order of time, does not count: it is melt.
    Source: equations.md, 6.4.
    """
    first, last = len(GLOBAL), len(GLOBAL) + params.line_groups
    tilt_slice = slice(first, last)
    second_moment, tilt_moment = (
        np.zeros(last + 2 * params.refraction_knots),
        np.zeros((params.line_groups,) * 2),
    )
    ice_moment = 0.0
    ice_refraction: list[float] = []
    scan_lines: list[LineTimes] = []
    for lines, estimate, covariance in scans:  # one at a time: covariances are large
        scan_lines.append(lines)
        second_moment += estimate**2 + np.diag(covariance)
        ice_refraction.append(float(estimate[ICE]))
        ice_moment += float(covariance[ICE, ICE])
        tilt_moment += (
            np.outer(estimate[tilt_slice], estimate[tilt_slice]) + covariance[tilt_slice, tilt_slice]
        )
    count = len(scan_lines)
    if count < 2:
        return start
    second_moment, tilt_moment = second_moment / (count - 1), tilt_moment / count

    def shrunk_sigma(name: str, variance: float) -> float:
        prior_scans = ICE_PRIOR_SCANS if name == "refraction_ice" else PRIOR_SCANS
        total = variance * count + getattr(INITIAL, name) ** 2 * prior_scans
        return math.sqrt(total / (count + prior_scans))

    variances = {name: float(second_moment[columns].mean()) for name, columns in COMPONENT_SLICES.items()}
    if count > MIN_TREND_SCANS:
        scan = np.arange(count)
        residual = ice_refraction - np.polynomial.Polynomial.fit(scan, ice_refraction, 1)(scan)
        variances["refraction_ice"] = ice_moment / count + float(residual @ residual) / (count - 2)
    variances["refraction_by_azimuth"] = float(second_moment[last : last + params.refraction_knots].mean())
    kernels = tilt_correlations(scan_lines[0])
    components = start
    for _ in range(EM_STEPS):
        precision = np.linalg.inv(tilt_covariance(components, scan_lines[0]))
        weighted_moment = precision @ tilt_moment @ precision
        for name, kernel in zip(TILT_COMPONENTS, kernels, strict=True):
            variances[name] = getattr(components, name) ** 2 * float(
                np.sum(weighted_moment * kernel) / np.sum(precision * kernel)
            )
        components = replace(components, **{name: math.sqrt(variances[name]) for name in TILT_COMPONENTS})
    return replace(start, **{name: shrunk_sigma(name, variance) for name, variance in variances.items()})


def after(components: VarianceComponents, elapsed_s: float) -> VarianceComponents:
    """Return the components of a scan this long after its reference: a mount creeps like a random walk.

    Source: adjustment.md, 4: 0.01° in a day, 0.05° in a season.
    """
    root_days = math.sqrt(elapsed_s / 86_400)
    return replace(
        components,
        tilt_rad=math.hypot(components.tilt_rad, MOUNT_CREEP_RAD * root_days),
        heading_rad=math.hypot(components.heading_rad, MOUNT_CREEP_RAD * root_days),
        translation_m=math.hypot(components.translation_m, MOUNT_CREEP_M * root_days),
    )


def as_wide_as(components: VarianceComponents, estimate: Floats) -> VarianceComponents:
    """Return components that do not reject an estimated state (u,); the same unless it is unusual."""
    sizes = {
        "tilt_rad": float(np.hypot(*estimate[:2])),
        "heading_rad": float(abs(estimate[2])),
        "translation_m": float(np.linalg.norm(estimate[3:6])),
    }
    usual = asdict(components)
    return replace(
        components, **{name: size for name, size in sizes.items() if size > UNUSUAL_SIGMAS * usual[name]}
    )
