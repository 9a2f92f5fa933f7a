"""Numbers of Voordendag et al. (2023): VZ-6000, 0.12 mrad, the scanner's setting -2 °C, 684 hPa, 28 %."""

from __future__ import annotations

import math

import numpy as np

from station.papers.paper_number import PaperNumber, scalar
from station.quantities import Air, Floats, Scanner
from station.scanners import SCANNERS
from station.science.geometry import air, beam
from station.science.uncertainty import shot_noise

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


def _viewing(range_m: float, incidence_deg: float, slope_deg: float) -> tuple[Floats, Floats, Floats]:
    return (
        np.array([range_m]),
        np.cos(np.radians(np.array([incidence_deg]))),
        np.cos(np.radians(np.array([slope_deg]))),
    )


def _tilt(range_m: float, tilt_deg: float = 0.008) -> float:
    return scalar(shot_noise.sigma_instrument(np.array([range_m]), math.radians(tilt_deg)))


def _axes(box: tuple[float, float]) -> tuple[float, float]:
    major_m, minor_m = beam.footprint_axes(np.array([box[0]]), np.radians(np.array([box[1]])), _DIVERGENCE)
    return scalar(major_m), scalar(minor_m)


def _ellipse(box: tuple[float, float]) -> float:
    return scalar(beam.footprint_area(*(np.array([axis]) for axis in _axes(box))))


def _refractivity(vapour: Air = IHE, wavelength_um: float = _V["wavelength_um"]) -> float:
    pressure_hpa = air.vapour_pressure(vapour.temperature_c, vapour.humidity_pct)
    return scalar(
        air.group_refractivity(vapour.temperature_c, vapour.pressure_hpa, pressure_hpa, wavelength_um)
    )


def _warmer(kelvin: float, *, range_m: float = 3414.0) -> float:
    real = Air(IHE.temperature_c + kelvin, IHE.pressure_hpa, IHE.humidity_pct)
    correction = air.air_correction(real, IHE, _V["wavelength_um"])
    return 1e3 * range_m * (scalar(correction.range_scale(np.array([0.0]))) - 1)


def _by_time_of_flight(kelvin: float, *, range_m: float = 3414.0) -> float:
    """Range error in air `kelvin` warmer than assumed, from the time of flight of the echo [mm]."""
    real = Air(IHE.temperature_c + kelvin, IHE.pressure_hpa, IHE.humidity_pct)
    echo_s = range_m / scalar(air.range_from_time(1.0, _refractivity()))
    return 1e3 * (scalar(air.range_from_time(echo_s, _refractivity(real))) - range_m)


def _heavier(hpa: float, range_m: float = 3414.0) -> float:
    real = Air(IHE.temperature_c, IHE.pressure_hpa + hpa, IHE.humidity_pct)
    correction = air.air_correction(real, IHE, _V["wavelength_um"])
    return 1e3 * range_m * (scalar(correction.range_scale(np.array([0.0]))) - 1)


def _below(rise_m: float) -> float:
    scale = air.air_correction(IHE, IHE, _V["wavelength_um"]).range_scale(np.array([rise_m, 0.0]))
    return 1e6 * float(scale[0] - scale[1])


def _off_by_origin(range_m: float, up_m: float) -> float:
    """Elevation error of a level shot from above the frame's origin if the offset is neglected [0.001°]."""
    level = np.array([0.0])
    point_m = beam.cartesian(np.array([range_m]), level, level, (0.0, 0.0, up_m))
    return 1e3 * math.degrees(scalar(beam.polar(point_m)[1]))


def _geometry(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    angles = _viewing(range_m, incidence_deg, slope_deg)
    return scalar(shot_noise.sigma_geometry(*angles, np.array([0.0]), _DIVERGENCE))


def _geometry_of_a_plane(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    angles = _viewing(range_m, incidence_deg, slope_deg)
    return math.sqrt(scalar(shot_noise.angle_variance(*angles, beam.sigma_beam_angle(_DIVERGENCE))))


def _density(range_m: float, incidence_deg: float, slope_deg: float) -> float:
    return scalar(beam.point_density(*_viewing(range_m, incidence_deg, slope_deg), math.radians(0.01)))


def _cell(range_m: float, incidence_deg: float, slope_deg: float, points: float) -> float:
    angles = _viewing(range_m, incidence_deg, slope_deg)
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
    variance_m2 = shot_noise.shot_variance_voordendag(*angles, np.array([0.0]), scanner)
    return math.sqrt(scalar(variance_m2) / points)


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
           lambda: scalar(air.refraction_height_error(np.array([3421.0**2]), 0.1)),
           "neglected as within the footprint, but it is common to neighbouring shots"),
    PaperNumber(VOORDENDAG, "Eq. 11", "height error for an error of 0.1 in k, 4500 m", "m", None, 0.159, 1e-3,
           lambda: scalar(air.refraction_height_error(np.array([4500.0**2]), 0.1)), "as above"),
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
