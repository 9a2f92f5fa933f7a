"""The owner's registration of a scan: the pose it gives, its covariance, and the own estimate."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from station.config import Site
from station.errors import ConfigError
from station.inbox.listing import ScanFile
from station.processing.scanner_pose import registered_matrix, scanner_to_map
from station.processing.scans.open_scans import PositionScan
from station.quantities import SharedParameters, VarianceComponents
from station.science.adjustment.joint import Adjustment
from station.science.geometry.pose import ScannerToMap
from station.science.uncertainty.propagation import with_pose_uncertainty

MAX_REGISTRATION_Z = 3.0

CovarianceOf = Callable[[VarianceComponents], SharedParameters]


def is_given(site: Site) -> bool:
    """Return True if registrations of the owner are not to be changed."""
    return site.registration is not None and site.registration.use == "given"


def registration(site: Site, position: PositionScan, warnings: list[str]) -> ScannerToMap | None:
    """Return the transformation to the map by the registration of a scan, None without one.

    What is wrong with it is appended to `warnings`: the SOP places the scan then, if there is one.
    """
    if site.registration is None or site.scans.frame == "map":
        return None
    fallback = "placed by the SOP" if position.sop else "taken as it is"
    if position.matrix is None:
        warnings.append(f"registration missing: {fallback}")
        return None
    try:
        matrix = registered_matrix(site, position.sop, position.matrix)
        return scanner_to_map(site, position.sop, matrix)
    except ConfigError as error:
        warnings.append(f"registration unusable: {fallback}: {error}")
        return None


def registered_covariance(site: Site, covariance: CovarianceOf) -> CovarianceOf:
    """Return the covariance with that of the registration for the pose."""
    section = site.registration
    assert section is not None  # noqa: S101 - checked by the caller
    sigma_rad, sigma_m = math.radians(section.sigma_deg), section.sigma_m
    return lambda components: with_pose_uncertainty(covariance(components), sigma_rad, sigma_m)


def registration_difference(
    site: Site, scan: ScanFile, adjustment: Adjustment | None
) -> tuple[dict[str, float], list[str]]:
    """Return by how much a scan's own estimate differs from its registration [°, m], and warnings.

    A registration to be used as given is warned of if one of the six parameters differs by three sigma.
    """
    section = site.registration
    if section is None or adjustment is None or (section.suffix is not None and not scan.matrices):
        return {}, []
    pose = slice(0, 6)  # rotation about east, north and up, then translation
    difference = adjustment.estimate[pose]
    rotation_deg = math.degrees(float(np.linalg.norm(difference[:3])))
    translation_m = float(np.linalg.norm(difference[3:]))
    scalars = {"registration_rotation": rotation_deg, "registration_translation": translation_m}
    given_sigma = np.repeat([math.radians(section.sigma_deg), section.sigma_m], 3)
    sigma = np.sqrt(given_sigma**2 + np.diag(adjustment.covariance)[pose])
    if section.use == "start" or (np.abs(difference) <= MAX_REGISTRATION_Z * sigma).all():
        return scalars, []
    warning = f"registration differs by {rotation_deg:.4f}° and {translation_m:.3f} m from the own estimate"
    return scalars, [f"{warning}, by more than {MAX_REGISTRATION_Z:g} sigma"]
