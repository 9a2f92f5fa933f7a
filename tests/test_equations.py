"""Equations against independent computations; the numbers of the papers are tested in `test_papers`.

V: Voordendag et al. 2023, H: Hartzell et al. 2015.
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Air
from station.science import air, beam, uncertainty

IHE = Air(temperature_c=-2.0, pressure_hpa=684.0, humidity_pct=28.0)  # V section 2.2: the scanner's setting
GREEN_UM = 1.064


def array(*values):
    return np.array(values, dtype=float)


def test_p6_range_error_along_a_falling_path():
    """A target 500 m below the scanner, against the hydrostatic equation integrated step by step."""
    step_m = 0.5
    kelvin, pressure_hpa, refractivity_ppm = 271.15, 684.0, []
    for _ in range(1000):
        refractivity_ppm.append(198.4985 * pressure_hpa / 684.0 * 271.15 / kelvin)
        pressure_hpa += 9.80665 * 0.0289644 / 8.314462 * pressure_hpa / kelvin * step_m
        kelvin += 0.0065 * step_m
    wanted_ppm = 198.4985 - np.mean(refractivity_ppm)
    assert wanted_ppm == pytest.approx(-5.1, abs=0.1)
    scale = air.air_correction(IHE, IHE, GREEN_UM).range_scale(array(-500.0, 0.0))
    assert (scale - 1) * 1e6 == pytest.approx([wanted_ppm, 0.0], abs=0.05)


def test_refraction_coefficients():
    pressure_hpa, kelvin = 684.0, 271.15
    factor = 503 * pressure_hpa / kelvin**2
    for gradient, wanted in ((-0.0065, 0.130), (0.0, 0.1605), (0.05, 0.3945)):
        told = air.refraction_coefficient(kelvin - 273.15, pressure_hpa, gradient)
        assert told == pytest.approx(factor * (0.0343 + gradient))
        assert told == pytest.approx(wanted, abs=2e-3)
    assert air.refraction_rise(array(3421.0, 4500.0) ** 2, 0.1) == pytest.approx([0.09, 0.16], abs=0.003)
    led = air.AirCorrection((50.0, 0.0, 0.0), 0.13)  # 3421 m to the north-east, 500 m down
    east_m, north_m, up_m = led.corrected(np.array([[3421 / math.sqrt(2)], [3421 / math.sqrt(2)], [-500.0]]))
    assert np.hypot(east_m, north_m) == pytest.approx(3421 + 0.171, abs=1e-3)
    assert up_m == pytest.approx(-500 - 0.025 - 0.1194, abs=1e-3)


def test_p7_68_percent_ellipse():
    """Of draws from the distribution 68.3 % lie within, against 39.35 % for the unscaled ellipse."""
    circle = beam.error_ellipse(np.diag([1.0, 1.0, 4.0])[None])[0][0]
    draws = np.random.default_rng(7).normal(size=(200_000, 2))
    assert np.mean(np.hypot(*draws.T) < circle) == pytest.approx(0.683, abs=0.004)


def test_published_budget_of_a_cell():
    """V-1 and V-2 by hand for box 5, and V-3 as the linear sum it is."""
    from station.scanners import SCANNERS
    from station.sections import ScannerSection

    assert SCANNERS["riegl-vz-6000"]["beam_divergence_mrad"] == 0.12
    given = ScannerSection.model_validate({"model": "riegl-vz-6000"})
    vz6000 = given.instrument
    seen = array(3421.0), np.cos(np.radians(array(65.0))), np.cos(np.radians(array(25.0)))
    point_m2 = uncertainty.shot_variance_voordendag(*seen, array(0.0), vz6000)[0]
    assert math.sqrt(point_m2) == pytest.approx(math.sqrt(0.4777**2 + 0.137**2 + 0.01**2), abs=1e-3)
    assert uncertainty.sigma_total_voordendag(array(0.12), 0.03)[0] == pytest.approx(0.15)


def test_range_error_seen_vertically():
    """V-12 for a plane: a range error of 1 m along a beam, by intersecting the shifted point."""
    slope, fall = math.radians(20.0), math.radians(10.0)
    direction = array(math.cos(fall), 0.0, -math.sin(fall))
    normal = array(-math.sin(slope), 0.0, math.cos(slope))  # the plane rises away from the scanner
    raised_m = direction[2] - math.tan(slope) * direction[0]  # height above the plane after 1 m more
    cos_inc = beam.cos_incidence(direction, normal)
    told_m = uncertainty.sigma_atmosphere(1.0, cos_inc, math.cos(slope))
    assert abs(raised_m) == pytest.approx(float(told_m))


def test_polar_and_cartesian_in_all_quadrants():
    azimuth = np.linspace(-3.1, 3.1, 17)
    elevation = np.linspace(-1.2, 1.2, 17)
    range_m = np.linspace(1, 5000, 17)
    points = beam.cartesian(range_m, elevation, azimuth)
    assert points[:, 2] == pytest.approx(range_m * np.sin(elevation))
    for told, wanted in zip(beam.polar(points), (range_m, elevation, azimuth), strict=True):
        assert told == pytest.approx(wanted)


def test_jacobian_against_finite_differences():
    at = array(3000.0), array(-0.2), array(2.5)
    told = beam.polar_jacobian(*at)[0]
    for column, step in enumerate((1e-2, 1e-6, 1e-6)):
        ends = []
        for sign in (1, -1):
            moved = list(at)
            moved[column] = moved[column] + sign * step
            ends.append(beam.cartesian(*moved)[0])
        assert told[:, column] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-5)


ORIGIN_M = (0.03, -0.05, 0.22)  # of the beam: forward, left, up


def shots(count=40, seed=4):
    rng = np.random.default_rng(seed)
    return rng.uniform(1, 60, count), rng.uniform(-1.2, 1.2, count), rng.uniform(-3.1, 3.1, count)


def test_a_beam_that_begins_beside_the_centre():
    """V-4 against a head that is turned as a body: origin and direction in its frame, then both turned."""
    range_m, elevation, azimuth = shots()
    in_head = np.stack([np.cos(elevation), 0 * elevation, np.sin(elevation)], axis=-1)
    wanted = Rotation.from_rotvec(np.outer(azimuth, [0, 0, 1])).apply(ORIGIN_M + range_m[:, None] * in_head)
    told = beam.cartesian(range_m, elevation, azimuth, ORIGIN_M)
    assert told == pytest.approx(wanted, abs=1e-9)
    assert beam.vertex(array(1, 2, 3), array(2.0), array(0, 0, 1.0)[None])[0] == pytest.approx([1, 2, 5])
    for back, given in zip(beam.polar(told, ORIGIN_M), (range_m, elevation, azimuth), strict=True):
        assert back == pytest.approx(given, abs=1e-9)
    without = beam.polar(told)  # what dropping it makes of a near point
    assert np.abs(without[1] - elevation).max() > 0.01


def test_jacobian_of_a_beam_that_begins_beside_the_centre():
    at = [one[:1] for one in shots(1)]
    told = beam.polar_jacobian(*at, ORIGIN_M)[0]
    for column, step in enumerate((1e-2, 1e-6, 1e-6)):
        ends = []
        for sign in (1, -1):
            moved = list(at)
            moved[column] = moved[column] + sign * step
            ends.append(beam.cartesian(*moved, ORIGIN_M)[0])
        assert told[:, column] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-7)


def test_beam_of_a_vz4000():
    """H Table 1: 18 mm at the exit, 0.15 mrad; 93 mm at 500 m."""
    assert beam.diameter(array(500.0), 0.15e-3, 0.018)[0] == pytest.approx(0.093)
    assert beam.sigma_beam_range(array(500.0), 0.15e-3, array(math.pi / 4))[0] == pytest.approx(0.01875)
    grazing = beam.sigma_beam_range(array(500.0), 0.15e-3, array(math.pi / 2))[0]
    assert grazing == pytest.approx(0.01875 * math.tan(math.radians(87)))


def test_beam_as_range_and_as_angle_is_one_effect():
    """EQUATIONS 3.4: seen vertically from a plane both give R γ/4 sin α / cos γ; Hartzell adds them."""
    incidence = np.radians(array(70.0))
    seen = np.cos(incidence), np.cos(np.radians(array(25.0)))
    as_range_m = beam.sigma_beam_range(array(3421.0), 0.12e-3, incidence)
    as_angle_m2 = uncertainty.angle_variance(array(3421.0), *seen, beam.sigma_beam_angle(0.12e-3))
    assert uncertainty.range_variance(*seen, as_range_m) == pytest.approx(as_angle_m2)
