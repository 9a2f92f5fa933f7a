"""Noise of ranges and angles, found where it is known."""

from dataclasses import replace

import numpy as np
import pytest

from station.science import beam, precision
from station.simulation.station import Station, tiny

ANGLE_RAD = 2e-5


def walls(sigma_m, *, count=400, shots=60, seed=3):
    """Small planes all round at any range and incidence, whose noise is by their intensity."""
    rng = np.random.default_rng(seed)
    points, bright = [], []
    for _ in range(count):
        range_m, incidence, turn = rng.uniform(20, 800), np.radians(rng.uniform(0, 75)), rng.uniform(0, 6.28)
        intensity = rng.uniform(0.02, 1)
        at = rng.uniform(-0.5, 0.5), rng.uniform(-3, 3)
        elevation, azimuth = (middle + rng.uniform(-2e-3, 2e-3, shots) for middle in at)
        towards = beam.cartesian(np.ones(1), *np.array(at)[:, None])[0]
        side = np.cross(towards, [0, 0, 1])
        side /= np.linalg.norm(side)
        across = np.cos(turn) * side + np.sin(turn) * np.cross(side, towards)
        normal = np.cos(incidence) * towards + np.sin(incidence) * across
        off = ANGLE_RAD * rng.normal(size=(2, shots))
        truly = beam.cartesian(np.ones(shots), elevation + off[0], azimuth + off[1] / np.cos(elevation))
        measured_m = range_m * (towards @ normal) / (truly @ normal) + sigma_m(intensity) * rng.normal(
            size=shots
        )
        points.append(beam.cartesian(measured_m, elevation, azimuth))
        bright.append(np.full(shots, intensity))
    return np.concatenate(points), np.concatenate(bright)


def test_range_noise_by_intensity_and_angle_noise_are_found():
    def sigma_m(intensity):
        return 0.0008 * intensity**-0.7 + 0.002

    model = precision.fit_range_model(precision.find_planes(*walls(sigma_m), window_rad=0.02))
    for intensity in (0.05, 0.2, 0.5, 1.0):
        assert model.sigma_m(intensity) == pytest.approx(sigma_m(intensity), rel=0.08)
    assert model.sigma_angle_rad == pytest.approx(ANGLE_RAD, rel=0.1)
    assert model.typical_m == pytest.approx(sigma_m(0.5), rel=0.06)
    assert model.typical_error < 0.05


def test_rough_ground_is_not_taken_for_noise():
    """Bumps of 5 cm, a metre long, at 100 m: wider windows find them noisier. A wall stays as it is."""
    rng = np.random.default_rng(9)
    elevation, azimuth = rng.uniform(-0.05, 0.05, (2, 60_000))
    for bumps_m, rough in ((0.05, True), (0.0, False)):
        range_m = 100 / np.cos(azimuth) / np.cos(elevation) + 0.005 * rng.normal(size=60_000)
        range_m += bumps_m * np.sin(600 * azimuth) * np.cos(700 * elevation)
        xyz_m = beam.cartesian(range_m, elevation, azimuth)
        width_rad = precision.window_for(xyz_m)
        models = [
            precision.fit_range_model(precision.find_planes(xyz_m, np.ones(60_000), width))
            for width in (width_rad, 1.7 * width_rad)
        ]
        assert precision.is_rough(*models) == rough


def test_scans_without_intensity_have_one_range_noise():
    xyz_m, bright = walls(lambda _: 0.005, seed=4)
    model = precision.fit_range_model(precision.find_planes(xyz_m, np.ones_like(bright), 0.02))
    assert (model.a_m, model.typical_m) == (0.0, pytest.approx(0.005, rel=0.05))
    assert precision.fit_range_model(precision.find_planes(xyz_m[:600], bright[:600], 0.02)) is None


def test_residuals_across_a_plane_are_less_than_those_of_the_range():
    """Of ranges alone, 5 mm: straight on, at 30° and at 60°."""
    rng = np.random.default_rng(5)
    for incidence in np.radians((0.0, 30.0, 60.0)):
        elevation, azimuth = rng.uniform(-0.004, 0.004, (2, 5000))
        towards = beam.cartesian(np.ones(5000), elevation, azimuth)
        normal = np.array([np.cos(incidence), 0.0, np.sin(incidence)])
        plane_m = 50 * normal[0] / (towards @ normal)
        xyz_m = beam.cartesian(plane_m + 0.005 * rng.normal(size=5000), elevation, azimuth)
        found = precision.find_planes(xyz_m, np.ones(5000), 0.01)
        assert np.median(found.residual_m) == pytest.approx(0.005 * np.cos(incidence), rel=0.05)
        assert np.median(found.sigma_range_m) == pytest.approx(0.005, rel=0.05)
        assert precision.sigma_range(np.array(1.0), np.cos(incidence)) == pytest.approx(1 / np.cos(incidence))


def test_a_window_holds_thirty_shots():
    elevation, azimuth = np.random.default_rng(6).uniform((-0.5, 0), (0.2, 1.5), (200_000, 2)).T
    xyz_m = beam.cartesian(np.full(200_000, 100.0), elevation, azimuth)
    windows = np.stack([np.floor(azimuth * np.cos(elevation) / (width := precision.window_for(xyz_m))),
                        np.floor(elevation / width)])  # fmt: skip
    assert np.median(np.unique(windows, axis=1, return_counts=True)[1]) == pytest.approx(30, rel=0.25)


def test_classes_of_planes_tell_what_the_noise_hangs_on():
    told = precision.by_class(precision.find_planes(*walls(lambda i: 0.002 / i), window_rad=0.02))
    by_intensity = [row["sigma_range_m"] for row in told if row["by"] == "intensity"]
    assert len(by_intensity) == 4
    assert by_intensity[0] > 2 * by_intensity[-1]
    assert {row["by"] for row in told} == {"range_m", "incidence_deg", "intensity"}


@pytest.mark.parametrize(("range_noise_m", "divergence_mrad"), [(0.010, 0.12), (0.020, 0.30)])
def test_noise_of_a_simulated_scanner(range_noise_m, divergence_mrad):
    """Rock at 200-360 m, seen at 50-75°: the noise of ranges and the beam's width are told apart."""
    scenario = replace(
        tiny(hours=1), azimuth_deg=(150.0, 160.0), elevation_deg=(-30.0, -15.0),
        lines=300, shots_per_line=450, terrain_step_m=8.0, roughness_m=0.0, line_jitter_deg=0.0,
        range_noise_m=range_noise_m, beam_divergence_mrad=divergence_mrad,
    )  # fmt: skip
    shot = Station(scenario).scan(0)
    xyz_m = np.stack([shot.x_m, shot.y_m, shot.z_m], axis=1)
    model = precision.fit_range_model(
        precision.find_planes(xyz_m, shot.brightness, precision.window_for(xyz_m))
    )
    assert model.typical_m == pytest.approx(range_noise_m, rel=0.12)
    assert model.typical_error < 0.1
    assert model.sigma_angle_rad == pytest.approx(divergence_mrad * 1e-3 / 4, rel=0.15)


STEP_RAD = np.radians(0.01)


def scanned(noise_rad, seed, *, lost=0.05, upward=True):
    """A scan whose head and mirror begin anywhere, with angles read with noise, and echoes lost."""
    rng = np.random.default_rng(seed)
    lines, shots = np.divmod(np.arange(60 * 250), 250)
    elevation = STEP_RAD * (shots + rng.uniform(0, 1, 60)[lines]) * (1 if upward else -1)
    azimuth = STEP_RAD * (lines + rng.uniform(0, 1))
    elevation, azimuth = (angle + noise_rad * rng.normal(size=len(angle)) for angle in (elevation, azimuth))
    return beam.cartesian(np.full(len(lines), 300.0), elevation, azimuth)[rng.uniform(size=len(lines)) > lost]


@pytest.mark.parametrize("noise_rad", [1e-6, 5e-6, 1e-5])
@pytest.mark.parametrize("upward", [True, False])
def test_angle_noise_and_sampling_are_told_apart(noise_rad, upward):
    found = precision.angle_precision(
        scanned(noise_rad, 1, upward=upward), scanned(noise_rad, 2, upward=upward)
    )
    for one in found:
        assert one.precision_rad == pytest.approx(noise_rad, rel=0.05)
        assert one.step_rad == pytest.approx(STEP_RAD, rel=1e-3)
        assert one.observed_rad**2 == pytest.approx(one.sampling_rad**2 + one.precision_rad**2)
    # Elevations begin anywhere in a step on each line: two scans differ by half a step at most.
    assert found[0].sampling_rad == pytest.approx(STEP_RAD / np.sqrt(24), rel=0.15)
    assert found[0].observed_rad > 3 * noise_rad


def test_scans_without_lines_in_common_say_nothing():
    assert precision.angle_precision(scanned(0.0, 1)[:50], scanned(0.0, 2)[:50]) is None
    assert precision.angle_precision(scanned(0.0, 1)[:3], scanned(0.0, 2)) is None
