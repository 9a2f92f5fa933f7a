"""Precision of ranges and angles, estimated from simulated scans of known noise."""

from dataclasses import replace

import numpy as np
import pytest

from station.science.analysis import precision
from station.science.geometry import beam
from station.simulation.station import Station, small

ANGLE_RAD = 2e-5


def simulate_planes(sigma_m, *, count=400, shots=60, seed=3):
    """Shots on small planes at random ranges and incidences, with range noise by intensity."""
    rng = np.random.default_rng(seed)
    points, intensities = [], []
    for _ in range(count):
        range_m, incidence, rotation = (
            rng.uniform(20, 800),
            np.radians(rng.uniform(0, 75)),
            rng.uniform(0, 6.28),
        )
        intensity = rng.uniform(0.02, 1)
        centre_rad = rng.uniform(-0.5, 0.5), rng.uniform(-3, 3)
        elevation, azimuth = (middle + rng.uniform(-2e-3, 2e-3, shots) for middle in centre_rad)
        sight = beam.cartesian(np.ones(1), *np.array(centre_rad)[:, None])[0]
        horizontal = np.cross(sight, [0, 0, 1])
        horizontal /= np.linalg.norm(horizontal)
        across = np.cos(rotation) * horizontal + np.sin(rotation) * np.cross(horizontal, sight)
        normal = np.cos(incidence) * sight + np.sin(incidence) * across
        angle_error = ANGLE_RAD * rng.normal(size=(2, shots))
        true_sight = beam.cartesian(
            np.ones(shots), elevation + angle_error[0], azimuth + angle_error[1] / np.cos(elevation)
        )
        measured_m = range_m * (sight @ normal) / (true_sight @ normal) + sigma_m(intensity) * rng.normal(
            size=shots
        )
        points.append(beam.cartesian(measured_m, elevation, azimuth))
        intensities.append(np.full(shots, intensity))
    return np.concatenate(points), np.concatenate(intensities)


def test_range_noise_by_intensity_and_angle_noise_are_estimated():
    def sigma_m(intensity):
        return 0.0008 * intensity**-0.7 + 0.002

    model = precision.fit_range_model(precision.find_planes(*simulate_planes(sigma_m), window_rad=0.02))
    for intensity in (0.05, 0.2, 0.5, 1.0):
        assert model.sigma_m(intensity) == pytest.approx(sigma_m(intensity), rel=0.08)
    assert model.sigma_angle_rad == pytest.approx(ANGLE_RAD, rel=0.1)
    assert model.typical_m == pytest.approx(sigma_m(0.5), rel=0.06)
    assert model.typical_error < 0.05


def test_rough_ground_is_distinguished_from_noise():
    """Bumps of 5 cm, a metre long, at 100 m are noisier in wider windows; a flat wall is not."""
    rng = np.random.default_rng(9)
    elevation, azimuth = rng.uniform(-0.05, 0.05, (2, 60_000))
    for bumps_m, rough in ((0.05, True), (0.0, False)):
        range_m = 100 / np.cos(azimuth) / np.cos(elevation) + 0.005 * rng.normal(size=60_000)
        range_m += bumps_m * np.sin(600 * azimuth) * np.cos(700 * elevation)
        xyz_m = beam.cartesian(range_m, elevation, azimuth)
        width_rad = precision.window_width(xyz_m)
        models = [
            precision.fit_range_model(precision.find_planes(xyz_m, np.ones(60_000), width))
            for width in (width_rad, 1.7 * width_rad)
        ]
        assert precision.is_surface_rough(*models) == rough


def test_scans_without_intensity_have_constant_range_noise():
    xyz_m, intensities = simulate_planes(lambda _: 0.005, seed=4)
    model = precision.fit_range_model(precision.find_planes(xyz_m, np.ones_like(intensities), 0.02))
    assert (model.a_m, model.typical_m) == (0.0, pytest.approx(0.005, rel=0.05))
    assert precision.fit_range_model(precision.find_planes(xyz_m[:600], intensities[:600], 0.02)) is None


def test_range_sigma_is_the_residual_over_the_cosine_of_incidence():
    """Range noise of 5 mm at incidences of 0°, 30° and 60°."""
    rng = np.random.default_rng(5)
    for incidence in np.radians((0.0, 30.0, 60.0)):
        elevation, azimuth = rng.uniform(-0.004, 0.004, (2, 5000))
        sight = beam.cartesian(np.ones(5000), elevation, azimuth)
        normal = np.array([np.cos(incidence), 0.0, np.sin(incidence)])
        plane_m = 50 * normal[0] / (sight @ normal)
        xyz_m = beam.cartesian(plane_m + 0.005 * rng.normal(size=5000), elevation, azimuth)
        planes = precision.find_planes(xyz_m, np.ones(5000), 0.01)
        assert np.median(planes.residual_m) == pytest.approx(0.005 * np.cos(incidence), rel=0.05)
        assert np.median(planes.sigma_range_m) == pytest.approx(0.005, rel=0.05)
        assert precision.sigma_range(np.array(1.0), np.cos(incidence)) == pytest.approx(1 / np.cos(incidence))


def test_a_window_contains_thirty_shots():
    elevation, azimuth = np.random.default_rng(6).uniform((-0.5, 0), (0.2, 1.5), (200_000, 2)).T
    xyz_m = beam.cartesian(np.full(200_000, 100.0), elevation, azimuth)
    windows = np.stack([np.floor(azimuth * np.cos(elevation) / (width := precision.window_width(xyz_m))),
                        np.floor(elevation / width)])  # fmt: skip
    assert np.median(np.unique(windows, axis=1, return_counts=True)[1]) == pytest.approx(30, rel=0.25)


def test_sigma_by_class_shows_the_dependence_on_intensity():
    rows = precision.sigma_by_class(
        precision.find_planes(*simulate_planes(lambda i: 0.002 / i), window_rad=0.02)
    )
    by_intensity = [row["sigma_range_m"] for row in rows if row["by"] == "intensity"]
    assert len(by_intensity) == 4
    assert by_intensity[0] > 2 * by_intensity[-1]
    assert {row["by"] for row in rows} == {"range_m", "incidence_deg", "intensity"}


@pytest.mark.parametrize(("range_noise_m", "divergence_mrad"), [(0.010, 0.12), (0.020, 0.30)])
def test_noise_of_a_simulated_scanner_is_estimated(range_noise_m, divergence_mrad):
    """Rock at 200-360 m and 50-75° incidence: range noise and beam width are separated."""
    scenario = replace(
        small(hours=1), azimuth_deg=(150.0, 160.0), elevation_deg=(-30.0, -15.0),
        lines=300, shots_per_line=450, terrain_step_m=8.0, roughness_m=0.0, line_jitter_deg=0.0,
        range_noise_m=range_noise_m, beam_divergence_mrad=divergence_mrad,
    )  # fmt: skip
    shot = Station(scenario).scan(0)
    xyz_m = np.stack([shot.x_m, shot.y_m, shot.z_m], axis=1)
    model = precision.fit_range_model(
        precision.find_planes(xyz_m, shot.intensity, precision.window_width(xyz_m))
    )
    assert model.typical_m == pytest.approx(range_noise_m, rel=0.12)
    assert model.typical_error < 0.1
    assert model.sigma_angle_rad == pytest.approx(divergence_mrad * 1e-3 / 4, rel=0.15)


STEP_RAD = np.radians(0.01)


def simulate_lines(noise_rad, seed, *, lost_share=0.05, upward=True):
    """A scan with random start angles of head and mirror, angle noise and missing echoes."""
    rng = np.random.default_rng(seed)
    lines, shots = np.divmod(np.arange(60 * 250), 250)
    elevation = STEP_RAD * (shots + rng.uniform(0, 1, 60)[lines]) * (1 if upward else -1)
    azimuth = STEP_RAD * (lines + rng.uniform(0, 1))
    elevation, azimuth = (angle + noise_rad * rng.normal(size=len(angle)) for angle in (elevation, azimuth))
    return beam.cartesian(np.full(len(lines), 300.0), elevation, azimuth)[
        rng.uniform(size=len(lines)) > lost_share
    ]


@pytest.mark.parametrize("noise_rad", [1e-6, 5e-6, 1e-5])
@pytest.mark.parametrize("upward", [True, False])
def test_angle_noise_and_sampling_are_separated(noise_rad, upward):
    angles = precision.angle_precision(
        simulate_lines(noise_rad, 1, upward=upward), simulate_lines(noise_rad, 2, upward=upward)
    )
    for angle in angles:
        assert angle.precision_rad == pytest.approx(noise_rad, rel=0.05)
        assert angle.step_rad == pytest.approx(STEP_RAD, rel=1e-3)
        assert angle.observed_rad**2 == pytest.approx(angle.sampling_rad**2 + angle.precision_rad**2)
    # The first elevation of a line is random within a step: two scans differ by half a step at most.
    elevation = angles[0]
    assert elevation.sampling_rad == pytest.approx(STEP_RAD / np.sqrt(24), rel=0.15)
    assert elevation.observed_rad > 3 * noise_rad


def test_scans_without_common_lines_give_no_precision():
    assert precision.angle_precision(simulate_lines(0.0, 1)[:50], simulate_lines(0.0, 2)[:50]) is None
    assert precision.angle_precision(simulate_lines(0.0, 1)[:3], simulate_lines(0.0, 2)) is None
