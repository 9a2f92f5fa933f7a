"""Equations against independent computations; the numbers of the papers are tested in `test_papers`.

V stands for Voordendag et al. (2023), H for Hartzell et al. (2015).
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Air
from station.science.geometry import air, beam
from station.science.uncertainty import shot_noise
from station.sections.inputs import ScannerSection

IHE = Air(temperature_c=-2.0, pressure_hpa=684.0, humidity_pct=28.0)  # V section 2.2: the scanner's setting
GREEN_UM = 1.064
VZ_6000 = ScannerSection.model_validate({"model": "riegl-vz-6000"}).instrument


def array(*values):
    return np.array(values, dtype=float)


def test_range_correction_along_a_descending_path():
    """A target 500 m below the scanner, against the hydrostatic equation integrated step by step."""
    step_m = 0.5
    kelvin, pressure_hpa, refractivity_ppm = 271.15, 684.0, []
    for _ in range(1000):
        refractivity_ppm.append(198.4985 * pressure_hpa / 684.0 * 271.15 / kelvin)
        pressure_hpa += 9.80665 * 0.0289644 / 8.314462 * pressure_hpa / kelvin * step_m
        kelvin += 0.0065 * step_m
    expected_ppm = 198.4985 - np.mean(refractivity_ppm)
    assert expected_ppm == pytest.approx(-5.1, abs=0.1)
    bottom_ppm = 198.4985 * pressure_hpa / 684.0 * 271.15 / kelvin
    assert air.refractivity_above(IHE, array(-500.0), GREEN_UM) == pytest.approx([bottom_ppm], abs=0.05)
    scale = air.air_correction(IHE, IHE, GREEN_UM).range_scale(array(-500.0, 0.0))
    assert (scale - 1) * 1e6 == pytest.approx([expected_ppm, 0.0], abs=0.05)


def test_refraction_coefficient_and_height_error():
    pressure_hpa, kelvin = 684.0, 271.15
    factor = 503 * pressure_hpa / kelvin**2
    for gradient, expected in ((-0.0065, 0.130), (0.0, 0.1605), (0.05, 0.3945)):
        actual = air.refraction_coefficient(kelvin - 273.15, pressure_hpa, gradient)
        assert actual == pytest.approx(factor * (0.0343 + gradient))
        assert actual == pytest.approx(expected, abs=2e-3)
    assert air.refraction_height_error(array(3421.0, 4500.0) ** 2, 0.1) == pytest.approx(
        [0.09, 0.16], abs=0.003
    )
    correction = air.AirCorrection((50.0, 0.0, 0.0), 0.13)  # 3421 m to the north-east, 500 m down
    east_m, north_m, up_m = correction.apply(
        np.array([[3421 / math.sqrt(2)], [3421 / math.sqrt(2)], [-500.0]])
    )
    assert np.hypot(east_m, north_m) == pytest.approx(3421 + 0.171, abs=1e-3)
    assert up_m == pytest.approx(-500 - 0.025 - 0.1194, abs=1e-3)


def test_error_ellipse_contains_68_percent():
    """68.3 % of draws from the distribution lie within, against 39.35 % for the unscaled ellipse."""
    radius = beam.error_ellipse(np.diag([1.0, 1.0, 4.0])[None])[0][0]
    draws = np.random.default_rng(7).normal(size=(200_000, 2))
    assert np.mean(np.hypot(*draws.T) < radius) == pytest.approx(0.683, abs=0.004)


def test_published_budget_of_a_cell():
    """V Eq. 1 by hand for box 5, and the linear sum of V Eq. 3."""
    from station.scanners import SCANNERS
    from station.sections.inputs import ScannerSection

    assert SCANNERS["riegl-vz-6000"]["beam_divergence_mrad"] == 0.12
    vz6000 = ScannerSection.model_validate({"model": "riegl-vz-6000"}).instrument
    geometry = array(3421.0), np.cos(np.radians(array(65.0))), np.cos(np.radians(array(25.0)))
    point_m2 = shot_noise.shot_variance_voordendag(*geometry, array(0.0), vz6000)[0]
    assert math.sqrt(point_m2) == pytest.approx(math.sqrt(0.4777**2 + 0.137**2 + 0.01**2), abs=1e-3)
    assert shot_noise.sigma_total_voordendag(array(0.12), 0.03)[0] == pytest.approx(0.15)


def test_vertical_effect_of_a_range_error():
    """V Eq. 12 on a plane: height above it of a point shifted by 1 m along the beam."""
    slope, depression = math.radians(20.0), math.radians(10.0)
    direction = array(math.cos(depression), 0.0, -math.sin(depression))
    normal = array(-math.sin(slope), 0.0, math.cos(slope))  # the plane rises away from the scanner
    expected_m = direction[2] - math.tan(slope) * direction[0]  # height above the plane after 1 m more
    cos_inc = beam.cos_incidence(direction, normal)
    actual_m = shot_noise.sigma_atmosphere(1.0, cos_inc, math.cos(slope))
    assert abs(expected_m) == pytest.approx(float(actual_m))


def test_polar_inverts_cartesian_in_all_quadrants():
    azimuth = np.linspace(-3.1, 3.1, 17)
    elevation = np.linspace(-1.2, 1.2, 17)
    range_m = np.linspace(1, 5000, 17)
    points = beam.cartesian(range_m, elevation, azimuth)
    assert points[:, 2] == pytest.approx(range_m * np.sin(elevation))
    for actual, expected in zip(beam.polar(points), (range_m, elevation, azimuth), strict=True):
        assert actual == pytest.approx(expected)


def test_polar_jacobian_equals_finite_differences():
    coordinates = array(3000.0), array(-0.2), array(2.5)
    actual = beam.polar_jacobian(*coordinates)[0]
    for column, step in enumerate((1e-2, 1e-6, 1e-6)):
        ends = []
        for sign in (1, -1):
            moved = list(coordinates)
            moved[column] = moved[column] + sign * step
            ends.append(beam.cartesian(*moved)[0])
        assert actual[:, column] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-5)


ORIGIN_M = (0.03, -0.05, 0.22)  # beam origin: forward, left, up


def shots(count=40, seed=4):
    rng = np.random.default_rng(seed)
    return rng.uniform(1, 60, count), rng.uniform(-1.2, 1.2, count), rng.uniform(-3.1, 3.1, count)


def test_beam_origin_off_the_centre_rotates_with_the_head():
    """V Eq. 4 against origin and direction in the frame of the head, both rotated with it."""
    range_m, elevation, azimuth = shots()
    in_head = np.stack([np.cos(elevation), 0 * elevation, np.sin(elevation)], axis=-1)
    expected = Rotation.from_rotvec(np.outer(azimuth, [0, 0, 1])).apply(ORIGIN_M + range_m[:, None] * in_head)
    actual = beam.cartesian(range_m, elevation, azimuth, ORIGIN_M)
    assert actual == pytest.approx(expected, abs=1e-9)
    assert beam.vertex(array(1, 2, 3), array(2.0), array(0, 0, 1.0)[None])[0] == pytest.approx([1, 2, 5])
    for recovered, given in zip(beam.polar(actual, ORIGIN_M), (range_m, elevation, azimuth), strict=True):
        assert recovered == pytest.approx(given, abs=1e-9)
    uncorrected = beam.polar(actual)  # neglecting it shifts near points
    assert np.abs(uncorrected[1] - elevation).max() > 0.01


def test_polar_jacobian_with_a_beam_origin_equals_finite_differences():
    coordinates = [values[:1] for values in shots(1)]
    actual = beam.polar_jacobian(*coordinates, ORIGIN_M)[0]
    for column, step in enumerate((1e-2, 1e-6, 1e-6)):
        ends = []
        for sign in (1, -1):
            moved = list(coordinates)
            moved[column] = moved[column] + sign * step
            ends.append(beam.cartesian(*moved, ORIGIN_M)[0])
        assert actual[:, column] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-7)


def test_beam_diameter_and_range_sigma_of_a_vz4000():
    """H Table 1: 18 mm at the exit, 0.15 mrad; 93 mm at 500 m."""
    assert beam.diameter(array(500.0), 0.15e-3, 0.018)[0] == pytest.approx(0.093)
    assert beam.sigma_beam_range(array(500.0), 0.15e-3, array(math.pi / 4))[0] == pytest.approx(0.01875)
    grazing = beam.sigma_beam_range(array(500.0), 0.15e-3, array(math.pi / 2))[0]
    assert grazing == pytest.approx(0.01875 * math.tan(math.radians(87)))


def test_beam_width_as_range_and_as_angle_has_the_same_effect():
    """equations.md, 3.4: both have the vertical effect R γ/4 sin α / cos γ on a plane; Hartzell adds them."""
    incidence = np.radians(array(70.0))
    cosines = np.cos(incidence), np.cos(np.radians(array(25.0)))
    as_range_m = beam.sigma_beam_range(array(3421.0), 0.12e-3, incidence)
    as_angle_m2 = shot_noise.angle_variance(array(3421.0), *cosines, beam.sigma_beam_angle(0.12e-3))
    assert shot_noise.range_variance(*cosines, as_range_m) == pytest.approx(as_angle_m2)


def test_variance_of_a_shot_of_the_vz_6000():
    """1000 m, 60° incidence, level ground; from 10 mm, a quarter of 0.12 mrad, 0.0005°/√12 and 0.0008°."""
    angle_rad = math.sqrt(30e-6**2 + 2.519e-6**2 + 13.963e-6**2)
    expected_m2 = (0.010 * 0.5) ** 2 + (1000 * angle_rad) ** 2 * 0.75
    actual_m2 = shot_noise.shot_variance(array(1000.0), array(0.5), array(1.0), VZ_6000)
    assert actual_m2 == pytest.approx([expected_m2], rel=1e-3)
