"""Every number of the papers that can be computed: one table, one row each.

The tests and `station papers` read the same rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Air, Floats, Grid, Reference, Scanner
from station.scanners import SCANNERS
from station.science import (
    air,
    beam,
    inclination,
    mobile,
    precision,
    sensitivity,
    terrain,
    uncertainty,
    volume,
)


@dataclass(frozen=True)
class Figure:
    """A number of a paper.

    `printed` is what the paper says, None where it prints none; `right` what an independent computation
    gives; `told` what this program gives. `error` says what the paper has otherwise, and why.
    """

    paper: str
    equation: str
    what: str
    unit: str
    printed: float | None
    right: float
    tolerance: float  # of `told` against `right`
    told: Callable[[], float]
    error: str = ""


def _seen(range_m: float, incidence_deg: float, slope_deg: float) -> tuple[Floats, Floats, Floats]:
    return (
        np.array([range_m]),
        np.cos(np.radians(np.array([incidence_deg]))),
        np.cos(np.radians(np.array([slope_deg]))),
    )


def _one(values: Floats) -> float:
    return float(np.ravel(values)[0])


# Voordendag et al. (2023): VZ-6000, 0.12 mrad, the scanner's setting -2 °C, 684 hPa, 28 %.
IHE = Air(temperature_c=-2.0, pressure_hpa=684.0, humidity_pct=28.0)
_V = SCANNERS["riegl-vz-6000"]
_DIVERGENCE = _V["beam_divergence_mrad"] * 1e-3
BOX_1, BOX_5 = (1299.0, 72.0), (3421.0, 65.0)  # range [m] and incidence [°] in Table 2


def _tilt(range_m: float, tilt_deg: float = 0.008) -> float:
    return _one(uncertainty.sigma_instrument(np.array([range_m]), math.radians(tilt_deg)))


def _axes(box: tuple[float, float]) -> tuple[float, float]:
    major_m, minor_m = beam.footprint_axes(np.array([box[0]]), np.radians(np.array([box[1]])), _DIVERGENCE)
    return _one(major_m), _one(minor_m)


def _ellipse(box: tuple[float, float]) -> float:
    return _one(beam.footprint_area(*(np.array([axis]) for axis in _axes(box))))


def _refractivity(vapour: Air = IHE, wavelength_um: float = _V["wavelength_um"]) -> float:
    pressure_hpa = air.vapour_pressure(vapour.temperature_c, vapour.humidity_pct)
    return _one(
        air.group_refractivity(vapour.temperature_c, vapour.pressure_hpa, pressure_hpa, wavelength_um)
    )


def _warmer(kelvin: float, *, range_m: float = 3414.0) -> float:
    real = Air(IHE.temperature_c + kelvin, IHE.pressure_hpa, IHE.humidity_pct)
    correction = air.air_correction(real, IHE, _V["wavelength_um"])
    return 1e3 * range_m * (_one(correction.range_scale(np.array([0.0]))) - 1)


def _by_time_of_flight(kelvin: float, *, range_m: float = 3414.0) -> float:
    """Range error of air so much warmer than assumed, from the time that the echo takes [mm]."""
    real = Air(IHE.temperature_c + kelvin, IHE.pressure_hpa, IHE.humidity_pct)
    echo_s = range_m / _one(air.slope_range(1.0, _refractivity()))
    return 1e3 * (_one(air.slope_range(echo_s, _refractivity(real))) - range_m)


def _heavier(hpa: float, range_m: float = 3414.0) -> float:
    real = Air(IHE.temperature_c, IHE.pressure_hpa + hpa, IHE.humidity_pct)
    correction = air.air_correction(real, IHE, _V["wavelength_um"])
    return 1e3 * range_m * (_one(correction.range_scale(np.array([0.0]))) - 1)


def _below(rise_m: float) -> float:
    scale = air.air_correction(IHE, IHE, _V["wavelength_um"]).range_scale(np.array([rise_m, 0.0]))
    return 1e6 * float(scale[0] - scale[1])


def _off_by_origin(range_m: float, up_m: float) -> float:
    """By what a level shot from above the centre of the frame seems raised if that is dropped [0.001°]."""
    level = np.array([0.0])
    point_m = beam.cartesian(np.array([range_m]), level, level, (0.0, 0.0, up_m))
    return 1e3 * math.degrees(_one(beam.polar(point_m)[1]))


def _geometry(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    seen = _seen(range_m, incidence_deg, slope_deg)
    return _one(uncertainty.sigma_geometry(*seen, np.array([0.0]), _DIVERGENCE))


def _geometry_of_a_plane(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    seen = _seen(range_m, incidence_deg, slope_deg)
    return math.sqrt(_one(uncertainty.angle_variance(*seen, beam.sigma_beam_angle(_DIVERGENCE))))


def _density(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    return _one(beam.point_density(*_seen(range_m, incidence_deg, slope_deg), math.radians(0.01)))


def _cell(range_m: float, incidence_deg: float, slope_deg: float, points: float) -> float:
    seen = _seen(range_m, incidence_deg, slope_deg)
    scanner = Scanner(
        model="riegl-vz-6000",
        wavelength_um=_V["wavelength_um"],
        beam_divergence_rad=_DIVERGENCE,
        exit_diameter_m=_V["exit_diameter_m"],
        range_sigma_m=_V["range_sigma_m"],
        angle_resolution_rad=math.radians(_V["angle_resolution_deg"]),
        inclination_sigma_rad=math.radians(_V["inclination_sigma_deg"]),
        inclination_range_rad=math.radians(_V["inclination_range_deg"]),
        range_max_m=_V["range_max_m"],
    )
    variance_m2 = uncertainty.shot_variance_voordendag(*seen, np.array([0.0]), scanner)
    return math.sqrt(_one(variance_m2) / points)


def _nanometres() -> float:
    """Return how wrong the refractivity is with the wavelength in nm instead of µm [ppm]."""
    return _refractivity() - _refractivity(wavelength_um=_V["wavelength_um"] * 1e3)


VOORDENDAG = "voordendag2023"
_FORGOTTEN = "text says 800-4500 m; 0.09-0.64 m are 645-4584 m"
_AXIS = "the column 'footprint area (m²)' is the major axis in m"
_LES = "with temperatures of the LES along the path, which are not published"

VOORDENDAG_FIGURES = (
    Figure(VOORDENDAG, "Eq. 4", "elevation of a shot from 0.1 m over the frame's centre, 100 m", "0.001°", None,
           57.30, 0.01, lambda: _off_by_origin(100, 0.1)),
    Figure(VOORDENDAG, "Eq. 4", "elevation of a shot from 0.1 m over the frame's centre, 3421 m", "0.001°", None,
           1.675, 1e-3, lambda: _off_by_origin(3421, 0.1)),
    Figure(VOORDENDAG, "Eq. 5", "σ of the instrument at 650 m", "m", 0.09, 0.0908, 1e-4, lambda: _tilt(650)),
    Figure(VOORDENDAG, "Eq. 5", "σ of the instrument at 800 m", "m", 0.09, 0.1117, 1e-4, lambda: _tilt(800),
           _FORGOTTEN),
    Figure(VOORDENDAG, "Eq. 5", "σ of the instrument at 3421 m", "m", None, 0.4777, 1e-4, lambda: _tilt(3421)),
    Figure(VOORDENDAG, "Eq. 5", "σ of the instrument at 4500 m", "m", 0.64, 0.6283, 1e-4, lambda: _tilt(4500),
           _FORGOTTEN),
    Figure(VOORDENDAG, "Eq. 5", "σ of the instrument at 4584 m", "m", 0.64, 0.6400, 1e-4, lambda: _tilt(4584)),
    Figure(VOORDENDAG, "Eq. 15", "major axis of the footprint, box 1", "m", 0.50, 0.504, 1e-3,
           lambda: _axes(BOX_1)[0]),
    Figure(VOORDENDAG, "Eq. 15", "major axis of the footprint, box 5", "m", 1.01, 0.971, 1e-3,
           lambda: _axes(BOX_5)[0], "1/cos of the mean incidence; the paper's mean is over the box"),
    Figure(VOORDENDAG, "Eq. 17", "area of the footprint, box 1", "m²", 0.50, 0.0617, 1e-4,
           lambda: _ellipse(BOX_1), _AXIS),
    Figure(VOORDENDAG, "Eq. 17", "π M m of box 1, as the equation is printed", "m²", 0.50, 0.247, 1e-3,
           lambda: math.pi * math.prod(_axes(BOX_1)), f"{_AXIS}; and full axes need π/4"),
    Figure(VOORDENDAG, "Eq. 7", "standard group refractivity at 1.064 µm", "ppm", None, 291.98498, 1e-5,
           lambda: air.standard_group_refractivity(1.064)),
    Figure(VOORDENDAG, "Eq. 7", "standard group refractivity at 1.55 µm", "ppm", None, 289.66125, 1e-5,
           lambda: air.standard_group_refractivity(1.55)),
    Figure(VOORDENDAG, "Eq. 7-8", "error of taking the wavelength in nm", "ppm", None, 2.97, 0.01, _nanometres),
    Figure(VOORDENDAG, "Eq. 8", "group refractivity at -2 °C, 684 hPa, 28 %, by IUGG (1999)", "ppm", None,
           198.4985, 1e-3, _refractivity),
    Figure(VOORDENDAG, "Eq. 8", "the same by Ciddor (1996)", "ppm", None, 198.458, 0.05, _refractivity),
    Figure(VOORDENDAG, "Eq. 10", "range error at 3414 m, 10 K warmer all along", "mm", 21.0, 24.3, 0.2,
           lambda: _warmer(10), _LES),
    Figure(VOORDENDAG, "Eq. 10", "range error at 3414 m, 10 K colder all along", "mm", -42.4, -26.1, 0.2,
           lambda: _warmer(-10), _LES),
    Figure(VOORDENDAG, "Eq. 6", "the same, warmer, from the time of flight", "mm", 21.0, 24.3, 0.2,
           lambda: _by_time_of_flight(10), _LES),
    Figure(VOORDENDAG, "Eq. 10", "range error at 3414 m, 10 hPa more", "mm", None, -9.9, 0.1,
           lambda: _heavier(10), "said to be of no significant influence; it is 40 % of that of 10 K"),
    Figure(VOORDENDAG, "Eq. 10", "range error 500 m below the scanner, the same weather", "ppm", None, -5.1, 0.1,
           lambda: _below(-500)),
    Figure(VOORDENDAG, "Eq. 5", "tilt that is ±0.47 m at 3421 m", "m", 0.47, 0.4717, 1e-3,
           lambda: _tilt(3421, 0.0079)),
    Figure(VOORDENDAG, "Eq. 5", "tilt that is ±0.62 m at 3421 m", "m", 0.62, 0.6210, 1e-3,
           lambda: _tilt(3421, 0.0104)),
    Figure(VOORDENDAG, "section 3", "points per m² at 0.01°, box 1", "1/m²", None, 6.0, 0.1,
           lambda: _density(*BOX_1, 0.0)),
    Figure(VOORDENDAG, "section 3", "points per m² at 0.01°, box 5", "1/m²", None, 1.3, 0.1,
           lambda: _density(*BOX_5, 25.0)),
    Figure(VOORDENDAG, "Eq. 11", "height error of k wrong by 0.1 at 3421 m", "m", None, 0.092, 1e-3,
           lambda: _one(air.refraction_rise(np.array([3421.0**2]), 0.1)),
           "refraction is neglected as within the footprint; but it is common to neighbouring shots"),
    Figure(VOORDENDAG, "Eq. 11", "height error of k wrong by 0.1 at 4500 m", "m", None, 0.159, 1e-3,
           lambda: _one(air.refraction_rise(np.array([4500.0**2]), 0.1)), "as above"),
    Figure(VOORDENDAG, "Eq. 18", "σ of the geometry at 3421 m, 65°, slope 25°", "m", None, 0.137, 1e-3,
           lambda: _geometry(*BOX_5, 25.0)),
    Figure(VOORDENDAG, "Eq. 18", "σ of the geometry at 4500 m, 70°, slope 20°", "m", None, 0.18, 0.01,
           lambda: _geometry(4500, 70, 20)),
    Figure(VOORDENDAG, "Eq. 18", "the same from the Gaussian beam, 3421 m, 65°, slope 25°", "m", None, 0.103, 1e-3,
           lambda: _geometry_of_a_plane(*BOX_5, 25.0)),
    Figure(VOORDENDAG, "section 3", "points per m² at 0.01°, 650 m, 57°, slope 40°", "1/m²", None, 55.2, 0.2,
           lambda: _density(650, 57, 40)),
    Figure(VOORDENDAG, "Eq. 1-2", "σ of a cell of 56 points at 650 m, 57°, slope 40°", "m", 0.012, 0.0125, 5e-4,
           lambda: _cell(650, 57, 40, 56)),
)  # fmt: skip


# Hartzell et al. (2015): VZ-4000 and LMS-Z390i.
HARTZELL = "hartzell2015"
_H = SCANNERS["riegl-vz-4000"]


def _vz4000(elevation_deg: float, *, wide: bool, vertical: bool) -> float:
    resolution = beam.sigma_resolution(math.radians(_H["angle_resolution_deg"]))
    angle = math.hypot(resolution, beam.sigma_beam_angle(_H["beam_divergence_mrad"] * 1e-3) if wide else 0.0)
    jacobian = beam.polar_jacobian(np.array([500.0]), np.radians(np.array([elevation_deg])), np.array([0.3]))
    covariance = beam.point_covariance(jacobian, np.array([[_H["range_sigma_m"], angle, angle]]))
    return 1e3 * (math.sqrt(covariance[0, 2, 2]) if vertical else _one(beam.error_ellipse(covariance)[0]))


def _widening(elevation_deg: float, *, vertical: bool) -> float:
    with_beam, without = (_vz4000(elevation_deg, wide=wide, vertical=vertical) for wide in (True, False))
    return with_beam / without


def _net_volume(cell_m: float, side: tuple[int, int], times: float, sigmas_m: tuple[float, float]) -> float:
    """Sigma of the net volume of `times` fields of cells with one point each, on and off the snow [m³]."""
    grid = Grid(0.0, side[0] * cell_m, cell_m, side[1], side[0])
    east_m, north_m = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    level = terrain.ground(Reference.given(grid, "level", np.zeros(grid.shape)))
    points_m = np.stack([east_m, north_m, 0 * east_m + 1], axis=-1)
    field = volume.raster(points_m, level, np.ones(side, bool))
    gross_m6 = (
        times
        * volume.independent_variance(field, np.broadcast_to(sigma_m**2 * np.eye(3), (len(east_m), 3, 3)))
        for sigma_m in sigmas_m
    )
    return math.sqrt(volume.net_variance(*gross_m6))


_DOUBLES = "'roughly doubles' holds for the horizontal error only"

HARTZELL_FIGURES = (
    Figure(HARTZELL, "Fig. 7", "χ² of the 68.3 % ellipse", "1", 2.298, 2.2977, 1e-4,
           lambda: _one(beam.error_ellipse(np.eye(3)[None])[0]) ** 2),
    Figure(HARTZELL, "Table 1", "diameter of the VZ-4000's beam at 500 m", "m", None, 0.093, 1e-6,
           lambda: _one(beam.diameter(np.array([500.0]), _H["beam_divergence_mrad"] * 1e-3, _H["exit_diameter_m"]))),
    Figure(HARTZELL, "Eq. 7", "angle from the beam's width, VZ-4000", "µrad", None, 37.5, 1e-9,
           lambda: 1e6 * beam.sigma_beam_angle(_H["beam_divergence_mrad"] * 1e-3)),
    Figure(HARTZELL, "section 2.3", "angle from the resolution of 0.0005°", "µrad", None, 2.52, 0.01,
           lambda: 1e6 * beam.sigma_resolution(math.radians(0.0005))),
    *(
        Figure(HARTZELL, "Fig. 7", f"{name} error at 500 m, {elevation}°, {'with' if wide else 'without'} beam",
               "mm", None, right, 0.15,
               lambda e=elevation, w=wide, v=vertical: _vz4000(e, wide=w, vertical=v))  # type: ignore[misc]
        for name, vertical, elevation, wide, right in (
            ("horizontal", False, 0, False, 15.2), ("horizontal", False, 0, True, 28.5),
            ("vertical", True, 0, False, 1.3), ("vertical", True, 0, True, 18.8),
            ("vertical", True, 40, False, 6.5), ("vertical", True, 40, True, 15.8),
        )
    ),
    Figure(HARTZELL, "Fig. 7", "by what the beam widens the horizontal error, level", "1", 2.0, 1.88, 0.02,
           lambda: _widening(0, vertical=False)),
    Figure(HARTZELL, "Fig. 7", "by what the beam widens the vertical error, level", "1", 2.0, 14.9, 0.2,
           lambda: _widening(0, vertical=True), _DOUBLES),
    Figure(HARTZELL, "Fig. 7", "by what the beam widens the vertical error, at 40°", "1", 2.0, 2.43, 0.05,
           lambda: _widening(40, vertical=True), _DOUBLES),
    Figure(HARTZELL, "Table 2", "σ of the net volume, raster, Montezuma, of cells of 22.2 and 12.3 mm", "m³", 4.743,
           4.743, 0.05, lambda: _net_volume(0.5, (70, 80), 100, (0.0222, 0.0123)),
           "from the cells' σ that it implies, each cell's own; what points share is 150 to 280 times as much"),
    Figure(HARTZELL, "Table 2", "σ of the net volume, raster, Mammoth, of cells of 2.6 and 1.6 mm", "m³", 0.0182,
           0.0182, 2e-4, lambda: _net_volume(0.25, (80, 112), 1, (0.0026, 0.0016)), "as above"),
    Figure(HARTZELL, "section 2.2", "σ of the inclination once filtered, of 0.006° a sample", "0.001°", 6.0, 0.79,
           0.02, lambda: 6.0 * math.sqrt(float(np.sum(inclination.blackman(101) ** 2))),
           "0.006° is of one sample; the filtered signal is better, and what is left is common to all points"),
)  # fmt: skip


# Ozendi et al. (2016): FARO X330.
OZENDI = "ozendi2016"
_STEP = "different spots are compared: that of the step is step/√12, not the encoder's"


def _sampling_cc(step_cc: float) -> float:
    return beam.sigma_resolution(step_cc * precision.CC_RAD) / precision.CC_RAD


def _more_than_residual_pct(incidence_deg: float) -> float:
    return 100 * (_one(precision.sigma_range(np.array([1.0]), np.cos(np.radians([incidence_deg])))) - 1)


OZENDI_FIGURES = (
    Figure(OZENDI, "Table 1", "36.6cc of the horizontal angle", "0.001°", None, 3.294, 1e-3,
           lambda: 1e3 * math.degrees(36.6 * precision.CC_RAD)),
    Figure(OZENDI, "Table 1", "36.6cc of the horizontal angle", "µrad", None, 57.5, 0.05,
           lambda: 1e6 * 36.6 * precision.CC_RAD),
    Figure(OZENDI, "Table 1", "17.8cc of the vertical angle", "0.001°", None, 1.602, 1e-3,
           lambda: 1e3 * math.degrees(17.8 * precision.CC_RAD)),
    Figure(OZENDI, "Table 1", "17.8cc of the vertical angle", "µrad", None, 28.0, 0.05,
           lambda: 1e6 * 17.8 * precision.CC_RAD),
    Figure(OZENDI, "Table 1", "scatter from sampling alone at a step of 200cc", "cc", 36.6, 57.7, 0.1,
           lambda: _sampling_cc(200), _STEP),
    Figure(OZENDI, "Table 1", "scatter from sampling alone at a step of 400cc", "cc", 59.8, 115.5, 0.1,
           lambda: _sampling_cc(400), _STEP),
    Figure(OZENDI, "Table 1", "scatter from sampling alone at a step of 800cc", "cc", 154.0, 230.9, 0.1,
           lambda: _sampling_cc(800), _STEP),
    Figure(OZENDI, "section 4", "σ of the range above the residual across a plane at 30°", "%", None, 15.5, 0.1,
           lambda: _more_than_residual_pct(30), "the paper does not divide by cos α"),
    Figure(OZENDI, "section 4", "σ of the range above the residual across a plane at 45°", "%", None, 41.4, 0.1,
           lambda: _more_than_residual_pct(45), "the paper does not divide by cos α"),
)  # fmt: skip


# Leslar et al. (2014): a lidar on a vehicle, Table 1, "expected".
LESLAR = "leslar2014"


def _share(variable: str, range_m: float) -> float:
    at, sigma = mobile.abeam(range_m), mobile.sigmas(mobile.EXPECTED)
    _, shares = sensitivity.propagated(mobile.height, at, sigma)
    return 100 * float(shares[mobile.VARIABLES.index(variable)])


def _sobol(variable: str, range_m: float, *, total: bool) -> float:
    at, sigma = mobile.abeam(range_m), mobile.sigmas(mobile.EXPECTED)
    of = np.array([name == variable for name in mobile.VARIABLES])
    found = sensitivity.sobol(mobile.height, sensitivity.independent(sigma, at), [of, ~of])
    return 100 * float((found.total if total else found.first)[0])


def _third_order(*, printed: bool) -> float:
    """Index of third order of x y z, each as unsure as large, by simulation [%]."""
    ones = np.ones(3)
    each = [np.arange(3) == one for one in range(3)]
    found = sensitivity.interactions(
        lambda x: np.prod(x, axis=0), sensitivity.independent(ones, ones), each, 32_768
    )
    return 100 * sum(share for of, (share, _) in found.items() if len(of) > (1 if printed else 2))


def _of_three(order: int) -> float:
    """Index of the mobile lidar's height by interaction of so many of its largest inputs, 100 m away [%]."""
    at, sigma = mobile.abeam(100.0), mobile.sigmas(mobile.EXPECTED)
    largest = ("boresight_x", "lever_z", "vertical_angle")[:order]
    groups = [np.array([name == one for name in mobile.VARIABLES]) for one in largest]
    found = sensitivity.interactions(mobile.height, sensitivity.independent(sigma, at), groups)
    return 100 * found[tuple(range(order))][0]


LESLAR_FIGURES = (
    Figure(LESLAR, "Eq. 6-7", "share of the lever arm's Z in the height, 2 m away", "%", 90.0, 89.0, 1.0,
           lambda: _share("lever_z", 2.0)),
    Figure(LESLAR, "Eq. 6-7", "share of the INS's height, 2 m away", "%", 12.0, 10.9, 0.5,
           lambda: _share("x", 2.0)),
    Figure(LESLAR, "Eq. 6-7", "share of the boresight roll in the height, 100 m away", "%", 70.0, 69.2, 0.5,
           lambda: _share("boresight_x", 100.0)),
    Figure(LESLAR, "Eq. 10", "first Sobol index of the boresight roll, 100 m away", "%", 70.0, 69.2, 5.0,
           lambda: _sobol("boresight_x", 100.0, total=False)),
    Figure(LESLAR, "Eq. 12", "total Sobol index of the boresight roll, 100 m away", "%", 70.0, 69.2, 5.0,
           lambda: _sobol("boresight_x", 100.0, total=True)),
    Figure(LESLAR, "Eq. 11", "index of third order of x y z, each as unsure as large", "%", None, 14.3, 2.0,
           lambda: _third_order(printed=False)),
    Figure(LESLAR, "Eq. 11", "the same with first-order terms alone taken off, as printed", "%", None, 57.1, 4.0,
           lambda: _third_order(printed=True), "the pairs are left in: the indices add up to more than all"),
    Figure(LESLAR, "Eq. 11", "index of boresight roll, lever Z and vertical angle, 100 m away", "%", None, 0.0, 3.0,
           lambda: _of_three(3)),
    Figure(LESLAR, "Eq. 11", "subsets of 9 of the 18 variables", "1", 48620, 48620, 0.0,
           lambda: float(math.comb(len(mobile.VARIABLES), 9))),
)  # fmt: skip

FIGURES = (*HARTZELL_FIGURES, *VOORDENDAG_FIGURES, *OZENDI_FIGURES, *LESLAR_FIGURES)
