"""Errors and open points of the papers, and what is implemented instead."""

from __future__ import annotations

from dataclasses import dataclass

from station.papers.hartzell import HARTZELL
from station.papers.leslar import LESLAR
from station.papers.ozendi import OZENDI
from station.papers.voordendag import VOORDENDAG


@dataclass(frozen=True)
class Paper:
    """A paper as it is cited."""

    key: str
    authors: str  # as cited in the docstrings
    title: str
    subject: str


@dataclass(frozen=True)
class Erratum:
    """One error or ambiguity, and what the program does."""

    paper: str
    equation: str
    wrong: str
    built: str


PAPERS = (
    Paper(
        HARTZELL, "Hartzell et al. (2015)",
        "Rigorous error propagation for terrestrial laser scanning with application to snow volume uncertainty."
        " J. Glaciol. 61(230), 10.3189/2015JoG15J031",
        "covariance of points, registration, volumes",
    ),
    Paper(
        VOORDENDAG, "Voordendag et al. (2023)",
        "Uncertainty assessment of a permanent long-range terrestrial laser scanning system for the quantification of"
        " snow dynamics on Hintereisferner (Austria). Front. Earth Sci. 11, 10.3389/feart.2023.1085416",
        "budget of a permanent station: registration, instrument, atmosphere, geometry, raster",
    ),
    Paper(
        OZENDI, "Ozendi et al. (2016)",
        "An emprical point error model for TLS derived point clouds. ISPRS Archives",
        "precision of ranges and angles from a scanner's own scans",
    ),
    Paper(
        LESLAR, "Leslar et al. (2014)",
        "Geomatica 68(3), 10.5623/cig2014-303: variances and Sobol indices of a mobile lidar",
        "sensitivity analysis",
    ),
)  # fmt: skip

ERRATA = (
    Erratum(HARTZELL, "Eq. 1", "a beam from the origin of the scanner's frame; its true origin is offset",
            "vertex = origin + range times direction (Voordendag et al., Eq. 4): `beam.vertex`, `beam.cartesian`"),
    Erratum(HARTZELL, "Eq. 3", "the order of the three rotations is ambiguous in print",
            "Rz(κ) Ry(φ) Rx(ω), as in the author's code: `pose.rotation`"),
    Erratum(HARTZELL, "Eq. 5", "the SOP already contains the tilt of its scan: absolute roll and pitch apply it twice",
            "the tilt relative to that scan: `inclination.relative_tilt`"),
    Erratum(HARTZELL, "Eq. 7-8", "the beam's width is added as an angle and as a range; on a plane both are the same effect",
            "the angle alone: `shot_noise.sigma_angle`"),
    Erratum(HARTZELL, "section 2.2", "the scatter of raw inclination samples is taken as a random error of each point",
            "the residual after the filter, common to all points of the same time: `parameters`"),
    Erratum(HARTZELL, "Eq. 14, 21", "neglecting correlation is called conservative; common errors add up coherently:"
            " registration alone gives a σ of the net volume of above 1 %, not of 0.004 %",
            "Σ a² σ_r² + gᵀ C g: `volume.variance`, `propagation.aggregate_variance`"),
    Erratum(HARTZELL, "Table 2", "Mammoth, mesh, gross: 0.00153 % and 0.00065 % should be 0.00059 % and 0.00052 %",
            "sigmas in m³: `volume.mesh_volume`, `volume.independent_variance`"),
    Erratum(HARTZELL, "section 2.2", "the reference variance treats residuals as independent",
            "as published: `registration.reference_variance`; the station's adjustment models shared errors"),
    Erratum(VOORDENDAG, "Eq. 2, 5", "a tilt error common to 23,000 shots is divided by √n",
            'tilt as a shared parameter; as printed with `model = "voordendag2023"`'),
    Erratum(VOORDENDAG, "Eq. 3", "a linear sum of a standard deviation and a bound",
            'sum in quadrature; as printed with `model = "voordendag2023"`'),
    Erratum(VOORDENDAG, "Eq. 10", "air of constant density along the path; its increase below the scanner is treated as noise,"
            " and changes of pressure are called insignificant",
            "a hydrostatic path from the station's temperature and pressure: `air.air_correction`"),
    Erratum(VOORDENDAG, "Eq. 11", "refraction is neglected because the spot stays within the footprint",
            "corrected, and its residual estimated in each scan: `air.refraction_height_error`, `joint`"),
    Erratum(VOORDENDAG, "Eq. 12", "range error projected to the vertical, but then a constant 0.01 m is used",
            "Eq. 12 as printed: `shot_noise.sigma_atmosphere`, `shot_noise.range_variance`"),
    Erratum(VOORDENDAG, "Eq. 13", "negative with the beam pointing down and the normal up",
            "its magnitude: `beam.cos_incidence`"),
    Erratum(VOORDENDAG, "Eq. 17", "π M m with full axes is four times the area; Table 2 lists the major axis as area",
            "π/4 M m: `beam.footprint_area`"),
    Erratum(VOORDENDAG, "Eq. 18", "a third of the vertical extent, zero on a level surface, where the error is not",
            "R β/4 sin θ / cos γ: `shot_noise.angle_variance`"),
    Erratum(OZENDI, "Eq. 2-4", "the arctangent loses the quadrant", "atan2: `beam.polar`"),
    Erratum(OZENDI, "Eq. 7", "angles are defined in one order and used in another, which would swap their sigmas",
            "range, elevation, azimuth throughout: `beam.polar_jacobian`"),
    Erratum(OZENDI, "section 4", "residuals across a plane are taken as range residuals",
            "divided by cos α: `precision.sigma_range`"),
    Erratum(OZENDI, "section 4", "no formula for the noise of the range is published",
            "a I^b + c, with the angle noise estimated separately: `precision.fit_range_model`"),
    Erratum(OZENDI, "Table 1", "the scatter between repeats grows with the step, because different spots are compared",
            "sampling and precision separated: `precision.angle_precision`"),
    Erratum(LESLAR, "Eq. 7", "U Q⁻¹ Uᵀ has the unit 1/m²", "U Q Uᵀ: `sensitivity.first_order_variance`"),
    Erratum(LESLAR, "Eq. 11", "only first-order terms are subtracted from an index of third or higher order",
            "all lower terms subtracted: `sensitivity.interactions`; first and total indices need none: `sensitivity.sobol`"),
    Erratum(LESLAR, "section 5", "propagation and Sobol indices are said to rank inputs differently; for the same inputs"
            " of a nearly linear model they cannot", "both are computed and compared: `station sensitivity`"),
    Erratum(LESLAR, "Table 1", "the inertial system's sigmas are not given; both analyses imply different ones",
            "0.007 m, implied by the shares of the other inputs: `mobile_lidar.EXPECTED`"),
)  # fmt: skip

NOT_REPRODUCIBLE = {
    HARTZELL: "volumes, gross sigmas of the meshes and Fig. 5-6, 8-11: the points are not published",
    VOORDENDAG: "range errors along LES temperatures, maps of σ per cell, ±0.10 and ±0.50 m (by simulation:"
    " `python -m benchmarks.accuracy`)",
    OZENDI: "the range noise of 2-12 mm: no formula, no data; the means of Table 1 (36.6cc, 17.8cc): the angles of the"
    " single repeats are not available here",
    LESLAR: "figures that depend on the sigmas of the inertial system or on an unpublished geometry",
}
