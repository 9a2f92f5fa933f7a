"""What the ground says of the log: against an estimate that never saw it, and a simulated truth."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.quantities import Habits
from station.science import prior, sensor
from station.science.adjustment import Adjustment
from station.science.inclination import Cycle
from station.science.normals import LineLog
from station.science.shared import GLOBAL, Basis

OF = Basis(math.radians(60.0), 120, closed=False)  # 600 groups of lines
LINES = prior.Lines(-OF.line_azimuth_rad, 17.0 + 1.3 * np.arange(OF.line_count)[::-1])  # from right to left
HABITS = Habits()
SWAYS = replace(HABITS, fast_motion_rad=math.radians(0.003))
WAVE_RAD = math.radians(0.035)
ZERO = Cycle((0.0, WAVE_RAD, 0.0), (0.0, WAVE_RAD, 0.0))
GROUND_RAD, NOISE_RAD = math.radians(0.0006), math.radians(0.007)
MANY = 200  # scans of a reference
STATE = slice(len(GLOBAL), len(GLOBAL) + OF.line_count)
FELT = np.zeros((OF.line_count, len(GLOBAL) + OF.line_count + 2 * OF.refraction_count))
FELT[:, 0], FELT[:, 1] = np.cos(OF.line_azimuth_rad), -np.sin(OF.line_azimuth_rad)
FELT[:, STATE] = np.eye(OF.line_count)
FAULTS = np.concatenate(
    [
        np.stack([np.cos(OF.line_azimuth_rad), -np.sin(OF.line_azimuth_rad)], axis=-1)
        * prior.SENSOR_BIAS_RAD,
        prior.cycle_changes(LINES, ZERO),
    ],
    axis=1,
)


class Scan:
    """A truth drawn from the habits; what the log says of it, and ground that leans as its scans left it."""

    def __init__(self, seed, habits=HABITS, reference_scans=MANY):
        self.random, self.habits = np.random.default_rng(seed), habits
        motion = prior.motion(habits, LINES)
        sigma = prior.globals_sigma(habits, weather_known=True)
        leans = motion, prior.bending(habits, OF), prior.across(habits, OF, LINES)
        self.prior = prior.by_line(OF, sigma, *leans)
        seen = motion - habits.line_motion_rad**2 * np.eye(OF.line_count)
        self.lean_rad = np.linalg.cholesky(seen + 1e-18 * np.eye(len(seen))) @ self.normal()
        self.lean_rad += FELT[:, :2] @ (habits.tilt_rad * self.random.standard_normal(2))
        jitter_rad = habits.line_motion_rad * self.normal()  # which no sensor feels
        reference_rad = np.linalg.cholesky(motion / reference_scans) @ self.normal()
        self.ground_rad = self.lean_rad + jitter_rad - reference_rad + GROUND_RAD * self.normal()

    def normal(self):
        return self.random.standard_normal(OF.line_count)

    def log(self, late_s=0.0, faults=None, weight=1 / NOISE_RAD**2):
        """What the sensor wrote; the scan's lines run backward in time."""
        told = np.interp(LINES.time_s[::-1] - late_s, LINES.time_s[::-1], self.lean_rad[::-1])[::-1]
        faults = self.random.standard_normal(FAULTS.shape[1]) if faults is None else np.asarray(faults)
        told = told + NOISE_RAD * self.normal() + FAULTS @ faults
        return LineLog(told, np.broadcast_to(weight, told.shape), FAULTS)

    def adjusted(self, log=None):
        """Least squares, in full."""
        normal = np.linalg.inv(self.prior) + FELT.T @ FELT / GROUND_RAD**2
        right = FELT.T @ self.ground_rad / GROUND_RAD**2
        if log is not None:
            noise = np.diag(1 / log.weight) + log.faults @ log.faults.T
            normal += FELT.T @ np.linalg.solve(noise, FELT)
            right += FELT.T @ np.linalg.solve(noise, log.lean_rad)
        covariance = np.linalg.inv(normal)
        return as_adjusted(covariance @ right, covariance, log)

    def told(self, log):
        return sensor.expected(LINES, self.adjusted(log))


def as_adjusted(estimate, covariance, log):
    unknown = SimpleNamespace(by_line=lambda: covariance, along_sight=lambda _: FELT @ covariance @ FELT.T)
    return Adjustment(OF, estimate, unknown, 0.001, np.ones(9), (1.0, 1.0), log, FELT @ estimate)


def test_what_the_ground_expects_is_what_it_says_without_the_log():
    scan = Scan(1)
    log = scan.log()
    told, alone = scan.told(log), scan.adjusted()
    assert np.all(np.diff(told.lines.time_s) > 0)
    assert told.ground_rad[::-1] == pytest.approx(FELT @ alone.estimate, abs=1e-9)
    between = np.diag(1 / log.weight) + FAULTS @ FAULTS.T + FELT @ alone.covariance @ FELT.T
    identity = told.precision[::-1, ::-1] @ between
    assert identity == pytest.approx(np.eye(OF.line_count), abs=1e-5)


def test_lines_without_a_log_do_not_count():
    scan = Scan(2)
    weight = np.where(np.arange(OF.line_count) < 50, 0.0, 1 / NOISE_RAD**2)
    log = scan.log()
    with_gap = LineLog(np.where(weight > 0, log.lean_rad, 7.0), weight, FAULTS)
    kept = weight > 0
    noise = np.diag(1 / weight[kept]) + FAULTS[kept] @ FAULTS[kept].T
    alone = scan.adjusted()
    gain = alone.covariance @ FELT[kept].T
    spread = noise + FELT[kept] @ gain
    estimate = alone.estimate + gain @ np.linalg.solve(
        spread, log.lean_rad[kept] - FELT[kept] @ alone.estimate
    )
    covariance = alone.covariance - gain @ np.linalg.solve(spread, gain.T)
    told = sensor.expected(LINES, as_adjusted(estimate, covariance, with_gap))
    assert told.ground_rad[::-1] == pytest.approx((FELT @ alone.estimate)[kept], abs=1e-9)


def test_a_log_within_its_habits_is_not_doubted():
    for seed in range(10):
        scan = Scan(seed)
        told = scan.told(scan.log())
        assert sensor.off_habit(told) == []
        assert sensor.lateness(told, HABITS, MANY).words() == []


def test_a_changed_wave_is_told_with_its_size():
    for change in (6.0, -6.0):  # of a fifth of its height each
        scan = Scan(3)
        (reason,) = sensor.off_habit(scan.told(scan.log(faults=[0.0, 0.0, change, 0.0])))
        size = float(reason.split("is ")[1].split(" degree")[0])
        seen = np.abs(FAULTS[:, 2]).max() * 6.0
        assert "wave over a turn" in reason
        assert size == pytest.approx(math.degrees(seen), rel=0.3)


def test_a_bias_is_told():
    scan = Scan(4)
    (reason,) = sensor.off_habit(scan.told(scan.log(faults=[0.0, 8.0, 0.0, 0.0])))
    assert "wave" not in reason
    assert float(reason.split("is ")[1].split(" degree")[0]) == pytest.approx(0.012, rel=0.15)


@pytest.mark.parametrize("late_s", [6.0, -6.0])
def test_a_late_clock_is_told_where_the_scanner_sways(late_s):
    found = []
    for seed in range(4):
        scan = Scan(seed, SWAYS)
        found.append(sensor.lateness(scan.told(scan.log(late_s)), SWAYS, MANY))
        if words := found[-1].words():
            assert ("late" in words[0].split(" (")[0]) == (late_s > 0)
    assert sum(bool(one.words()) for one in found) >= 3
    off = np.array([(one.late_s - late_s) / one.sigma_s for one in found])
    assert np.all(np.abs(off) < 4)


def test_lateness_holds_its_sigma_where_nothing_was_known():
    """Of clocks drawn from all that are looked for, errors over sigma have unit variance."""
    z, sigma_s = [], []
    for seed in range(24):
        scan = Scan(100 + seed, SWAYS if seed % 2 else HABITS)
        late_s = scan.random.uniform(-sensor.LATE_MOST_S, sensor.LATE_MOST_S)
        one = sensor.lateness(scan.told(scan.log(late_s)), scan.habits, MANY)
        z.append((one.late_s - late_s) / one.sigma_s)
        sigma_s.append(one.sigma_s)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4
    assert np.median(sigma_s[1::2]) < 1.0 < np.median(sigma_s[::2])


def test_a_reference_that_leans_itself_is_no_clock():
    """A scan's own motion is in it, adjusted or not; taken for still, errors are half as large again."""
    z, if_still = [], []
    for seed in range(24):
        scan = Scan(300 + seed, SWAYS, reference_scans=1)
        late_s = scan.random.uniform(-3, 3)
        told = scan.told(scan.log(late_s))
        one, other = (sensor.lateness(told, SWAYS, scans) for scans in (1, 0))
        z.append((one.late_s - late_s) / one.sigma_s)
        if_still.append((other.late_s - late_s) / other.sigma_s)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.sqrt(np.mean(np.square(if_still))) > 1.4


@pytest.mark.parametrize("late_s", [6.0, -6.0])
def test_a_late_clock_is_told_by_a_reference_of_a_few_scans(late_s):
    found = []
    for seed in range(4):
        scan = Scan(seed, SWAYS, reference_scans=8)
        found.append(sensor.lateness(scan.told(scan.log(late_s)), SWAYS, 8))
    assert sum(bool(one.words()) for one in found) >= 3
    assert np.all(np.abs([(one.late_s - late_s) / one.sigma_s for one in found]) < 4)


def test_a_log_of_few_lines_does_not_tell():
    scan = Scan(5)
    log = scan.log()
    short = LineLog(log.lean_rad, np.where(np.arange(OF.line_count) < 60, log.weight, 0.0), FAULTS)
    assert (
        sensor.lateness(sensor.expected(LINES, replace(scan.adjusted(log), log=short)), HABITS, MANY) is None
    )
