"""What the papers have wrong or leave open, and what is built instead."""

from __future__ import annotations

from dataclasses import dataclass

from station.papers.figures import HARTZELL, LESLAR, OZENDI, VOORDENDAG


@dataclass(frozen=True)
class Paper:
    """A paper as one cites it."""

    key: str
    authors: str  # as the docstrings name them
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
        "Geomatica 68(3), 10.5623/cig2014-303: variances and Sobol indices of a lidar on a vehicle",
        "which input matters",
    ),
)  # fmt: skip

ERRATA = (
    Erratum(HARTZELL, "Eq. 1", "a beam that begins in the centre of the scanner's frame; it begins beside it",
            "vertex = origin + range times direction (Voordendag et al., Eq. 4): `beam.vertex`, `beam.cartesian`"),
    Erratum(HARTZELL, "Eq. 3", "the order of the three rotations is not unambiguous in print",
            "Rz(κ) Ry(φ) Rx(ω), as in the author's code: `pose.rotation`"),
    Erratum(HARTZELL, "Eq. 5", "the SOP already holds the lean of its own scan: absolute roll and pitch apply it twice",
            "the difference to that scan: `inclination.relative_lean`"),
    Erratum(HARTZELL, "Eq. 7-8", "the beam's width is added as an angle and as a range; on a plane both are one effect",
            "the angle alone: `uncertainty.sigma_angle`"),
    Erratum(HARTZELL, "section 2.2", "the scatter of raw inclination samples is taken as each point's own error",
            "what the filter leaves, common to all points of its time: `shared`"),
    Erratum(HARTZELL, "Eq. 14, 21", "leaving out correlation is called conservative; common errors add up coherently,"
            " so that published volumes are 150 to 280 times too sure",
            "Σ a² σ_r² + gᵀ C g: `volume.variance`, `shared.aggregate_variance`"),
    Erratum(HARTZELL, "Table 2", "Mammoth, mesh, gross: 0.00153 % and 0.00065 % should be 0.00059 % and 0.00052 %",
            "sigmas in m³: `volume.mesh`, `volume.independent_variance`"),
    Erratum(HARTZELL, "section 2.2", "the reference variance takes residuals for independent",
            "as published: `registration.reference_variance`; the station's own adjustment holds what is shared"),
    Erratum(VOORDENDAG, "Eq. 2, 5", "a tilt that 23,000 shots share is divided by √n",
            'tilt as a shared parameter; the printed form with `model = "voordendag2023"`'),
    Erratum(VOORDENDAG, "Eq. 3", "a linear sum of a standard deviation and a bound",
            'quadrature; the printed form with `model = "voordendag2023"`'),
    Erratum(VOORDENDAG, "Eq. 10", "air of one density along the path; its growth below the scanner is left as noise,"
            " and changes of pressure are called insignificant",
            "a hydrostatic path from the station's own temperature and pressure: `air.air_correction`"),
    Erratum(VOORDENDAG, "Eq. 11", "refraction is neglected since the spot stays within the footprint",
            "corrected, and what is left of it estimated in each scan: `air.refraction_rise`, `adjustment`"),
    Erratum(VOORDENDAG, "Eq. 12", "range error seen vertically, but then a constant 0.01 m is taken",
            "Eq. 12 as it stands: `uncertainty.sigma_atmosphere`, `uncertainty.range_variance`"),
    Erratum(VOORDENDAG, "Eq. 13", "negative with the beam pointing down and the normal up",
            "its magnitude: `beam.cos_incidence`"),
    Erratum(VOORDENDAG, "Eq. 17", "π M m with full axes is four times the area; Table 2 gives the major axis as area",
            "π/4 M m: `beam.footprint_area`"),
    Erratum(VOORDENDAG, "Eq. 18", "a third of the vertical extent, nought on ice seen level, where the error is not",
            "R β/4 sin θ / cos γ: `uncertainty.angle_variance`"),
    Erratum(OZENDI, "Eq. 2-4", "the arctangent loses the quadrant", "atan2: `beam.polar`"),
    Erratum(OZENDI, "Eq. 7", "angles are named in one order and used in another, which would swap their sigmas",
            "range, elevation, azimuth throughout: `beam.polar_jacobian`"),
    Erratum(OZENDI, "section 4", "residuals across a plane are taken for those of the range",
            "divided by cos α: `precision.sigma_range`"),
    Erratum(OZENDI, "section 4", "no formula for the noise of the range is published",
            "a I^b + c with the angles' part told apart: `precision.fit_range_model`"),
    Erratum(OZENDI, "Table 1", "the scatter between repeats grows with the step: other spots are compared",
            "sampling and precision apart: `precision.angle_precision`"),
    Erratum(LESLAR, "Eq. 7", "U Q⁻¹ Uᵀ has the unit 1/m²", "U Q Uᵀ: `sensitivity.propagated`"),
    Erratum(LESLAR, "Eq. 11", "only first-order terms are taken off an index of third or higher order",
            "all lower terms taken off: `sensitivity.interactions`; first and total indices need none: `sensitivity.sobol`"),
    Erratum(LESLAR, "section 5", "propagation and Sobol indices are said to name different inputs; with the same inputs"
            " of an almost linear model they cannot", "both are computed and compared: `station sensitivity`"),
    Erratum(LESLAR, "Table 1", "the inertial system's sigmas are not given; both analyses imply different ones",
            "0.007 m, which the shares beside it imply: `mobile.EXPECTED`"),
)  # fmt: skip

NOT_REPRODUCIBLE = {
    HARTZELL: "volumes and Fig. 5-6, 8-11: the points are not published",
    VOORDENDAG: "range errors along LES temperatures, maps of σ per cell, ±0.10 and ±0.50 m (by simulation:"
    " `python -m benchmarks.accuracy`)",
    OZENDI: "the range noise of 2-12 mm: no formula, no data",
    LESLAR: "figures that rest on the inertial system's own sigmas",
}
