"""Every variable of the store: one table, one row each."""

from __future__ import annotations

from dataclasses import dataclass

from station.quantities import Quality
from station.science.likeness import MODES, SECTORS

FILL = 9.96921e36  # netCDF's own fill for floats: NCO averages NaN to nothing
VERDICTS = ("good", "degraded", "unusable")

RASTER = ("time", "y", "x")
TEXT = ("time", "text")


@dataclass(frozen=True)
class Variable:
    """A row of the table. `digits`: decimals kept, as powers of two (3: 1/1024)."""

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

    @property
    def is_raster(self) -> bool:
        """Whether it lies on the grid."""
        return self.dims[-2:] == ("y", "x")

    @property
    def is_heavy(self) -> bool:
        """Whether the series points to it in the epochs instead of holding a copy."""
        return len(self.dims) > 2


_MEAN = "area: mean"
_ONE_SIGMA = "one standard deviation, of a single cell"

VARIABLES: tuple[Variable, ...] = (
    Variable(
        "elevation",
        RASTER,
        "f4",
        "elevation of the surface, mean of the cell",
        "m",
        "surface_altitude",
        3,
        _MEAN,
    ),
    Variable(
        "elevation_change",
        RASTER,
        "f4",
        "elevation above the reference surface",
        "m",
        None,
        3,
        _MEAN,
        "mean of the points' heights above the reference surface of reference.nc",
    ),
    Variable(
        "elevation_change_uncertainty",
        RASTER,
        "f4",
        "uncertainty of the elevation change",
        "m",
        None,
        4,
        None,
        f"{_ONE_SIGMA}; do not average it: the part shared by all cells does not shrink",
    ),
    Variable(
        "elevation_change_random_uncertainty",
        RASTER,
        "f4",
        "random uncertainty of the elevation change",
        "m",
        None,
        4,
        None,
        f"{_ONE_SIGMA}; the part that is independent from cell to cell and averages out",
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
    ),
    Variable("point_count", RASTER, "i4", "number of laser points in the cell", "1", None, None, "area: sum"),
    Variable(
        "quality",
        RASTER,
        "i2",
        "what to know of a cell before using it",
        None,
        "quality_flag",
        flag_masks=tuple(int(flag) for flag in Quality),
        flag_meanings=" ".join(str(flag.name).lower() for flag in Quality),
    ),
    Variable("sigma_registration", RASTER, "f4", "uncertainty from the registration", "m", None, 3),
    Variable("sigma_instrument", RASTER, "f4", "uncertainty from the instrument", "m", None, 3),
    Variable("sigma_atmosphere", RASTER, "f4", "uncertainty from the atmosphere", "m", None, 3),
    Variable("sigma_geometry", RASTER, "f4", "uncertainty from the scanning geometry", "m", None, 3),
    Variable("sigma_raster", RASTER, "f4", "uncertainty from the points' place in the cell", "m", None, 3),
    Variable(
        "sigma_voordendag2023",
        RASTER,
        "f4",
        "uncertainty as Voordendag et al. (2023) state it",
        "m",
        None,
        3,
        None,
        "Eq. 1-2, for comparison: takes what all points share for random",
    ),
    Variable(
        "sigma_hartzell2015",
        RASTER,
        "f4",
        "uncertainty as Hartzell et al. (2015) state it",
        "m",
        None,
        3,
        None,
        "Eq. 9 and 12, for comparison: takes what all points share for random",
    ),
    Variable(
        "shared_parameter",
        ("time", "parameter"),
        "f8",
        "estimate of what all points of the scan share",
        None,
        comment="units in parameter_unit",
    ),
    Variable(
        "shared_parameter_covariance",
        ("time", "parameter", "parameter_2"),
        "f4",
        "covariance of what all points of the scan share",
        None,
        comment="against the reference where adjustment is joint, else of the scan alone;"
        " units are products of parameter_unit",
    ),
    Variable(
        "shared_parameter_noise_variance",
        ("time", "parameter"),
        "f8",
        "variance of the lean of each group of scan lines beyond the parameter",
        None,
        comment="independent from group to group, of 0.2 degree each; units are squares of parameter_unit",
    ),
    Variable(
        "change_errors",
        ("time", "parameter", "change_mode"),
        "f4",
        "errors of the shared parameters that the change of the moving ground makes",
        None,
        comment="part of shared_parameter_covariance, which scans after like change have in common;"
        " a column is one standard deviation, independent of the others; units in parameter_unit",
    ),
    Variable(
        "change_pattern",
        ("time", "sector"),
        "f4",
        "change of the moving ground that the adjustment found, by sector round the scanner",
        "1",
        None,
        3,
        comment="over change_step; sectors of 15 degree clockwise from north, in each 12 rings of 500 m;"
        " how alike those of two scans are says how far they have change_errors in common",
    ),
    Variable("scan_id", TEXT, "S1", "name of the scan"),
    Variable(
        "verdict",
        ("time",),
        "i1",
        "how good the epoch is",
        None,
        "quality_flag",
        flag_values=tuple(range(len(VERDICTS))),
        flag_meanings=" ".join(VERDICTS),
    ),
    Variable("verdict_reason", ("time", "sentence"), "S1", "why the verdict is not good"),
    Variable("flag", ("time", "sentence"), "S1", "why a person says that the epoch is not to be used"),
    Variable("platform_roll", ("time",), "f8", "mean roll of the scanner by its sensor", "degree"),
    Variable("platform_pitch", ("time",), "f8", "mean pitch of the scanner by its sensor", "degree"),
    Variable("tilt_residual", ("time",), "f8", "noise of the filtered inclination log", "degree"),
    Variable("log_offset", ("time",), "f8", "how late the clock of the inclination log was", "s"),
    Variable("log_lateness", ("time",), "f8", "how late it still was, by how the ground swayed", "s"),
    Variable("log_lateness_uncertainty", ("time",), "f8", "one standard deviation of log_lateness", "s"),
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
    Variable("coverage", ("time",), "f8", "share of the grid's cells with points", "1"),
    Variable("stable_count", ("time",), "f8", "number of cells of stable ground withheld from the fit", "1"),
    Variable("stable_median", ("time",), "f8", "median change on withheld stable ground", "m"),
    Variable(
        "stable_nmad",
        ("time",),
        "f8",
        "robust standard deviation of the change on withheld stable ground",
        "m",
    ),
    Variable(
        "stable_z_std",
        ("time",),
        "f8",
        "robust standard deviation of change over its sigma on withheld stable ground",
        "1",
    ),
    Variable(
        "change_step", ("time",), "f8", "change of the moving ground that the adjustment allowed for", "m"
    ),
    Variable(
        "adjustment_slack_moving",
        ("time",),
        "f8",
        "variance given to a cell of moving ground beyond its random one",
        "m2",
        comment="with the share v / (v + slack) of its noise it held the scan, v being its random variance:"
        " noise that is in the estimate too does not add to it",
    ),
    Variable(
        "adjustment_slack_stable",
        ("time",),
        "f8",
        "variance given to a cell of stable ground beyond its random one",
        "m2",
    ),
    Variable("scanner_east", ("time",), "f8", "easting of the scanner", "m"),
    Variable("scanner_north", ("time",), "f8", "northing of the scanner", "m"),
    Variable("scanner_height", ("time",), "f8", "height of the scanner", "m"),
    Variable("scanner_axis_east", ("time",), "f8", "east component of the axis the head turns about", "1"),
    Variable("scanner_axis_north", ("time",), "f8", "north component of the axis the head turns about", "1"),
    Variable("scan_sha256", TEXT, "S1", "SHA-256 of the scan file"),
    Variable("log_sha256", TEXT, "S1", "SHA-256 of the inclination log"),
    Variable("adjustment", TEXT, "S1", "how the pose was found: joint, or none (filtered log only)"),
    Variable("sop_id", TEXT, "S1", "scanner orientation and position used"),
    Variable("lean_zero", ("time", "sentence"), "S1", "lean that the SOP holds, as a wave over one turn"),
    Variable("science_hash", TEXT, "S1", "identifier of the settings that change numbers"),
    Variable("reference_version", TEXT, "S1", "version of the reference surface"),
    Variable("software_version", TEXT, "S1", "version of the software"),
    Variable("epoch_file", TEXT, "S1", "file the epoch was first written to"),
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
