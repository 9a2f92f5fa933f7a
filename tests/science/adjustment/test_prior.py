"""Prior of a scan: line times, inclination log, covariances, and variance components from simulated scans."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import AzimuthTrack, InclinationLog, TiltSeries, VarianceComponents
from station.science.adjustment import prior, variance_components
from station.science.geometry.cyclic_error import NO_CYCLIC_ERROR, CyclicError
from station.science.geometry.inclination import TiltRecord, relative_tilt
from station.science.uncertainty import parameters
from station.science.uncertainty.jacobian import height_jacobian

COMPONENTS = VarianceComponents()
PARAMS = parameters.ParameterLayout(math.radians(20), 30, full_circle=False)
SPEED_RAD_S = math.radians(0.13)


def mount_rotation(heading_deg, tilt_deg, direction_deg=35.0):
    """Rotation from the scanner's frame to the map frame: a heading, then a tilt about a horizontal axis."""
    rotation_deg = tilt_deg * np.array(
        [math.cos(math.radians(direction_deg)), math.sin(math.radians(direction_deg)), 0]
    )
    return (
        Rotation.from_rotvec(rotation_deg, degrees=True) * Rotation.from_euler("z", heading_deg, degrees=True)
    ).as_matrix()


def line_of_sight(to_local, head_azimuth_rad, elevation_rad=0.0):
    """Direction (3, n) in the map frame for head azimuths counter-clockwise from the scanner's x axis."""
    horizontal = np.cos(elevation_rad)
    return to_local @ np.stack(
        [
            horizontal * np.cos(head_azimuth_rad),
            horizontal * np.sin(head_azimuth_rad),
            np.sin(elevation_rad) + 0 * head_azimuth_rad,
        ]
    )


def sector_layout(to_local, head_azimuth_rad):
    """Parameter layout of a sector that contains all head azimuths."""
    full_circle = parameters.ParameterLayout(0.0, 360, full_circle=True, axis=tuple(to_local[:, 2]))
    middle = full_circle.knot_position(tuple(line_of_sight(to_local, np.array([np.mean(head_azimuth_rad)]))))[
        0
    ]
    half_width = math.degrees(np.ptp(head_azimuth_rad)) / 2
    first = math.floor((middle - half_width) / 5) * 5 - 5
    return parameters.ParameterLayout(
        math.radians(first),
        5 * math.ceil((2 * half_width + 15) / 5),
        full_circle=False,
        axis=full_circle.axis,
    )


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
@pytest.mark.parametrize(
    ("first_deg", "last_deg"), [(20.0, 140.0), (-250.0, -130.0), (140.0, 20.0), (300.0, 420.0)]
)
@pytest.mark.parametrize("heading_deg", [0.0, 70.0, 190.0])
def test_line_times_match_the_azimuth_track(tilt_deg, first_deg, last_deg, heading_deg):
    to_local = mount_rotation(heading_deg, tilt_deg)
    head_azimuth_rad = np.radians(np.linspace(first_deg, last_deg, 200))
    time_s = 50 + 900 * np.linspace(0, 1, 200) ** 1.1  # at a slightly uneven speed
    params = sector_layout(to_local, head_azimuth_rad)
    lines = prior.line_times(params, to_local, AzimuthTrack(time_s, head_azimuth_rad))
    for elevation_deg in (-20.0, 0.0, 30.0):
        direction = line_of_sight(to_local, head_azimuth_rad, math.radians(elevation_deg))
        line = parameters.LINE_GROUPS_PER_KNOT * params.knot_position(tuple(direction)) - 0.5
        actual_s = np.interp(line, np.arange(params.line_groups), lines.time_s)
        assert actual_s[1:-1] == pytest.approx(time_s[1:-1], abs=0.3)
    direction = line_of_sight(to_local, lines.azimuth_rad)
    assert params.knot_position(tuple(direction)) * 5 == pytest.approx(np.arange(params.line_groups) + 0.5)


def test_line_times_of_a_full_circle():
    to_local = mount_rotation(40.0, 3.0)
    head_azimuth_rad = np.linspace(math.radians(-200), math.radians(160), 500)
    params = parameters.ParameterLayout(0.0, 360, full_circle=True, axis=tuple(to_local[:, 2]))
    lines = prior.line_times(params, to_local, AzimuthTrack(np.linspace(0, 2400, 500), head_azimuth_rad))
    line = (5 * params.knot_position(tuple(line_of_sight(to_local, head_azimuth_rad)))).astype(int)
    half_s = 0.1 / 0.15
    assert lines.time_s[line][1:-1] == pytest.approx(np.linspace(0, 2400, 500)[1:-1], abs=half_s + 0.01)


def test_line_times_are_extrapolated_outside_the_scan():
    head_azimuth_rad = np.radians(np.linspace(80, 50, 100))
    lines = prior.line_times(PARAMS, np.eye(3), AzimuthTrack(np.linspace(0, 200, 100), head_azimuth_rad))
    assert lines.time_s == pytest.approx((np.radians(80) - lines.azimuth_rad) / np.radians(30 / 200))


def test_line_times_without_a_track_use_the_usual_head_speed():
    lines = prior.line_times(PARAMS, np.eye(3), None)
    assert np.diff(lines.time_s) == pytest.approx(np.full(PARAMS.line_groups - 1, 0.2 / 0.13))
    assert lines.azimuth_rad == pytest.approx(math.pi / 2 - PARAMS.line_azimuth_rad)


def tilt_record(time_s, roll_rad, pitch_rad, noise_rad=1e-4):
    tilt = TiltSeries(time_s, roll_rad, pitch_rad)
    return TiltRecord(tilt, tilt, 0.0, 0.0, noise_rad, noise_rad / 5, 20.0, 0.02, 0.0, 2.5, np.empty((0, 2)))


def elevation_change(head_azimuth_rad, roll_rad, pitch_rad):
    """Change of the elevation of the line of sight by a tilt of the scanner [rad], from rotation matrices."""
    sight = np.stack(
        [np.cos(head_azimuth_rad), np.sin(head_azimuth_rad), np.zeros_like(head_azimuth_rad)], axis=-1
    )
    tilt_rad = np.stack([roll_rad, pitch_rad, np.zeros_like(head_azimuth_rad)], axis=-1)
    return np.arcsin(Rotation.from_rotvec(tilt_rad).apply(sight)[:, 2])


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
@pytest.mark.parametrize("head_direction", [1, -1])
def test_line_inclination_is_the_elevation_change_of_the_line_of_sight(tilt_deg, head_direction):
    to_local = mount_rotation(70.0, tilt_deg)
    head_azimuth_rad = head_direction * np.radians(np.linspace(20, 80, 100))
    track = AzimuthTrack(np.linspace(100, 560, 100), head_azimuth_rad)
    params = sector_layout(to_local, head_azimuth_rad)
    lines = prior.line_times(params, to_local, track)
    time_s = np.arange(80.0, 580.0)
    roll_rad, pitch_rad = 1e-4 + 4e-7 * time_s, -2e-4 + 3e-5 * np.sin(time_s / 150)
    log = prior.line_inclination(
        params, lines, tilt_record(time_s, roll_rad, pitch_rad), NO_CYCLIC_ERROR, to_local
    )
    present = log.weight > 0
    expected = elevation_change(
        lines.azimuth_rad,
        *(np.interp(lines.time_s, time_s, axis) for axis in (roll_rad, pitch_rad)),
    )
    assert np.abs(expected[present]).max() > 1e-4
    assert log.sight_tilt_rad[present] == pytest.approx(expected[present], abs=0.012 * np.abs(expected).max())
    count = log.weight * 1e-8
    assert count == pytest.approx(np.rint(count), abs=1e-6)  # samples per line group, each of variance 1e-8
    outside = (lines.time_s < 79) | (lines.time_s > 580)
    assert not log.weight[outside].any()
    inside = (lines.time_s > 82) & (lines.time_s < 577)
    assert count[inside].sum() == pytest.approx(np.ptp(lines.time_s[inside]), abs=4)


def test_error_modes_of_the_log_are_bias_and_cyclic_errors():
    lines = prior.line_times(PARAMS, np.eye(3), None)
    time_s = np.arange(0.0, 230.0)
    tilt_offset = CyclicError((0.0, 2e-4, 1e-4), (0.0, -1e-4, 3e-4))
    log = prior.line_inclination(
        PARAMS, lines, tilt_record(time_s, 0 * time_s, 0 * time_s), tilt_offset, np.eye(3)
    )
    bias = [
        elevation_change(lines.azimuth_rad, *np.outer(axis, np.ones(PARAMS.line_groups)))
        for axis in 1e-6 * np.eye(2)
    ]
    expected = math.radians(0.0015) * np.array(bias).T / 1e-6
    assert log.error_modes[:, :2] == pytest.approx(expected, rel=1e-6)
    doubled_rad = 2 * PARAMS.line_azimuth_rad
    assert log.error_modes[:, 2:5] / math.radians(0.002) == pytest.approx(
        np.stack([np.ones_like(doubled_rad), np.cos(doubled_rad), np.sin(doubled_rad)], axis=-1)
    )
    assert np.array_equal(log.error_modes[:, 5:], prior.cyclic_error_modes(lines, tilt_offset))


@pytest.mark.parametrize("cyclic_share", [1.0, 0.5])
def test_cyclic_error_modes_are_the_effect_of_a_20_percent_larger_amplitude(cyclic_share):
    """Of an amplitude above 0.05°, only 0.05° are cyclic error; the rest is tilt of the mount."""
    rng = np.random.default_rng(3)
    lines = prior.line_times(parameters.ParameterLayout(0.0, 360, full_circle=True), np.eye(3), None)
    roll, pitch = rng.normal(size=(2, 3))
    size = math.radians(0.05) / cyclic_share
    for wave in (roll, pitch):
        wave[1:] *= size / math.hypot(*wave[1:])
    sight_modes, cross_modes = (
        prior.cyclic_error_modes(lines, CyclicError(tuple(roll), tuple(pitch)), direction_rad)
        for direction_rad in (0.0, math.pi / 2)
    )
    larger = [np.array([wave[0], *(1 + 0.2 * cyclic_share) * wave[1:]]) for wave in (roll, pitch)]
    original = CyclicError(tuple(roll), tuple(pitch)).at(lines.azimuth_rad)
    for column, changed in enumerate(
        (CyclicError(tuple(larger[0]), tuple(pitch)), CyclicError(tuple(roll), tuple(larger[1])))
    ):
        roll_rad, pitch_rad = (a - b for a, b in zip(changed.at(lines.azimuth_rad), original, strict=True))
        sine, cosine = np.sin(lines.azimuth_rad), np.cos(lines.azimuth_rad)
        assert sight_modes[:, column] == pytest.approx(roll_rad * sine - pitch_rad * cosine, abs=1e-12)
        assert cross_modes[:, column] == pytest.approx(roll_rad * cosine + pitch_rad * sine, abs=1e-12)


def test_tilt_covariance_is_the_sum_of_drift_jitter_and_white_noise():
    lines = prior.line_times(PARAMS, np.eye(3), None)
    covariance = prior.tilt_covariance(COMPONENTS, lines)
    drift, jitter, white = np.radians([0.0018, 0.0010, 0.0008]) ** 2
    assert np.diag(covariance) == pytest.approx(drift + jitter + white)
    assert np.linalg.eigvalsh(covariance).min() > 0.9 * white
    assert np.array_equal(covariance, covariance.T)
    separation_s = 0.2 / 0.13 * np.array([1, 10, 100])
    assert covariance[0, [1, 10, 100]] == pytest.approx(
        drift * np.exp(-separation_s / 300) + jitter * np.exp(-separation_s / 3)
    )


@pytest.mark.parametrize(
    "params", [PARAMS, parameters.ParameterLayout(0.0, 360, full_circle=True)], ids=["sector", "full circle"]
)
def test_refraction_is_correlated_over_15_degrees_also_across_north(params):
    covariance = prior.refraction_covariance(COMPONENTS, params)
    assert np.diag(covariance) == pytest.approx(0.02**2)
    assert covariance[0, 3] == pytest.approx(0.02**2 / math.e)
    assert np.linalg.eigvalsh(covariance).min() > 0
    if params.full_circle:
        assert covariance[0, -3] == pytest.approx(0.02**2 / math.e)


def test_range_scale_without_weather_is_less_certain():
    with_weather, without = (
        prior.globals_sigma(COMPONENTS, weather_known=known_weather) for known_weather in (True, False)
    )
    assert with_weather[7] == 0.8
    assert without[7] == pytest.approx(math.hypot(5 * 0.737, 5 * 0.29), rel=0.05)  # 5 K and 5 hPa
    assert np.array_equal(np.delete(with_weather, 7), np.delete(without, 7))


def simulated_estimates(components, count, seed=0):
    """Estimates (u,) drawn from variance components, each with a negligible covariance."""
    rng = np.random.default_rng(seed)
    lines = prior.line_times(PARAMS, np.eye(3), None)
    sigma = prior.globals_sigma(components, weather_known=True)
    covariance = prior.block_diagonal_covariance(
        PARAMS,
        sigma,
        prior.tilt_covariance(components, lines),
        prior.refraction_covariance(components, PARAMS),
        prior.cross_tilt_covariance(components, PARAMS, lines),
    )
    root = np.linalg.cholesky(covariance)
    return [(lines, root @ rng.normal(size=len(root)), 1e-6 * covariance) for _ in range(count)]


def test_components_of_twice_the_sigma_are_estimated():
    actual_components = VarianceComponents(**{name: 2 * value for name, value in vars(COMPONENTS).items()})
    actual = variance_components.estimate_variance_components(
        COMPONENTS, PARAMS, simulated_estimates(actual_components, 40)
    )
    for name in variance_components.TILT_COMPONENTS:
        assert getattr(actual, name) / getattr(COMPONENTS, name) == pytest.approx(2, rel=0.25)
    ratio = np.array([getattr(actual, name) / value for name, value in vars(COMPONENTS).items()])
    assert ratio == pytest.approx(2, rel=0.35)  # the others have 1 to 3 values per scan: 40 to 120 draws
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.87, rel=0.08)  # start values weigh eight scans


def test_correct_start_values_are_confirmed():
    actual = variance_components.estimate_variance_components(
        COMPONENTS, PARAMS, simulated_estimates(COMPONENTS, 40)
    )
    for name, value in vars(COMPONENTS).items():
        assert getattr(actual, name) == pytest.approx(value, rel=0.25)


@pytest.mark.parametrize("count", [0, 1])
def test_a_single_scan_leaves_the_start_values_unchanged(count):
    assert (
        variance_components.estimate_variance_components(
            COMPONENTS, PARAMS, simulated_estimates(replace(COMPONENTS, tilt_rad=1.0), count)
        )
        == COMPONENTS
    )


def test_posterior_variance_counts_in_the_estimate_of_components():
    """Scans without observations have zero estimates and the prior as their covariance."""
    lines = prior.line_times(PARAMS, np.eye(3), None)
    sigma = prior.globals_sigma(COMPONENTS, weather_known=True)
    covariance = prior.block_diagonal_covariance(
        PARAMS,
        sigma,
        prior.tilt_covariance(COMPONENTS, lines),
        prior.refraction_covariance(COMPONENTS, PARAMS),
        prior.cross_tilt_covariance(COMPONENTS, PARAMS, lines),
    )
    unobserved = [(lines, np.zeros(len(covariance)), covariance)] * 80
    for name, value in vars(
        variance_components.estimate_variance_components(COMPONENTS, PARAMS, unobserved)
    ).items():
        assert value == pytest.approx(getattr(COMPONENTS, name), rel=0.01)


def test_refraction_over_ice_that_grows_from_scan_to_scan_is_melt_not_weather():
    """Melt of 2 cm an hour looks like refraction that grows by 0.02 a scan, forty times its scatter."""
    scans = simulated_estimates(COMPONENTS, 40)
    components = []
    for slope in (0.0, 0.02):
        for index, (_, estimate, _) in enumerate(scans):
            estimate[variance_components.ICE] += slope * index
        components.append(variance_components.estimate_variance_components(COMPONENTS, PARAMS, scans))
    for name, value in vars(components[0]).items():
        assert getattr(components[1], name) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("name", ["tilt_jitter_rad", "line_jitter_rad"])
def test_tilt_components_are_separated(name):
    actual_components = replace(COMPONENTS, **{name: 2 * getattr(COMPONENTS, name)})
    actual = variance_components.estimate_variance_components(
        COMPONENTS, PARAMS, simulated_estimates(actual_components, 40)
    )
    for component in variance_components.TILT_COMPONENTS:
        expected = 1.87 if component == name else 1.0
        assert getattr(actual, component) / getattr(COMPONENTS, component) == pytest.approx(expected, rel=0.2)


def test_log_only_covariance_is_valid_and_smaller_with_a_log():
    lines = prior.line_times(PARAMS, np.eye(3), None)
    time_s = np.arange(0.0, 240.0)
    tilt_offset = CyclicError((0.0, 3e-4, 0.0), (0.0, 0.0, 3e-4))
    record = tilt_record(time_s, 0 * time_s, 0 * time_s, noise_rad=math.radians(0.008))
    record = replace(record, filtered_noise_rad=math.radians(0.008) / math.sqrt(20))
    rng = np.random.default_rng(5)
    azimuth, range_m = rng.uniform(np.radians(20), np.radians(50), 300), rng.uniform(500, 3000, 300)
    offset_m = range_m * np.sin(azimuth), range_m * np.cos(azimuth), rng.uniform(-300, 300, 300)
    jacobian = height_jacobian(PARAMS, offset_m, *rng.uniform(-0.3, 0.3, (2, 300)))
    with_log, without = (
        prior.log_only_covariance(PARAMS, lines, used_record, tilt_offset, COMPONENTS, weather_known=True)
        for used_record in (record, None)
    )
    for shared in (with_log, without):
        sigma = np.sqrt(np.diag(shared.covariance))
        assert np.linalg.eigvalsh(shared.covariance / np.outer(sigma, sigma)).min() > -1e-9
        assert shared.covariance == pytest.approx(shared.covariance.T, rel=1e-9)
        assert (shared.line_tilt_variance >= 0).all()
        assert not shared.estimate.any()
        assert len(shared.names) == len(shared.estimate) == len(shared.line_tilt_variance)
    assert (jacobian.variance(with_log) < jacobian.variance(without)).all()
    assert jacobian.variance(with_log).mean() < 0.5 * jacobian.variance(without).mean()


SCAN_S = 1791.0
TILT_ONLY = replace(
    COMPONENTS, heading_rad=1e-9, translation_m=1e-6, range_bias_m=1e-6, range_scale_ppm=1e-6,
    refraction=1e-6, refraction_by_azimuth=1e-9,
)  # fmt: skip


def true_motion(rng, time_s, scale):
    """Tilt of the mount (2, n) [°]: a random walk and a sinusoid, not the process that the prior assumes."""
    walk = np.cumsum(rng.normal(0, 0.0022 / math.sqrt(SCAN_S), (2, len(time_s))), axis=1)
    period_s, phase = rng.uniform(500, 2500, (2, 1)), rng.uniform(0, 2 * math.pi, (2, 1))
    return scale * (walk + 0.0015 * np.sin(2 * math.pi * time_s / period_s + phase))


def heights_after_a_faulty_log(rng, keep, mode, scale):
    """Height errors [m] of points on unchanged ground, their sigma, and whether the log has samples there.

    The points are rotated by the true and by the applied tilt with SciPy. In absolute mode the log holds a
    wave of 0.03° to 0.05° over the turn, which belongs to the tilt.
    """
    params = parameters.ParameterLayout(0.0, 120, full_circle=False)
    track = AzimuthTrack(np.linspace(0, SCAN_S, 400), np.radians(90 - np.linspace(1, 119, 400)))
    time_s = np.arange(-5.0, SCAN_S + 5)
    azimuth_rad = np.interp(time_s, track.time_s, track.azimuth_rad)
    phase_rad, amplitude_deg = rng.uniform(0, 2 * math.pi, 2), rng.uniform(0.03, 0.05, 2)
    wave_deg = amplitude_deg[:, None] * np.cos(azimuth_rad - phase_rad[:, None])
    tilt_deg = true_motion(rng, time_s, scale) + rng.normal(0, 0.007, (2, 1))
    sway_deg = rng.normal(0, 0.001, (2, len(time_s)))
    sensor_deg = rng.normal(0, 0.008, (2, len(time_s))) + rng.normal(0, 0.0015, (2, 1))
    if mode == "absolute":
        tilt_offset, tilt_deg = NO_CYCLIC_ERROR, tilt_deg + wave_deg
    else:
        cosine, sine = (
            np.radians(amplitude_deg) * np.cos(phase_rad),
            np.radians(amplitude_deg) * np.sin(phase_rad),
        )
        tilt_offset = CyclicError((0.0, cosine[0], sine[0]), (0.0, cosine[1], sine[1]))
        sensor_deg += wave_deg * (1 + 0.2 * rng.standard_normal((2, 1)))
    roll_rad, pitch_rad = np.radians(tilt_deg + sway_deg + sensor_deg)
    kept = keep(time_s)
    log = InclinationLog(time_s[kept], roll_rad[kept], pitch_rad[kept])
    record = relative_tilt(log, track, tilt_offset, math.radians(0.008)) if kept.any() else None

    north_azimuth_rad, range_m = np.radians(rng.uniform(2, 118, 300)), rng.uniform(500, 3000, 300)
    offset_m = range_m * np.sin(north_azimuth_rad), range_m * np.cos(north_azimuth_rad), np.full(300, -200.0)
    shot_s = np.interp(-north_azimuth_rad, -(math.pi / 2 - track.azimuth_rad)[::-1], track.time_s[::-1])
    true_rad = np.radians([np.interp(shot_s, time_s, axis) for axis in tilt_deg + sway_deg])
    applied_rad = np.zeros((2, 300))
    if record is not None:
        applied_rad = np.array(
            [
                np.interp(shot_s, record.tilt.time_s, axis)
                for axis in (record.tilt.roll_rad, record.tilt.pitch_rad)
            ]
        )
    rotated_m = [
        Rotation.from_rotvec(np.vstack([tilt_rad, np.zeros(300)]).T).apply(np.array(offset_m).T)[:, 2]
        for tilt_rad in (true_rad, applied_rad)
    ]
    line = (np.degrees(north_azimuth_rad) * 5).astype(int)
    constant, cosine, sine = np.radians(0.002) * rng.standard_normal(3)
    sensor_rad = (
        constant + cosine * np.cos(2 * north_azimuth_rad) + sine * np.sin(2 * north_azimuth_rad)
    ) / 2**0.5
    line_rad = np.radians(0.0008) * rng.standard_normal(600)[line] + (
        sensor_rad if record is not None else 0.0
    )
    lines = prior.line_times(params, np.eye(3), track)
    shared = prior.log_only_covariance(params, lines, record, tilt_offset, TILT_ONLY, weather_known=True)
    sigma_m = np.sqrt(height_jacobian(params, offset_m, np.zeros(300), np.zeros(300)).variance(shared))
    return rotated_m[0] - rotated_m[1] + range_m * line_rad, sigma_m, keep(shot_s)


LOG_FAULTS = {
    "ends early": lambda time_s: time_s < 299,
    "begins late": lambda time_s: time_s > 1200,
    "gap": lambda time_s: (time_s < 500) | (time_s > 1300),
    "missing": lambda time_s: np.zeros(len(time_s), bool),
}


@pytest.mark.integration
@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize(
    ("mode", "fault"),
    [*(("relative", fault) for fault in LOG_FAULTS), ("absolute", "ends early"), ("absolute", "begins late")],
)
def test_sigma_covers_the_motion_that_a_faulty_log_misses(mode, fault, scale):
    """Change over sigma where the log has no samples; twice the motion that the components expect, too."""
    rng = np.random.default_rng(11)
    z = []
    for _ in range(60):
        error_m, sigma_m, sampled = heights_after_a_faulty_log(rng, LOG_FAULTS[fault], mode, scale)
        z.append((error_m / sigma_m)[~sampled])
    assert 0.8 < np.sqrt(np.mean(np.square(np.concatenate(z)))) < 1.25


@pytest.mark.parametrize(
    ("mode", "fault", "factor"),
    [
        ("relative", "ends early", 1.1),
        ("relative", "gap", 1.04),
        ("absolute", "ends early", 5.0),
        ("absolute", "gap", 2.0),
    ],
)
def test_sigma_is_wider_where_the_log_has_no_samples(mode, fault, factor):
    """Little in relative mode, where a fifth of the cyclic error is unknown in any case."""
    _, full_m, _ = heights_after_a_faulty_log(np.random.default_rng(3), lambda t: t < 1e9, mode, 1.0)
    _, faulty_m, sampled = heights_after_a_faulty_log(np.random.default_rng(3), LOG_FAULTS[fault], mode, 1.0)
    ratio = faulty_m / full_m
    assert np.median(ratio[sampled]) == pytest.approx(1.0, abs=0.1)
    assert factor < np.median(ratio[~sampled]) < 2 * factor


@pytest.mark.parametrize("ends_early_s", [37.5, 307.5, 1102.5])
def test_variance_grows_with_the_time_since_the_last_sample(ends_early_s):
    """By 2 σ² (1 - e^(-Δt / 300 s)); the log of 600 s saw no drift and counts as much as the component."""
    params = parameters.ParameterLayout(0.0, 120, full_circle=False)
    track = AzimuthTrack(np.linspace(0, 1800, 400), np.radians(np.linspace(90, -30, 400)))
    time_s = np.arange(0.0, 601.0)
    log = tilt_record(time_s, 0 * time_s, 0 * time_s, noise_rad=1e-8)
    lines = prior.line_times(params, np.eye(3), track)
    shared = prior.log_only_covariance(
        params, lines, log, CyclicError((1e-9, 0.0, 0.0), (0.0, 0.0, 0.0)), TILT_ONLY, weather_known=True
    )
    azimuth_rad = np.radians(np.array([307.5, 600.0 + ends_early_s]) * 120 / 1800)  # between knots
    offset_m = 1000 * np.sin(azimuth_rad), 1000 * np.cos(azimuth_rad), np.zeros(2)
    within_m2, beyond_m2 = height_jacobian(params, offset_m, np.zeros(2), np.zeros(2)).variance(shared)
    drift_rad2 = math.radians(0.0018) ** 2 / 2
    expected_m2 = 1000**2 * 2 * drift_rad2 * (1 - math.exp(-ends_early_s / 300))
    assert beyond_m2 - within_m2 == pytest.approx(expected_m2, rel=0.06)


@pytest.mark.parametrize("keep", [lambda t: (t < 100) | (t > 160), lambda t: t < 100, lambda t: t > 100])
def test_lines_without_samples_have_no_weight_in_the_adjustment(keep):
    """A bridged gap is no observation."""
    params = parameters.ParameterLayout(0.0, 30, full_circle=False)
    track = AzimuthTrack(np.linspace(0, 230, 100), np.radians(np.linspace(90, 60, 100)))
    time_s = np.arange(-5.0, 235.0)
    time_s = time_s[keep(time_s)]
    record = relative_tilt(InclinationLog(time_s, 0 * time_s, 0 * time_s), track, NO_CYCLIC_ERROR, 1e-4)
    lines = prior.line_times(params, np.eye(3), track)
    log = prior.line_inclination(params, lines, record, NO_CYCLIC_ERROR, np.eye(3))
    sampled = keep(lines.time_s + 1) & keep(lines.time_s - 1)  # line groups last 1.5 s
    unsampled = ~keep(lines.time_s + 1) & ~keep(lines.time_s - 1)
    assert (log.weight[sampled] > 0).all()
    assert not log.weight[unsampled].any()
    assert unsampled.sum() > 20


def test_cross_tilt_is_correlated_like_tilt_drift():
    """The head takes 5 / 0.13 s between knots; tilt drift has a correlation time of 300 s."""
    lines = prior.line_times(PARAMS, np.eye(3), None)
    covariance = prior.cross_tilt_covariance(COMPONENTS, PARAMS, lines)
    assert covariance.shape == (PARAMS.refraction_knots,) * 2
    assert np.diag(covariance) == pytest.approx(COMPONENTS.tilt_drift_rad**2)
    correlation = covariance[1:-2, 2:-1].diagonal() / COMPONENTS.tilt_drift_rad**2
    assert correlation == pytest.approx(math.exp(-5 / 0.13 / 300), rel=1e-6)


def test_tilt_correlations_fall_to_1_over_e_after_300_s_and_3_s():
    """The memories of drift and jitter in the joint adjustment; line jitter has none."""
    lines = prior.LineTimes(np.zeros(3), np.array([0.0, 3.0, 300.0]))
    drift, jitter, line = prior.tilt_correlations(lines)
    assert drift[0, 2] == jitter[0, 1] == pytest.approx(0.36788, abs=1e-5)
    assert np.array_equal(line, np.eye(3))


def test_usual_motion_grows_with_the_root_of_time():
    """Of a mount that moves by 0.01° in a day and 0.05° in a season of 100 days (adjustment.md, 4)."""
    day, season = (variance_components.after(COMPONENTS, 86_400.0 * days) for days in (1, 100))
    assert math.degrees(day.tilt_rad) == pytest.approx(0.0094, abs=1e-4)
    assert math.degrees(season.tilt_rad) == pytest.approx(0.0506, abs=1e-4)
    assert season.range_bias_m == COMPONENTS.range_bias_m
    assert variance_components.after(COMPONENTS, 0.0) == COMPONENTS


def test_a_prior_is_widened_by_unusual_motion_only():
    usual, moved = np.zeros(20), np.zeros(20)
    usual[:6] = COMPONENTS.tilt_rad, 0.0, 0.0, COMPONENTS.translation_m, 0.0, 0.0
    moved[:6] = 3 * COMPONENTS.tilt_rad, 4 * COMPONENTS.tilt_rad, 0.0, 0.0, 0.0, 0.0
    assert variance_components.as_wide_as(COMPONENTS, usual) == COMPONENTS
    widened = variance_components.as_wide_as(COMPONENTS, moved)
    assert widened == replace(COMPONENTS, tilt_rad=pytest.approx(5 * COMPONENTS.tilt_rad))
