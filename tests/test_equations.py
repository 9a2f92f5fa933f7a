"""The numbers the papers print, and independent ones where a paper errs.

P1 … P15 count as in the project's sheet of equations; P10 stands with the volumes, P15
with the registration. V: Voordendag et al. 2023, H: Hartzell et al. 2015,
O: Ozendi et al. 2016, L: Leslar et al. 2014.
"""

import math

import numpy as np
import pytest

from station.quantities import Air, Grid, Reference
from station.science import air, beam, terrain, uncertainty, volume

IHE = Air(temperature_c=-2.0, pressure_hpa=684.0, humidity_pct=28.0)  # V section 2.2: the scanner's setting
GREEN_UM = 1.064
BOX_1 = (1299.0, math.radians(72.0))  # range and incidence, V Table 2
BOX_5 = (3421.0, math.radians(65.0))


def array(*values):
    return np.array(values, dtype=float)


def test_p1_instrument_uncertainty_grows_with_range():
    assert uncertainty.sigma_instrument(array(650, 3421, 4500, 4584)) == pytest.approx(
        [0.0908, 0.4777, 0.6283, 0.6400], abs=1e-4
    )


def test_p2_p3_footprint_of_boxes_1_and_5():
    major_m, minor_m = beam.footprint_axes(array(BOX_1[0], BOX_5[0]), array(BOX_1[1], BOX_5[1]), 0.12e-3)
    assert major_m == pytest.approx([0.504, 0.971], abs=1e-3)
    area_m2 = beam.footprint_area(major_m, minor_m)
    assert area_m2[0] == pytest.approx(0.0617, abs=1e-4)
    assert 4 * area_m2[0] == pytest.approx(0.247, abs=1e-3)  # V-17 as printed


def test_p4_standard_group_refractivity():
    assert air.standard_group_refractivity(1.064) == pytest.approx(291.98498, abs=1e-5)
    assert air.standard_group_refractivity(1.55) == pytest.approx(289.66125, abs=1e-5)


def test_p5_group_refractivity_of_the_scanners_setting():
    vapour_hpa = air.vapour_pressure(IHE.temperature_c, IHE.humidity_pct)
    told = air.group_refractivity(IHE.temperature_c, IHE.pressure_hpa, vapour_hpa, GREEN_UM)
    assert told == pytest.approx(198.498, abs=0.01)
    assert told == pytest.approx(198.458, abs=0.05)  # Ciddor (1996), an independent theory


def test_p6_range_error_of_ten_kelvin():
    """Without a height difference: +24.3 and -26.1 mm at 3414 m."""
    for warmer_k, wanted_m in ((10.0, 0.0243), (-10.0, -0.0261)):
        real = Air(IHE.temperature_c + warmer_k, IHE.pressure_hpa, IHE.humidity_pct)
        scale = air.air_correction(real, IHE, GREEN_UM).range_scale(array(0.0))
        assert 3414 * (scale[0] - 1) == pytest.approx(wanted_m, abs=2e-4)


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
    assert air.refraction_rise(array(3421.0, 4500.0), 0.1) == pytest.approx([0.09, 0.16], abs=0.003)


def test_p7_68_percent_ellipse():
    """Of draws from the distribution 68.3 % lie within, against 39.35 % for the unscaled ellipse."""
    circle = beam.error_ellipse(np.diag([1.0, 1.0, 4.0])[None])[0][0]
    assert circle**2 == pytest.approx(2.2977, abs=2e-3)
    draws = np.random.default_rng(7).normal(size=(200_000, 2))
    assert np.mean(np.hypot(*draws.T) < circle) == pytest.approx(0.683, abs=0.004)


@pytest.mark.parametrize(
    ("elevation_deg", "with_beam", "horizontal_mm", "vertical_mm"),
    [(0, False, 15.2, 1.3), (0, True, 28.5, 18.8), (40, False, None, 6.5), (40, True, None, 15.8)],
)
def test_p8_errors_of_a_vz4000_at_500_m(elevation_deg, with_beam, horizontal_mm, vertical_mm):
    """H Fig. 7: range precision 10 mm, angle resolution 0.0005°, 0.15 mrad."""
    angle = math.hypot(
        beam.sigma_resolution(math.radians(0.0005)), beam.sigma_beam_angle(0.15e-3) if with_beam else 0.0
    )
    jacobian = beam.polar_jacobian(array(500), np.radians(array(elevation_deg)), array(0.3))
    covariance = beam.point_covariance(jacobian, array(0.010, angle, angle)[None])
    if horizontal_mm:
        assert beam.error_ellipse(covariance)[0][0] * 1e3 == pytest.approx(horizontal_mm, abs=0.15)
    assert math.sqrt(covariance[0, 2, 2]) * 1e3 == pytest.approx(vertical_mm, abs=0.15)


@pytest.mark.parametrize(
    ("cell_m", "cells", "sigma_mm", "net_m3"),
    [(0.5, (700, 800), (22.2, 12.3), 4.743), (0.25, (80, 112), (2.6, 1.6), 0.0182)],
)
def test_p9_net_volume_of_hartzells_sites(cell_m, cells, sigma_mm, net_m3):
    """H Table 2, raster: Montezuma, 140 000 m², Mammoth, 560 m², from cells' sigma with and without snow."""
    grid = Grid(0.0, cells[0] * cell_m, cell_m, cells[1], cells[0])
    east, north = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    level = terrain.ground(Reference.given(grid, "level", np.zeros(grid.shape)))
    told = volume.raster(np.stack([east, north, 0 * east + 2], -1), level, np.ones(cells, bool))
    assert told.area_m2 == {0.5: 140_000, 0.25: 560}[cell_m]
    assert told.volume_m3 == pytest.approx(2 * told.area_m2)
    gross_m6 = [
        volume.independent_variance(told, np.broadcast_to(np.eye(3) * (s / 1e3) ** 2, (len(east), 3, 3)))
        for s in sigma_mm
    ]
    assert math.sqrt(volume.net_variance(*gross_m6)) == pytest.approx(net_m3, rel=0.01)


def test_p11_tilt_behind_the_unattended_half_metre():
    for height_m, tilt_deg in ((0.47, 0.0079), (0.62, 0.0104)):
        told_m = uncertainty.sigma_instrument(array(3421.0), math.radians(tilt_deg))[0]
        assert told_m == pytest.approx(height_m, abs=0.005)


def test_p12_point_density():
    step_rad = math.radians(0.01)
    box_1 = beam.point_density(array(BOX_1[0]), np.cos(array(BOX_1[1])), array(1.0), step_rad)
    box_5 = beam.point_density(
        array(BOX_5[0]), np.cos(array(BOX_5[1])), np.cos(np.radians(array(25.0))), step_rad
    )
    assert box_1[0] == pytest.approx(6.0, abs=0.1)
    assert box_5[0] == pytest.approx(1.3, abs=0.1)


def test_geometry_uncertainty_of_box_5():
    """V-18 at 3421 m, incidence 65° on a slope of 25° that faces the scanner: 0.137 m; level beam."""
    seen = array(3421.0), np.cos(np.radians(array(65.0))), np.cos(np.radians(array(25.0)))
    told_m = uncertainty.sigma_geometry(*seen, array(0.0), 0.12e-3)[0]
    assert told_m == pytest.approx(0.137, abs=1e-3)
    # The same from the Gaussian beam, without the paper's third: R β/4 sin θ / cos γ.
    exact_m = math.sqrt(uncertainty.angle_variance(*seen, beam.sigma_beam_angle(0.12e-3))[0])
    assert exact_m == pytest.approx(0.103, abs=1e-3)


def test_published_budget_of_a_cell():
    """V-1 and V-2 by hand for box 5, and V-3 as the linear sum it is."""
    from station.config import ScannerSection
    from station.scanners import SCANNERS

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
