"""Numbers of the papers that can be computed, one row each, for `station papers` and for the tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from station.papers import mobile_lidar
from station.quantities import Air, Bools, Floats, Grid, Reference, Scanner
from station.scanners import SCANNERS
from station.science.analysis import precision, sensitivity, volume
from station.science.geometry import air, beam, inclination, registration, terrain
from station.science.uncertainty import shot_noise
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import parameter_layout
from station.science.uncertainty.propagation import aggregate_variance, to_shared_parameters


@dataclass(frozen=True)
class PaperNumber:
    """A number of a paper.

    `printed` is the value in the paper, None if it prints none; `expected` that of an independent
    computation; `computed` returns that of this program. `note` explains a difference between the printed and
    the expected value. `is_check` is False if the row cannot disagree: it converts a unit, or its inputs were
    chosen to give the printed value.
    """

    paper: str
    equation: str
    what: str
    unit: str
    printed: float | None
    expected: float
    tolerance: float  # of `computed` from `expected`
    computed: Callable[[], float]
    note: str = ""
    is_check: bool = True


def _viewing(range_m: float, incidence_deg: float, slope_deg: float) -> tuple[Floats, Floats, Floats]:
    return (
        np.array([range_m]),
        np.cos(np.radians(np.array([incidence_deg]))),
        np.cos(np.radians(np.array([slope_deg]))),
    )


def _scalar(values: Floats) -> float:
    return float(np.ravel(values)[0])


# Voordendag et al. (2023): VZ-6000, 0.12 mrad, the scanner's setting -2 °C, 684 hPa, 28 %.
IHE = Air(temperature_c=-2.0, pressure_hpa=684.0, humidity_pct=28.0)
_V = SCANNERS["riegl-vz-6000"]
_DIVERGENCE = _V["beam_divergence_mrad"] * 1e-3
# Table 2: range [m], mean incidence [°] and "footprint area" [m] of the boxes, and the independent M = R β / cos θ [m].
BOXES = {
    1: (1298.0, 72.0, 0.50, 0.5041), 2: (1314.0, 71.0, 0.49, 0.4843), 3: (1724.0, 65.0, 0.56, 0.4895),
    4: (2536.0, 73.0, 1.33, 1.0409), 5: (3421.0, 65.0, 1.01, 0.9714), 6: (1510.0, 50.0, 0.28, 0.2819),
    7: (1623.0, 73.0, 0.67, 0.6661), 8: (2141.0, 76.0, 1.08, 1.0620), 9: (1681.0, 74.0, 0.80, 0.7318),
    10: (2939.0, 63.0, 0.80, 0.7768), 11: (1367.0, 72.0, 0.54, 0.5308), 12: (1133.0, 70.0, 0.40, 0.3975),
    13: (1025.0, 68.0, 0.33, 0.3283), 14: (1750.0, 55.0, 0.41, 0.3661), 15: (2122.0, 66.0, 0.63, 0.6261),
    16: (2202.0, 72.0, 0.87, 0.8551), 17: (2586.0, 61.0, 0.66, 0.6401), 18: (3248.0, 61.0, 0.81, 0.8039),
    19: (2114.0, 52.0, 0.42, 0.4120), 20: (1557.0, 75.0, 1.69, 0.7219),
}  # fmt: skip
BOX_1, BOX_5 = BOXES[1][:2], BOXES[5][:2]


def _tilt(range_m: float, tilt_deg: float = 0.008) -> float:
    return _scalar(shot_noise.sigma_instrument(np.array([range_m]), math.radians(tilt_deg)))


def _axes(box: tuple[float, float]) -> tuple[float, float]:
    major_m, minor_m = beam.footprint_axes(np.array([box[0]]), np.radians(np.array([box[1]])), _DIVERGENCE)
    return _scalar(major_m), _scalar(minor_m)


def _ellipse(box: tuple[float, float]) -> float:
    return _scalar(beam.footprint_area(*(np.array([axis]) for axis in _axes(box))))


def _refractivity(vapour: Air = IHE, wavelength_um: float = _V["wavelength_um"]) -> float:
    pressure_hpa = air.vapour_pressure(vapour.temperature_c, vapour.humidity_pct)
    return _scalar(
        air.group_refractivity(vapour.temperature_c, vapour.pressure_hpa, pressure_hpa, wavelength_um)
    )


def _warmer(kelvin: float, *, range_m: float = 3414.0) -> float:
    real = Air(IHE.temperature_c + kelvin, IHE.pressure_hpa, IHE.humidity_pct)
    correction = air.air_correction(real, IHE, _V["wavelength_um"])
    return 1e3 * range_m * (_scalar(correction.range_scale(np.array([0.0]))) - 1)


def _by_time_of_flight(kelvin: float, *, range_m: float = 3414.0) -> float:
    """Range error in air `kelvin` warmer than assumed, from the time of flight of the echo [mm]."""
    real = Air(IHE.temperature_c + kelvin, IHE.pressure_hpa, IHE.humidity_pct)
    echo_s = range_m / _scalar(air.range_from_time(1.0, _refractivity()))
    return 1e3 * (_scalar(air.range_from_time(echo_s, _refractivity(real))) - range_m)


def _heavier(hpa: float, range_m: float = 3414.0) -> float:
    real = Air(IHE.temperature_c, IHE.pressure_hpa + hpa, IHE.humidity_pct)
    correction = air.air_correction(real, IHE, _V["wavelength_um"])
    return 1e3 * range_m * (_scalar(correction.range_scale(np.array([0.0]))) - 1)


def _below(rise_m: float) -> float:
    scale = air.air_correction(IHE, IHE, _V["wavelength_um"]).range_scale(np.array([rise_m, 0.0]))
    return 1e6 * float(scale[0] - scale[1])


def _off_by_origin(range_m: float, up_m: float) -> float:
    """Elevation error of a level shot from above the frame's origin if the offset is neglected [0.001°]."""
    level = np.array([0.0])
    point_m = beam.cartesian(np.array([range_m]), level, level, (0.0, 0.0, up_m))
    return 1e3 * math.degrees(_scalar(beam.polar(point_m)[1]))


def _geometry(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    viewing = _viewing(range_m, incidence_deg, slope_deg)
    return _scalar(shot_noise.sigma_geometry(*viewing, np.array([0.0]), _DIVERGENCE))


def _geometry_of_a_plane(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    viewing = _viewing(range_m, incidence_deg, slope_deg)
    return math.sqrt(_scalar(shot_noise.angle_variance(*viewing, beam.sigma_beam_angle(_DIVERGENCE))))


def _density(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    return _scalar(beam.point_density(*_viewing(range_m, incidence_deg, slope_deg), math.radians(0.01)))


def _cell(range_m: float, incidence_deg: float, slope_deg: float, points: float) -> float:
    viewing = _viewing(range_m, incidence_deg, slope_deg)
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
    variance_m2 = shot_noise.shot_variance_voordendag(*viewing, np.array([0.0]), scanner)
    return math.sqrt(_scalar(variance_m2) / points)


def _nanometres() -> float:
    """Return the error of the refractivity with the wavelength in nm instead of µm [ppm]."""
    return _refractivity() - _refractivity(wavelength_um=_V["wavelength_um"] * 1e3)


VOORDENDAG = "voordendag2023"
_RANGE_NOTE = "the text has 800-4500 m; 0.09-0.64 m belong to 645-4584 m"
_AXIS_NOTE = "the column 'footprint area (m²)' is the major axis in m"
_OUTLIER_BOXES = {4: 4.86, 20: 24.3}  # printed standard deviation [m]


def _axis_note(box: int, printed_m: float, expected_m: float) -> str:
    if box in _OUTLIER_BOXES:
        return f"the paper's mean is dominated by a few grazing shots: its standard deviation is {_OUTLIER_BOXES[box]} m"
    if abs(printed_m - expected_m) > 0.02 * expected_m:
        return "computed for the mean incidence, in whole degrees; the paper averages over the box"
    return ""


_LES_NOTE = "with LES temperatures along the path, which are not published"

VOORDENDAG_NUMBERS = (
    PaperNumber(VOORDENDAG, "Eq. 4", "elevation of a shot from 0.1 m above the frame's origin, 100 m", "0.001°", None,
           57.30, 0.01, lambda: _off_by_origin(100, 0.1)),
    PaperNumber(VOORDENDAG, "Eq. 4", "elevation of a shot from 0.1 m above the frame's origin, 3421 m", "0.001°", None,
           1.675, 1e-3, lambda: _off_by_origin(3421, 0.1)),
    PaperNumber(VOORDENDAG, "Eq. 5", "σ of the instrument at 650 m", "m", 0.09, 0.0908, 1e-4, lambda: _tilt(650),
           "the range is chosen for 0.09 m", is_check=False),
    PaperNumber(VOORDENDAG, "Eq. 5", "σ of the instrument at 800 m", "m", 0.09, 0.1117, 1e-4, lambda: _tilt(800),
           _RANGE_NOTE),
    PaperNumber(VOORDENDAG, "Eq. 5", "σ of the instrument at 3421 m", "m", None, 0.4777, 1e-4, lambda: _tilt(3421)),
    PaperNumber(VOORDENDAG, "Eq. 5", "σ of the instrument at 4500 m", "m", 0.64, 0.6283, 1e-4, lambda: _tilt(4500),
           _RANGE_NOTE),
    PaperNumber(VOORDENDAG, "Eq. 5", "σ of the instrument at 4584 m", "m", 0.64, 0.6400, 1e-4, lambda: _tilt(4584),
           "the range is chosen for 0.64 m", is_check=False),
    *(
        PaperNumber(VOORDENDAG, "Eq. 15", f"major axis of the footprint, box {box}", "m", printed, expected, 1e-4,
               lambda b=(range_m, incidence_deg): _axes(b)[0], _axis_note(box, printed, expected))  # type: ignore[misc]
        for box, (range_m, incidence_deg, printed, expected) in BOXES.items()
    ),
    PaperNumber(VOORDENDAG, "Eq. 17", "area of the footprint, box 1", "m²", 0.50, 0.0617, 1e-4,
           lambda: _ellipse(BOX_1), _AXIS_NOTE),
    PaperNumber(VOORDENDAG, "Eq. 17", "π M m of box 1, as printed", "m²", 0.50, 0.247, 1e-3,
           lambda: math.pi * math.prod(_axes(BOX_1)), f"{_AXIS_NOTE}; and full axes need π/4"),
    PaperNumber(VOORDENDAG, "Eq. 7", "standard group refractivity at 1.064 µm", "ppm", None, 291.98498, 1e-5,
           lambda: air.standard_group_refractivity(1.064)),
    PaperNumber(VOORDENDAG, "Eq. 7", "standard group refractivity at 1.55 µm", "ppm", None, 289.66125, 1e-5,
           lambda: air.standard_group_refractivity(1.55)),
    PaperNumber(VOORDENDAG, "Eq. 7-8", "error if the wavelength is in nm", "ppm", None, 2.97, 0.01, _nanometres),
    PaperNumber(VOORDENDAG, "Eq. 8", "group refractivity at -2 °C, 684 hPa, 28 %, by IUGG (1999)", "ppm", None,
           198.4985, 1e-3, _refractivity),
    PaperNumber(VOORDENDAG, "Eq. 8", "the same by Ciddor (1996)", "ppm", None, 198.458, 0.05, _refractivity),
    PaperNumber(VOORDENDAG, "Eq. 10", "range error at 3414 m, 10 K warmer along the path", "mm", 21.0, 24.3, 0.05,
           lambda: _warmer(10), _LES_NOTE),
    PaperNumber(VOORDENDAG, "Eq. 10", "range error at 3414 m, 10 K colder along the path", "mm", -42.4, -26.1, 0.05,
           lambda: _warmer(-10), _LES_NOTE),
    PaperNumber(VOORDENDAG, "Eq. 6", "the same, warmer, from the time of flight", "mm", 21.0, 24.3, 0.05,
           lambda: _by_time_of_flight(10), _LES_NOTE),
    PaperNumber(VOORDENDAG, "Eq. 10", "range error at 3414 m, 10 hPa more", "mm", None, -9.9, 0.01,
           lambda: _heavier(10), "called insignificant; it is 40 % of the error of 10 K"),
    PaperNumber(VOORDENDAG, "Eq. 10", "range error 500 m below the scanner, the same weather", "ppm", None, -5.1, 0.05,
           lambda: _below(-500)),
    PaperNumber(VOORDENDAG, "Eq. 5", "height error at 3421 m by a tilt of 0.0079°", "m", 0.47, 0.4717, 1e-3,
           lambda: _tilt(3421, 0.0079), "the tilt is chosen for 0.47 m", is_check=False),
    PaperNumber(VOORDENDAG, "Eq. 5", "height error at 3421 m by a tilt of 0.0104°", "m", 0.62, 0.6210, 1e-3,
           lambda: _tilt(3421, 0.0104), "the tilt is chosen for 0.62 m", is_check=False),
    PaperNumber(VOORDENDAG, "section 3", "points per m² at 0.01°, box 1", "1/m²", None, 6.021, 1e-3,
           lambda: _density(*BOX_1, 0.0)),
    PaperNumber(VOORDENDAG, "section 3", "points per m² at 0.01°, box 5", "1/m²", None, 1.308, 1e-3,
           lambda: _density(*BOX_5, 25.0)),
    PaperNumber(VOORDENDAG, "Eq. 11", "height error for an error of 0.1 in k, 3421 m", "m", None, 0.092, 1e-3,
           lambda: _scalar(air.refraction_height_error(np.array([3421.0**2]), 0.1)),
           "neglected as within the footprint, but it is common to neighbouring shots"),
    PaperNumber(VOORDENDAG, "Eq. 11", "height error for an error of 0.1 in k, 4500 m", "m", None, 0.159, 1e-3,
           lambda: _scalar(air.refraction_height_error(np.array([4500.0**2]), 0.1)), "as above"),
    PaperNumber(VOORDENDAG, "Eq. 18", "σ of the geometry at 3421 m, 65°, slope 25°", "m", None, 0.137, 1e-3,
           lambda: _geometry(*BOX_5, 25.0)),
    PaperNumber(VOORDENDAG, "Eq. 18", "σ of the geometry at 4500 m, 70°, slope 20°", "m", None, 0.18, 1e-3,
           lambda: _geometry(4500, 70, 20)),
    PaperNumber(VOORDENDAG, "Eq. 18", "the same from the Gaussian beam, 3421 m, 65°, slope 25°", "m", None, 0.103, 1e-3,
           lambda: _geometry_of_a_plane(*BOX_5, 25.0)),
    PaperNumber(VOORDENDAG, "section 3", "points per m² at 0.01°, 650 m, 57°, slope 40°", "1/m²", None, 55.24, 0.01,
           lambda: _density(650, 57, 40)),
    PaperNumber(VOORDENDAG, "Eq. 1-2", "σ of a cell of 56 points at 650 m, 57°, slope 40°", "m", 0.012, 0.0125, 5e-4,
           lambda: _cell(650, 57, 40, 56), "range, incidence, slope and points are chosen for 0.012 m", is_check=False),
)  # fmt: skip


# Hartzell et al. (2015): VZ-4000 and LMS-Z390i.
HARTZELL = "hartzell2015"
_H = SCANNERS["riegl-vz-4000"]


def _vz4000(elevation_deg: float, *, wide: bool, vertical: bool) -> float:
    resolution = beam.sigma_resolution(math.radians(_H["angle_resolution_deg"]))
    angle = math.hypot(resolution, beam.sigma_beam_angle(_H["beam_divergence_mrad"] * 1e-3) if wide else 0.0)
    jacobian = beam.polar_jacobian(np.array([500.0]), np.radians(np.array([elevation_deg])), np.array([0.3]))
    covariance = beam.point_covariance(jacobian, np.array([[_H["range_sigma_m"], angle, angle]]))
    return 1e3 * (math.sqrt(covariance[0, 2, 2]) if vertical else _scalar(beam.error_ellipse(covariance)[0]))


def _widening(elevation_deg: float, *, vertical: bool) -> float:
    with_beam, without = (_vz4000(elevation_deg, wide=wide, vertical=vertical) for wide in (True, False))
    return with_beam / without


def _net_volume(
    measure: Callable[[Floats, terrain.BilinearSurface, Bools], volume.Volume],
    cell_m: float,
    shape: tuple[int, int],
    fields: float,
    sigmas_m: tuple[float, float],
) -> float:
    """Sigma of the net volume of equal level fields [m³], with one point per cell of each given sigma.

    The lattice of points is sheared slightly, because the triangulation of a square lattice is not unique.
    """
    grid = Grid(0.0, (shape[0] + 2) * cell_m, cell_m, shape[1] + 2, shape[0] + 2)  # a margin of one cell
    cells = np.zeros(grid.shape, bool)
    cells[1:-1, 1:-1] = True
    east_m, north_m = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    level = terrain.bilinear_surface(Reference.from_elevation(grid, "level", np.zeros(grid.shape)))
    points_m = np.stack([east_m + 1e-3 * north_m, north_m, np.ones_like(east_m)], axis=-1)
    field = measure(points_m, level, cells)
    gross_m6 = (
        fields
        * volume.independent_variance(field, np.broadcast_to(sigma_m**2 * np.eye(3), (len(east_m), 3, 3)))
        for sigma_m in sigmas_m
    )
    return math.sqrt(volume.difference_variance(*gross_m6))


MONTEZUMA_NET_M3 = 4.743 / 0.004e-2  # the volume that the printed σ is 0.004 % of


@cache
def _registration() -> registration.Registration:
    """Registration from twelve features within 600 m, six of them on planes, known to 3 cm, as at Montezuma.

    Their layout is not published and is drawn at random.
    """
    random = np.random.default_rng(1)
    azimuth, range_m = random.uniform(-1.2, 1.2, 12), random.uniform(100, 600, 12)
    target_m = np.stack(
        [range_m * np.cos(azimuth), range_m * np.sin(azimuth), random.uniform(0, 150, 12)], axis=-1
    )
    normal = np.where(np.arange(12)[:, None] < 6, 0.0, random.normal(size=(12, 3)))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    measured_m = target_m + 0.03 * random.normal(size=(12, 3))
    features = registration.Features(("f",) * 12, measured_m, target_m, normal, np.full(12, 0.03))
    return registration.solve(features, np.eye(4))


def _registration_volume() -> float:
    """Sigma of the net volume over 140,000 m² by the registration errors of two epochs [m³]."""
    grid = Grid(100.0, 175.0, 5.0, 80, 70)
    params = parameter_layout(grid, (0.0, 0.0, 0.0))
    east_m, north_m = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    none = np.zeros_like(east_m)
    jacobian = height_jacobian(params, (east_m, north_m, 0.2 * east_m), none + 0.2, none)
    shared = to_shared_parameters(params, _registration().covariance)
    gross_m6 = aggregate_variance(none + grid.cell_m**2, none, jacobian, shared)
    return math.sqrt(volume.difference_variance(gross_m6, gross_m6))


_DOUBLES_NOTE = "'roughly doubles' holds for the horizontal error only"

HARTZELL_NUMBERS = (
    PaperNumber(HARTZELL, "Fig. 7", "χ² of the 68.3 % ellipse", "1", 2.298, 2.2977, 1e-4,
           lambda: _scalar(beam.error_ellipse(np.eye(3)[None])[0]) ** 2),
    PaperNumber(HARTZELL, "Table 1", "diameter of the VZ-4000's beam at 500 m", "m", None, 0.093, 1e-6,
           lambda: _scalar(beam.diameter(np.array([500.0]), _H["beam_divergence_mrad"] * 1e-3, _H["exit_diameter_m"]))),
    PaperNumber(HARTZELL, "Eq. 7", "angle from the beam's width, VZ-4000", "µrad", None, 37.5, 1e-9,
           lambda: 1e6 * beam.sigma_beam_angle(_H["beam_divergence_mrad"] * 1e-3)),
    PaperNumber(HARTZELL, "section 2.3", "angle from the resolution of 0.0005°", "µrad", None, 2.52, 0.01,
           lambda: 1e6 * beam.sigma_resolution(math.radians(0.0005))),
    *(
        PaperNumber(HARTZELL, "Fig. 7", f"{name} error at 500 m, {elevation}°, {'with' if wide else 'without'} beam",
               "mm", None, expected, 0.01,
               lambda e=elevation, w=wide, v=vertical: _vz4000(e, wide=w, vertical=v))  # type: ignore[misc]
        for name, vertical, elevation, wide, expected in (
            ("horizontal", False, 0, False, 15.16), ("horizontal", False, 0, True, 28.49),
            ("vertical", True, 0, False, 1.26), ("vertical", True, 0, True, 18.79),
            ("vertical", True, 40, False, 6.50), ("vertical", True, 40, True, 15.77),
        )
    ),
    PaperNumber(HARTZELL, "Fig. 7", "factor of the beam in the horizontal error, level", "1", 2.0, 1.879, 1e-3,
           lambda: _widening(0, vertical=False), "the text says 'roughly doubles'"),
    PaperNumber(HARTZELL, "Fig. 7", "factor of the beam in the vertical error, level", "1", 2.0, 14.92, 0.01,
           lambda: _widening(0, vertical=True), _DOUBLES_NOTE),
    PaperNumber(HARTZELL, "Fig. 7", "factor of the beam in the vertical error, at 40°", "1", 2.0, 2.425, 1e-3,
           lambda: _widening(40, vertical=True), _DOUBLES_NOTE),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, raster, Montezuma, cells of 22.2 and 12.3 mm", "m³", 4.743,
           4.743, 0.05, lambda: _net_volume(volume.raster_volume, 0.5, (70, 80), 100, (0.0222, 0.0123)),
           "the σ of the cells is derived from it", is_check=False),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, raster, Mammoth, cells of 2.6 and 1.6 mm", "m³", 0.0182,
           0.0182, 2e-4, lambda: _net_volume(volume.raster_volume, 0.25, (80, 112), 1, (0.0026, 0.0016)),
           "the σ of the cells is derived from it", is_check=False),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, mesh, Montezuma, one point per cell", "m³", 8.647, 4.720, 0.01,
           lambda: _net_volume(volume.mesh_volume, 0.5, (70, 80), 100, (0.0222, 0.0123)),
           "on level ground a mesh of as many points has the σ of the raster; the points are not published"),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, mesh, Mammoth, one point per cell", "m³", 0.0155, 0.01798, 5e-5,
           lambda: _net_volume(volume.mesh_volume, 0.25, (80, 112), 1, (0.0026, 0.0016)), "as above"),
    PaperNumber(HARTZELL, "Eq. 14-15", "σ of the net volume, Montezuma, by registration alone", "m³", 4.743, 1847.0, 1.0,
           _registration_volume, "the paper takes errors as independent from point to point; the layout of the features is simulated"),
    PaperNumber(HARTZELL, "Table 2", "the same in percent of the net volume", "%", 0.004, 1.558, 1e-3,
           lambda: 100 * _registration_volume() / MONTEZUMA_NET_M3, "as above"),
    PaperNumber(HARTZELL, "section 2.2", "largest σ of a rotation of that registration", "0.001°", 6.0, 3.96, 0.01,
           lambda: 1e3 * math.degrees(_registration().covariance.diagonal()[:3].max() ** 0.5),
           "the paper has 0.003-0.006° for its own layout of features"),
    PaperNumber(HARTZELL, "section 2.2", "largest σ of a shift of that registration", "cm", 3.0, 1.82, 0.01,
           lambda: 100 * float(_registration().covariance.diagonal()[3:].max() ** 0.5),
           "the paper has 1-3 cm for its own layout of features"),
    PaperNumber(HARTZELL, "section 2.2", "σ of the filtered inclination, 0.006° per sample", "0.001°", 6.0, 0.788,
           1e-3, lambda: 6.0 * math.sqrt(float(np.sum(inclination.blackman(101) ** 2))),
           "0.006° is of one sample; the filtered signal is better, and its error is common to all points"),
)  # fmt: skip


# Ozendi et al. (2016): FARO X330.
OZENDI = "ozendi2016"
_STEP_NOTE = "different spots are compared: the scatter is step/√12, not the encoder's"


def _sampling_cc(step_cc: float) -> float:
    return beam.sigma_resolution(step_cc * precision.CC_RAD) / precision.CC_RAD


def _more_than_residual_pct(incidence_deg: float) -> float:
    return 100 * (_scalar(precision.sigma_range(np.array([1.0]), np.cos(np.radians([incidence_deg])))) - 1)


OZENDI_NUMBERS = (
    PaperNumber(OZENDI, "Table 1", "36.6cc of the horizontal angle", "0.001°", None, 3.294, 1e-3,
           lambda: 1e3 * math.degrees(36.6 * precision.CC_RAD), is_check=False),
    PaperNumber(OZENDI, "Table 1", "36.6cc of the horizontal angle", "µrad", None, 57.5, 0.05,
           lambda: 1e6 * 36.6 * precision.CC_RAD, is_check=False),
    PaperNumber(OZENDI, "Table 1", "17.8cc of the vertical angle", "0.001°", None, 1.602, 1e-3,
           lambda: 1e3 * math.degrees(17.8 * precision.CC_RAD), is_check=False),
    PaperNumber(OZENDI, "Table 1", "17.8cc of the vertical angle", "µrad", None, 28.0, 0.05,
           lambda: 1e6 * 17.8 * precision.CC_RAD, is_check=False),
    PaperNumber(OZENDI, "Table 1", "scatter from sampling alone at a step of 200cc", "cc", 36.6, 57.7, 0.1,
           lambda: _sampling_cc(200), _STEP_NOTE),
    PaperNumber(OZENDI, "Table 1", "scatter from sampling alone at a step of 400cc", "cc", 59.8, 115.5, 0.1,
           lambda: _sampling_cc(400), _STEP_NOTE),
    PaperNumber(OZENDI, "Table 1", "scatter from sampling alone at a step of 800cc", "cc", 154.1, 230.9, 0.1,
           lambda: _sampling_cc(800), _STEP_NOTE),
    PaperNumber(OZENDI, "section 4", "σ of the range above the residual across a plane at 30°", "%", None, 15.5, 0.1,
           lambda: _more_than_residual_pct(30), "the paper does not divide by cos α"),
    PaperNumber(OZENDI, "section 4", "σ of the range above the residual across a plane at 45°", "%", None, 41.4, 0.1,
           lambda: _more_than_residual_pct(45), "the paper does not divide by cos α"),
)  # fmt: skip


# Leslar et al. (2014): a mobile lidar, Table 1, "expected" and "ideal".
LESLAR = "leslar2014"
_IDEAL_NOTE = "the σ of the INS is not printed, 0.007 m is assumed; nor is the geometry"


def _share(
    variables: tuple[str, ...],
    range_m: float,
    stated: dict[str, float] = mobile_lidar.EXPECTED,
    elevation_deg: float = 0.0,
) -> float:
    point, sigma = mobile_lidar.side_shot(range_m, math.radians(elevation_deg)), mobile_lidar.sigmas(stated)
    _, shares = sensitivity.first_order_variance(mobile_lidar.height, point, sigma)
    return 100 * sum(float(shares[mobile_lidar.VARIABLES.index(name)]) for name in variables)


def _sobol(variable: str, range_m: float, *, total: bool) -> float:
    point, sigma = mobile_lidar.side_shot(range_m), mobile_lidar.sigmas(mobile_lidar.EXPECTED)
    mask = np.array([name == variable for name in mobile_lidar.VARIABLES])
    indices = sensitivity.sobol(
        mobile_lidar.height, sensitivity.independent_normal(sigma, point), [mask, ~mask]
    )
    return 100 * float((indices.total if total else indices.first)[0])


def _third_order(*, printed: bool) -> float:
    """Third-order index of x y z, each with a sigma as large as its mean, by simulation [%]."""
    ones = np.ones(3)
    each = [np.arange(3) == index for index in range(3)]
    indices = sensitivity.interactions(
        lambda x: np.prod(x, axis=0), sensitivity.independent_normal(ones, ones), each, 32_768
    )
    return 100 * sum(
        share for combination, (share, _) in indices.items() if len(combination) > (1 if printed else 2)
    )


def _largest_interaction(order: int) -> float:
    """Interaction index of the mobile lidar's height for its `order` largest inputs, 100 m away [%]."""
    point, sigma = mobile_lidar.side_shot(100.0), mobile_lidar.sigmas(mobile_lidar.EXPECTED)
    largest = ("boresight_x", "lever_z", "vertical_angle")[:order]
    groups = [np.array([name == variable for name in mobile_lidar.VARIABLES]) for variable in largest]
    indices = sensitivity.interactions(
        mobile_lidar.height, sensitivity.independent_normal(sigma, point), groups
    )
    return 100 * indices[tuple(range(order))][0]


LESLAR_NUMBERS = (
    PaperNumber(LESLAR, "Eq. 6-7", "share of the lever arm's Z in the height, 2 m away", "%", 90.0, 88.98, 0.01,
           lambda: _share(("lever_z",), 2.0)),
    PaperNumber(LESLAR, "Eq. 6-7", "share of the INS's height, 2 m away", "%", 12.0, 10.90, 0.01,
           lambda: _share(("x",), 2.0), "σ of the INS is not printed; 0.007 m is chosen for 'about 12 %'", is_check=False),
    PaperNumber(LESLAR, "Eq. 6-7", "share of the boresight roll in the height, 100 m away", "%", 70.0, 69.25, 0.01,
           lambda: _share(("boresight_x",), 100.0)),
    PaperNumber(LESLAR, "Table 1", "ideal system: share of the INS's height, 2 m below", "%", 45.0, 49.49, 0.01,
           lambda: _share(("x",), 2.0, mobile_lidar.IDEAL, -90.0), _IDEAL_NOTE),
    PaperNumber(LESLAR, "Table 1", "ideal system: share of range and zero error, 2 m below", "%", 40.0, 34.34, 0.01,
           lambda: _share(("range", "zero_error"), 2.0, mobile_lidar.IDEAL, -90.0), _IDEAL_NOTE),
    PaperNumber(LESLAR, "Table 1", "ideal system: share of the vertical angle, 100 m away", "%", 40.0, 57.52, 0.01,
           lambda: _share(("vertical_angle",), 100.0, mobile_lidar.IDEAL), _IDEAL_NOTE),
    PaperNumber(LESLAR, "Eq. 10", "first Sobol index of the boresight roll, 100 m away", "%", 70.0, 69.2, 5.0,
           lambda: _sobol("boresight_x", 100.0, total=False)),
    PaperNumber(LESLAR, "Eq. 12", "total Sobol index of the boresight roll, 100 m away", "%", 70.0, 69.2, 5.0,
           lambda: _sobol("boresight_x", 100.0, total=True)),
    PaperNumber(LESLAR, "Eq. 11", "third-order index of x y z, each with σ equal to its mean", "%", None, 14.3, 2.0,
           lambda: _third_order(printed=False)),
    PaperNumber(LESLAR, "Eq. 11", "the same with only first-order terms subtracted, as printed", "%", None, 57.1, 4.0,
           lambda: _third_order(printed=True), "the pairs remain: the indices sum to more than 100 %"),
    PaperNumber(LESLAR, "Eq. 11", "interaction of boresight roll, lever Z, vertical angle, 100 m", "%", None, 0.0, 3.0,
           lambda: _largest_interaction(3)),
    PaperNumber(LESLAR, "Eq. 11", "subsets of 9 of the 18 variables", "1", 48620, 48620, 0.0,
           lambda: float(math.comb(len(mobile_lidar.VARIABLES), 9)), is_check=False),
)  # fmt: skip

PAPER_NUMBERS = (*HARTZELL_NUMBERS, *VOORDENDAG_NUMBERS, *OZENDI_NUMBERS, *LESLAR_NUMBERS)
