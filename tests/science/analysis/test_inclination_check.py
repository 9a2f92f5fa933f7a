"""Check of the inclination log against the ground: dense estimates without the log, simulated scans."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.quantities import VarianceComponents
from station.science.adjustment import prior
from station.science.adjustment.joint import Adjustment
from station.science.adjustment.normal_equations import LineInclination
from station.science.analysis import inclination_check
from station.science.geometry.cyclic_error import CyclicError
from station.science.uncertainty.parameters import GLOBAL, ParameterLayout

PARAMS = ParameterLayout(math.radians(60.0), 120, full_circle=False)  # 600 line groups
LINES = prior.LineTimes(
    -PARAMS.line_azimuth_rad, 17.0 + 1.3 * np.arange(PARAMS.line_groups)[::-1]
)  # counter-clockwise
COMPONENTS = VarianceComponents()
STRONG_JITTER = replace(COMPONENTS, tilt_jitter_rad=math.radians(0.003))
AMPLITUDE_RAD = math.radians(0.035)
TILT_OFFSET = CyclicError((0.0, AMPLITUDE_RAD, 0.0), (0.0, AMPLITUDE_RAD, 0.0))
GROUND_RAD, NOISE_RAD = math.radians(0.0006), math.radians(0.007)
REFERENCE_SCANS = 200  # scans in the reference
LINE_TILT = slice(len(GLOBAL), len(GLOBAL) + PARAMS.line_groups)
LINE_DESIGN = np.zeros((PARAMS.line_groups, len(GLOBAL) + PARAMS.line_groups + 2 * PARAMS.refraction_knots))
LINE_DESIGN[:, 0], LINE_DESIGN[:, 1] = np.cos(PARAMS.line_azimuth_rad), -np.sin(PARAMS.line_azimuth_rad)
LINE_DESIGN[:, LINE_TILT] = np.eye(PARAMS.line_groups)
ERROR_MODES = np.concatenate(
    [
        np.stack([np.cos(PARAMS.line_azimuth_rad), -np.sin(PARAMS.line_azimuth_rad)], axis=-1)
        * prior.SENSOR_BIAS_RAD,
        prior.cyclic_error_modes(LINES, TILT_OFFSET),
    ],
    axis=1,
)


class Scan:
    """A simulated scan: tilt drawn from the variance components, and the tilt that the ground shows."""

    def __init__(self, seed, components=COMPONENTS, reference_scans=REFERENCE_SCANS):
        self.random, self.components = np.random.default_rng(seed), components
        tilt_covariance = prior.tilt_covariance(components, LINES)
        sigma = prior.globals_sigma(components, weather_known=True)
        blocks = (
            tilt_covariance,
            prior.refraction_covariance(components, PARAMS),
            prior.cross_tilt_covariance(components, PARAMS, LINES),
        )
        self.prior = prior.block_diagonal_covariance(PARAMS, sigma, *blocks)
        sensed = tilt_covariance - components.line_jitter_rad**2 * np.eye(PARAMS.line_groups)
        self.sensed_rad = np.linalg.cholesky(sensed + 1e-18 * np.eye(len(sensed))) @ self.normal()
        self.sensed_rad += LINE_DESIGN[:, :2] @ (components.tilt_rad * self.random.standard_normal(2))
        jitter_rad = components.line_jitter_rad * self.normal()  # not measured by the sensor
        reference_rad = np.linalg.cholesky(tilt_covariance / reference_scans) @ self.normal()
        self.ground_rad = self.sensed_rad + jitter_rad - reference_rad + GROUND_RAD * self.normal()

    def normal(self):
        return self.random.standard_normal(PARAMS.line_groups)

    def log(self, offset_s=0.0, mode_sizes=None, weight=1 / NOISE_RAD**2):
        """Log of the scan, with clock offset, noise and sensor errors; its lines run backward in time."""
        log_rad = np.interp(LINES.time_s[::-1] - offset_s, LINES.time_s[::-1], self.sensed_rad[::-1])[::-1]
        mode_sizes = (
            self.random.standard_normal(ERROR_MODES.shape[1])
            if mode_sizes is None
            else np.asarray(mode_sizes)
        )
        log_rad = log_rad + NOISE_RAD * self.normal() + ERROR_MODES @ mode_sizes
        return LineInclination(log_rad, np.broadcast_to(weight, log_rad.shape), ERROR_MODES)

    def adjust(self, log=None):
        """Dense least-squares adjustment."""
        normal = np.linalg.inv(self.prior) + LINE_DESIGN.T @ LINE_DESIGN / GROUND_RAD**2
        rhs = LINE_DESIGN.T @ self.ground_rad / GROUND_RAD**2
        if log is not None:
            noise = np.diag(1 / log.weight) + log.error_modes @ log.error_modes.T
            normal += LINE_DESIGN.T @ np.linalg.solve(noise, LINE_DESIGN)
            rhs += LINE_DESIGN.T @ np.linalg.solve(noise, log.sight_tilt_rad)
        covariance = np.linalg.inv(normal)
        return make_adjustment(covariance @ rhs, covariance, log)

    def predict_log(self, log):
        return inclination_check.leave_log_out(LINES, self.adjust(log))


def make_adjustment(estimate, covariance, log):
    posterior = SimpleNamespace(
        line_covariance=lambda: covariance,
        sight_tilt_covariance=lambda _: LINE_DESIGN @ covariance @ LINE_DESIGN.T,
    )
    redundancy, predicted_rad = np.ones(len(estimate)), LINE_DESIGN @ estimate
    return Adjustment(
        PARAMS,
        estimate,
        posterior,
        0.001,
        np.ones(9),
        (1.0, 1.0),
        0.0,
        SimpleNamespace(covariance=covariance),
        redundancy,
        log,
        predicted_rad,
        np.zeros(3),
    )


def test_prediction_of_the_log_equals_an_adjustment_without_it():
    scan = Scan(1)
    log = scan.log()
    prediction, without_log = scan.predict_log(log), scan.adjust()
    assert np.all(np.diff(prediction.lines.time_s) > 0)
    assert prediction.predicted_rad[::-1] == pytest.approx(LINE_DESIGN @ without_log.estimate, abs=1e-9)
    covariance = (
        np.diag(1 / log.weight)
        + ERROR_MODES @ ERROR_MODES.T
        + LINE_DESIGN @ without_log.covariance @ LINE_DESIGN.T
    )
    identity = prediction.precision[::-1, ::-1] @ covariance
    assert np.abs(identity - np.eye(PARAMS.line_groups)).max() < 1e-5


def test_line_groups_without_log_samples_are_ignored():
    scan = Scan(2)
    weight = np.where(np.arange(PARAMS.line_groups) < 50, 0.0, 1 / NOISE_RAD**2)
    log = scan.log()
    with_gap = LineInclination(np.where(weight > 0, log.sight_tilt_rad, 7.0), weight, ERROR_MODES)
    present = weight > 0
    noise = np.diag(1 / weight[present]) + ERROR_MODES[present] @ ERROR_MODES[present].T
    without_log = scan.adjust()
    gain = without_log.covariance @ LINE_DESIGN[present].T
    innovation = noise + LINE_DESIGN[present] @ gain
    estimate = without_log.estimate + gain @ np.linalg.solve(
        innovation, log.sight_tilt_rad[present] - LINE_DESIGN[present] @ without_log.estimate
    )
    covariance = without_log.covariance - gain @ np.linalg.solve(innovation, gain.T)
    prediction = inclination_check.leave_log_out(LINES, make_adjustment(estimate, covariance, with_gap))
    assert prediction.predicted_rad[::-1] == pytest.approx(
        (LINE_DESIGN @ without_log.estimate)[present], abs=1e-9
    )


def test_a_combination_that_the_ground_knows_less_than_the_log_is_left_out():
    """Of it the prediction is the log; of all others it is that without the disagreement of models."""
    scan, pattern = Scan(1), np.sin(np.linspace(0, 20, PARAMS.line_groups))
    log = scan.log()
    adjustment = scan.adjust(log)
    covariance = LINE_DESIGN @ adjustment.covariance @ LINE_DESIGN.T + 0.01 * np.outer(pattern, pattern)
    disagreeing = replace(adjustment, posterior=SimpleNamespace(sight_tilt_covariance=lambda _: covariance))
    prediction = inclination_check.leave_log_out(LINES, disagreeing)
    usual = inclination_check.leave_log_out(LINES, adjustment)
    combination = np.linalg.solve(NOISE_RAD**2 * np.eye(len(pattern)) + ERROR_MODES @ ERROR_MODES.T, pattern)
    combination = combination[::-1] / np.linalg.norm(combination)
    assert combination @ (prediction.predicted_rad - prediction.log_rad) == pytest.approx(0.0, abs=1e-9)
    assert abs(combination @ (usual.predicted_rad - usual.log_rad)) > 1e-4
    others = np.eye(len(pattern)) - np.outer(combination, combination)
    assert others @ (prediction.predicted_rad - usual.predicted_rad) == pytest.approx(0.0, abs=1e-5)
    assert np.linalg.eigvalsh(prediction.precision)[0] > -1e-6


def test_a_log_of_another_time_is_not_checked():
    scan = Scan(2)
    log = replace(scan.log(), weight=np.zeros(PARAMS.line_groups))
    assert inclination_check.leave_log_out(LINES, replace(scan.adjust(), log=log)) is None


@pytest.mark.integration
def test_a_log_with_the_usual_errors_gives_no_warning():
    for seed in range(10):
        scan = Scan(seed)
        prediction = scan.predict_log(scan.log())
        assert inclination_check.sensor_warnings(prediction) == []
        assert (
            inclination_check.estimate_clock_offset(prediction, COMPONENTS, REFERENCE_SCANS).warnings() == []
        )


def test_a_changed_cyclic_error_is_reported_with_its_size():
    for change in (6.0, -6.0):  # in units of 20 % of the amplitude
        scan = Scan(3)
        (reason,) = inclination_check.sensor_warnings(
            scan.predict_log(scan.log(mode_sizes=[0.0, 0.0, change, 0.0]))
        )
        size = float(reason.split("by ")[1].split(" degree")[0])
        expected_rad = np.abs(ERROR_MODES[:, 2]).max() * 6.0
        assert "cyclic error that differs" in reason
        assert size == pytest.approx(math.degrees(expected_rad), rel=0.3)


def test_a_bias_is_reported():
    scan = Scan(4)
    (reason,) = inclination_check.sensor_warnings(scan.predict_log(scan.log(mode_sizes=[0.0, 8.0, 0.0, 0.0])))
    assert "cyclic" not in reason
    assert float(reason.split("by ")[1].split(" degree")[0]) == pytest.approx(0.012, rel=0.15)


@pytest.mark.parametrize("offset_s", [6.0, -6.0])
@pytest.mark.integration
def test_a_clock_offset_is_detected_with_strong_jitter(offset_s):
    estimates = []
    for seed in range(4):
        scan = Scan(seed, STRONG_JITTER)
        prediction = scan.predict_log(scan.log(offset_s))
        estimates.append(inclination_check.estimate_clock_offset(prediction, STRONG_JITTER, REFERENCE_SCANS))
        if messages := estimates[-1].warnings():
            assert ("late" in messages[0].split(" (")[0]) == (offset_s > 0)
    assert sum(bool(estimate.warnings()) for estimate in estimates) >= 3
    z = np.array([(estimate.offset_s - offset_s) / estimate.sigma_s for estimate in estimates])
    assert np.all(np.abs(z) < 4)


@pytest.mark.integration
def test_sigma_of_the_clock_offset_matches_its_errors():
    """For offsets drawn from the whole search range, z has unit variance."""
    z, sigma_s = [], []
    for seed in range(24):
        scan = Scan(100 + seed, STRONG_JITTER if seed % 2 else COMPONENTS)
        offset_s = scan.random.uniform(-inclination_check.MAX_OFFSET_S, inclination_check.MAX_OFFSET_S)
        prediction = scan.predict_log(scan.log(offset_s))
        estimate = inclination_check.estimate_clock_offset(prediction, scan.components, REFERENCE_SCANS)
        z.append((estimate.offset_s - offset_s) / estimate.sigma_s)
        sigma_s.append(estimate.sigma_s)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4
    assert np.median(sigma_s[1::2]) < 1.0 < np.median(sigma_s[::2])


@pytest.mark.integration
def test_the_tilt_of_the_reference_is_part_of_the_clock_offset_model():
    """With a reference of one scan, ignoring its tilt makes sigma too small by half."""
    z, z_ignored = [], []
    for seed in range(24):
        scan = Scan(300 + seed, STRONG_JITTER, reference_scans=1)
        offset_s = scan.random.uniform(-3, 3)
        prediction = scan.predict_log(scan.log(offset_s))
        for ratios, scans in ((z, 1), (z_ignored, 0)):
            estimate = inclination_check.estimate_clock_offset(prediction, STRONG_JITTER, scans)
            ratios.append((estimate.offset_s - offset_s) / estimate.sigma_s)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.sqrt(np.mean(np.square(z_ignored))) > 1.4


@pytest.mark.integration
@pytest.mark.parametrize("offset_s", [6.0, -6.0])
def test_a_clock_offset_is_detected_with_a_reference_of_eight_scans(offset_s):
    estimates = []
    for seed in range(4):
        scan = Scan(seed, STRONG_JITTER, reference_scans=8)
        prediction = scan.predict_log(scan.log(offset_s))
        estimates.append(inclination_check.estimate_clock_offset(prediction, STRONG_JITTER, 8))
    assert sum(bool(estimate.warnings()) for estimate in estimates) >= 3
    assert np.all(np.abs([(estimate.offset_s - offset_s) / estimate.sigma_s for estimate in estimates]) < 4)


def test_a_short_log_gives_no_clock_offset():
    scan = Scan(5)
    log = scan.log()
    short = LineInclination(
        log.sight_tilt_rad, np.where(np.arange(PARAMS.line_groups) < 60, log.weight, 0.0), ERROR_MODES
    )
    assert (
        inclination_check.estimate_clock_offset(
            inclination_check.leave_log_out(LINES, replace(scan.adjust(log), log=short)),
            COMPONENTS,
            REFERENCE_SCANS,
        )
        is None
    )


def test_a_clock_that_is_off_by_much_needs_more_evidence():
    """Clocks differ by up to 5 s (two sigma), by 8.8 s with odds of e^-6.2."""
    evidence = 12.4
    assert inclination_check.ClockOffset(-8.8, 0.8, evidence).warnings() == []
    assert inclination_check.ClockOffset(-8.8, 0.8, evidence + 6.2).warnings()
    assert inclination_check.ClockOffset(-4.0, 0.8, evidence).warnings()
