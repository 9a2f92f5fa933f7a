"""Schema of the store: one table with one row per variable.

Source: store.md, 3.
"""

from __future__ import annotations

from dataclasses import dataclass

from station.quantities import Quality
from station.science.uncertainty.common_mode import MODES, SECTORS

FILL = 9.96921e36  # netCDF default fill for floats; NCO averages with NaN come out missing
VERDICTS = ("good", "degraded", "unusable")

RASTER = ("time", "y", "x")
TEXT = ("time", "text")
SERIES_SCALARS = {  # of `series.nc`: what one needs with the rasters; all others are in `processing.nc`
    "scan_id", "verdict", "verdict_reason", "coverage", "valid_count", "stable_nmad", "air_temperature",
    "reference_version", "epoch_file",
}  # fmt: skip


@dataclass(frozen=True)
class Variable:
    """A variable of the store. `digits`: decimals kept, rounded to powers of two (3: 1/1024)."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    long_name: str
    units: str | None = None
    standard_name: str | None = None
    digits: int | None = None
    cell_methods: str | None = None
    comment: str | None = None
    flag_masks: tuple[int, ...] = ()
    flag_values: tuple[int, ...] = ()
    flag_meanings: str | None = None
    ancillary: tuple[str, ...] = ()  # variables that qualify this one

    @property
    def is_raster(self) -> bool:
        """True if the variable is on the grid."""
        return self.dims[-2:] == ("y", "x")

    @property
    def is_large(self) -> bool:
        """True if `series.nc` and `processing.nc` link to the variable in the epoch files."""
        return len(self.dims) > 2

    @property
    def is_result(self) -> bool:
        """True if the variable is in `series.nc`; the others say how a scan was processed."""
        return self.is_raster or self.name in SERIES_SCALARS


_MEAN = "area: mean"
_ONE_SIGMA = "one standard deviation of a single cell"
SAFE_BOUND = (
    "not to be averaged or divided by sqrt(n), because values of a scan share errors: an upper bound for the"
    " mean of n of them is sqrt(sum(u^2 - s^2) / n^2 + mean(s)^2), where u is this uncertainty and s the"
    " systematic uncertainty"
)
_QUANTUM = "rounded to the power of two that is a quarter of the random uncertainty or just below"

VARIABLES: tuple[Variable, ...] = (
    Variable(
        "elevation",
        RASTER,
        "f4",
        "elevation of the surface, mean over the cell",
        "m",
        "surface_altitude",
        None,
        _MEAN,
        f"reference_mean_elevation of the reference + elevation_change; {_QUANTUM}",
        ancillary=("elevation_spread", "point_count", "quality"),
    ),
    Variable(
        "elevation_outside_reference",
        RASTER,
        "f4",
        "elevation of the surface where the reference surface is not known, mean over the cell",
        "m",
        "surface_altitude",
        None,
        _MEAN,
        f"elsewhere the elevation is reference_mean_elevation of reference.nc + elevation_change; {_QUANTUM}",
        ancillary=("elevation_spread", "point_count", "quality"),
    ),
    Variable(
        "elevation_change",
        RASTER,
        "f4",
        "elevation above the reference surface",
        "m",
        None,
        None,
        _MEAN,
        "mean height of the points above the reference surface, which is reference_elevation +"
        f" reference_mean_residual of reference.nc; {_QUANTUM}",
        ancillary=(
            "elevation_change_uncertainty",
            "elevation_change_systematic_uncertainty",
            "point_count",
            "quality",
        ),
    ),
    Variable(
        "elevation_change_uncertainty",
        RASTER,
        "f4",
        "uncertainty of the elevation change",
        "m",
        comment=f"{_ONE_SIGMA}, two digits or more; {SAFE_BOUND}; boxes.nc, blocks/ and station.variance are"
        " exact",
    ),
    Variable(
        "elevation_change_systematic_uncertainty",
        RASTER,
        "f4",
        "systematic uncertainty of the elevation change",
        "m",
        comment=f"{_ONE_SIGMA}, two digits; the part that cells of a scan share, which does not average out:"
        " the random uncertainty is sqrt(u^2 - s^2), where u is elevation_change_uncertainty and s this one",
    ),
    Variable(
        "elevation_change_random_uncertainty",
        RASTER,
        "f4",
        "random uncertainty of the elevation change",
        "m",
        comment=f"{_ONE_SIGMA}, two digits; the part that is independent between cells and averages out",
    ),
    Variable(
        "elevation_spread",
        RASTER,
        "f4",
        "standard deviation of the points in the cell",
        "m",
        None,
        3,
        "area: standard_deviation",
        "of cells with three points or more: that of two is uncertain by three quarters",
    ),
    Variable("point_count", RASTER, "i4", "number of laser points in the cell", "1", None, None, "area: sum"),
    Variable(
        "quality",
        RASTER,
        "i2",
        "quality flags of the cell",
        None,
        "quality_flag",
        flag_masks=tuple(int(flag) for flag in Quality),
        flag_meanings=" ".join(str(flag.name).lower() for flag in Quality),
    ),
    Variable("sigma_registration", RASTER, "f4", "uncertainty due to the registration", "m", None, 3),
    Variable("sigma_instrument", RASTER, "f4", "uncertainty due to the instrument", "m", None, 3),
    Variable("sigma_atmosphere", RASTER, "f4", "uncertainty due to the atmosphere", "m", None, 3),
    Variable("sigma_geometry", RASTER, "f4", "uncertainty due to the scanning geometry", "m", None, 3),
    Variable(
        "sigma_raster", RASTER, "f4", "uncertainty due to the point positions in the cell", "m", None, 3
    ),
    Variable(
        "sigma_voordendag2023",
        RASTER,
        "f4",
        "uncertainty according to Voordendag et al. (2023)",
        "m",
        None,
        3,
        None,
        "Eq. 1-2, for comparison: treats errors shared by all points as random",
    ),
    Variable(
        "sigma_hartzell2015",
        RASTER,
        "f4",
        "uncertainty according to Hartzell et al. (2015)",
        "m",
        None,
        3,
        None,
        "Eq. 9 and 12, for comparison: treats errors shared by all points as random",
    ),
    Variable(
        "shared_parameter",
        ("time", "parameter"),
        "f8",
        "estimate of the parameters shared by all points of the scan",
        None,
        comment="units in parameter_unit",
    ),
    Variable(
        "shared_parameter_covariance",
        ("time", "parameter", "parameter_2"),
        "f4",
        "covariance of the parameters shared by all points of the scan",
        None,
        comment="relative to the reference if adjustment is joint, otherwise of the scan alone;"
        " units are products of parameter_unit",
    ),
    Variable(
        "shared_parameter_line_tilt_variance",
        ("time", "parameter"),
        "f8",
        "variance of the tilt of each group of scan lines in excess of the parameter",
        None,
        comment="independent between groups of 0.2 degree each; units are squares of parameter_unit",
    ),
    Variable(
        "shared_parameter_redundancy",
        ("time", "parameter"),
        "f4",
        "share of the prior variance of each parameter that the scan removed",
        "1",
        None,
        3,
        comment="0: known from the prior only; 1: determined by ground, inclination log and weather",
    ),
    Variable(
        "change_errors",
        ("time", "parameter", "change_mode"),
        "f4",
        "errors of the shared parameters caused by the change of the moving ground",
        None,
        comment="part of shared_parameter_covariance, common to scans after similar change;"
        " each column is an independent mode of one standard deviation; units in parameter_unit",
    ),
    Variable(
        "change_pattern",
        ("time", "sector"),
        "f4",
        "change of the moving ground estimated by the adjustment, by sector around the scanner",
        "1",
        None,
        3,
        comment="divided by its standard deviation about the mean; sectors of 15 degree clockwise from north,"
        " 12 rings of 500 m each; the correlation of the patterns of two scans is that of change_errors",
    ),
    Variable("scan_id", TEXT, "S1", "name of the scan"),
    Variable(
        "verdict",
        ("time",),
        "i1",
        "quality of the epoch",
        None,
        "quality_flag",
        flag_values=tuple(range(len(VERDICTS))),
        flag_meanings=" ".join(VERDICTS),
    ),
    Variable("verdict_reason", ("time", "sentence"), "S1", "reason if the verdict is not good"),
    Variable("flag", ("time", "sentence"), "S1", "reason for which an operator excluded the epoch"),
    Variable("platform_roll", ("time",), "f8", "mean roll of the scanner from its sensor", "degree"),
    Variable("platform_pitch", ("time",), "f8", "mean pitch of the scanner from its sensor", "degree"),
    Variable("tilt_residual", ("time",), "f8", "noise of the filtered inclination log", "degree"),
    Variable("log_offset", ("time",), "f8", "clock offset of the inclination log, positive if late", "s"),
    Variable(
        "log_clock_offset",
        ("time",),
        "f8",
        "residual clock offset of the inclination log, positive if late, from the sway of the ground",
        "s",
    ),
    Variable(
        "log_clock_offset_uncertainty", ("time",), "f8", "one standard deviation of log_clock_offset", "s"
    ),
    Variable(
        "registration_rotation",
        ("time",),
        "f8",
        "angle of rotation between the registration of the scan by the owner and the adjustment",
        "degree",
    ),
    Variable(
        "registration_translation",
        ("time",),
        "f8",
        "distance between the scanner's positions by the registration of the owner and the adjustment",
        "m",
    ),
    Variable("air_temperature", ("time",), "f8", "air temperature at the scanner", "degC", "air_temperature"),
    Variable("air_pressure", ("time",), "f8", "air pressure at the scanner", "hPa", "air_pressure"),
    Variable(
        "relative_humidity",
        ("time",),
        "f8",
        "relative humidity at the scanner",
        "percent",
        "relative_humidity",
    ),
    Variable("point_total", ("time",), "f8", "number of points in the scan", "1"),
    Variable("position_count", ("time",), "f8", "number of scan positions, if there are several", "1"),
    Variable(
        "discarded_share",
        ("time",),
        "f8",
        "share of the points that are not used: not the last return, withheld, or classified as noise",
        "1",
    ),
    Variable(
        "rejected_echo_share",
        ("time",),
        "f8",
        "share of the points on the grid that are not of the surface of their cell",
        "1",
    ),
    Variable(
        "airborne_echo_share",
        ("time",),
        "f8",
        "share of the points on the grid that are echoes of the air",
        "1",
        comment="rejected echoes above the surface, less as many as there are below it, and chance",
    ),
    Variable("coverage", ("time",), "f8", "share of the grid's cells with points", "1"),
    Variable(
        "valid_count",
        ("time",),
        "f8",
        "number of cells with a value of elevation_change",
        "1",
        comment="as written; if elevation_change has another number, files that it is read from are missing",
    ),
    Variable("stable_count", ("time",), "f8", "number of hold-out cells of stable ground", "1"),
    Variable("stable_median", ("time",), "f8", "median change on hold-out stable ground", "m"),
    Variable(
        "stable_nmad",
        ("time",),
        "f8",
        "robust standard deviation of the change on hold-out stable ground",
        "m",
    ),
    Variable(
        "stable_z_std",
        ("time",),
        "f8",
        "robust standard deviation of the standardised change on hold-out stable ground",
        "1",
    ),
    Variable(
        "random_variance_factor",
        ("time",),
        "f8",
        "median factor by which the modelled random variance was multiplied, from residuals of this scan",
        "1",
        comment="stated over modelled; it differs by range, roughness and grazing angle",
    ),
    Variable(
        "systematic_variance_factor",
        ("time",),
        "f8",
        "factor by which the modelled variance of the shared parameters was multiplied, from residuals of"
        " blocks of stable ground of this scan",
        "1",
    ),
    Variable(
        "change_step",
        ("time",),
        "f8",
        "standard deviation of the change of the moving ground, as the adjustment finds it",
        "m",
    ),
    Variable(
        "adjustment_leverage_moving",
        ("time",),
        "f8",
        "variance of a cell of moving ground in the adjustment in excess of its random variance",
        "m2",
        comment="leverage of the noise of a cell in the estimate: v / (v + this variance), v being its random"
        " variance; noise that is also in the estimate is not counted twice",
    ),
    Variable(
        "adjustment_leverage_stable",
        ("time",),
        "f8",
        "variance of a cell of stable ground in the adjustment in excess of its random variance",
        "m2",
    ),
    Variable("scanner_east", ("time",), "f8", "easting of the scanner", "m"),
    Variable("scanner_north", ("time",), "f8", "northing of the scanner", "m"),
    Variable("scanner_height", ("time",), "f8", "height of the scanner", "m"),
    Variable("scanner_axis_east", ("time",), "f8", "east component of the axis of the scan head", "1"),
    Variable("scanner_axis_north", ("time",), "f8", "north component of the axis of the scan head", "1"),
    Variable("scan_sha256", TEXT, "S1", "SHA-256 of the scan file"),
    Variable("log_sha256", TEXT, "S1", "SHA-256 of the inclination log"),
    Variable("registration_sha256", TEXT, "S1", "SHA-256 of the registration of the scan by the owner"),
    Variable("adjustment", TEXT, "S1", "method of the pose estimate: joint, or none (filtered log only)"),
    Variable("sop_id", TEXT, "S1", "scanner orientation and position used"),
    Variable(
        "sop_tilt_offset",
        ("time", "sentence"),
        "S1",
        "tilt contained in the SOP, as a wave over one rotation",
    ),
    Variable("science_hash", TEXT, "S1", "hash of the settings that affect results"),
    Variable("reference_version", TEXT, "S1", "version of the reference surface"),
    Variable("software_version", TEXT, "S1", "version of the software"),
    Variable("epoch_file", TEXT, "S1", "name of the original epoch file"),
)

BY_NAME = {variable.name: variable for variable in VARIABLES}
TEXT_LENGTH = {"text": 64, "sentence": 256}
CHANGE_LENGTH = {"change_mode": MODES, "sector": SECTORS}
TERMS = (
    "sigma_registration",
    "sigma_instrument",
    "sigma_atmosphere",
    "sigma_geometry",
    "sigma_raster",
    "sigma_voordendag2023",
    "sigma_hartzell2015",
)
