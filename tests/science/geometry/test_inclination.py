"""Inclination log: cleaning, axes, cyclic error, clock offset, low-pass filter, gaps and relative tilt."""

import math
from itertools import combinations

import numpy as np
import pytest
from scipy import signal
from scipy.spatial.transform import Rotation

from station.quantities import AzimuthTrack, InclinationLog
from station.science.geometry import inclination
from station.science.geometry.cyclic_error import (
    NO_CYCLIC_ERROR,
    CyclicError,
    clock_offset,
    fit_cyclic_error,
    head_azimuth,
)

STEP = math.radians(0.001)
NOISE = math.radians(0.008)
RANGE = math.radians(10.0)
AZIMUTH_TRACK = AzimuthTrack(np.linspace(0.0, 920.0, 200), np.radians(np.linspace(10.0, 130.0, 200)))
CYCLIC_ERROR = CyclicError((0.001, math.radians(0.04), 0.0), (-0.002, 0.0, math.radians(0.03)))


def inclination_log(roll_rad, pitch_rad, time_s=None):
    time_s = np.arange(len(roll_rad), dtype=float) if time_s is None else time_s
    return InclinationLog(time_s, roll_rad, pitch_rad)


def test_clean_removes_spikes_invalid_values_and_times_that_do_not_increase():
    roll = np.full(100, 0.01)
    roll[20] = 0.02  # a spike
    roll[30] = math.nan
    roll[40] = 3.0
    time_s = np.arange(100.0)
    time_s[50] = 49.0  # a duplicate
    time_s[60] = 10.0  # back in time
    log = inclination_log(roll, np.zeros(100), time_s)
    cleaned, dropped = inclination.clean(log, RANGE)
    assert (dropped, inclination.wrong_times(log)) == (5, 1)
    assert np.all(np.diff(cleaned.time_s) > 0)
    assert np.all(cleaned.roll_rad == 0.01)


@pytest.mark.parametrize(
    ("rows", "wrong_s"),
    [
        ([300], 5300.0),
        ([10], 5010.0),
        ([0], 0.0),
        ([1799], 7000.0),
        ([900], 0.0),
        ([5, 700, 701, 702, 1500], 9e4),
    ],
    ids=["ahead", "ahead near the start", "first", "last", "zero", "several"],
)
def test_a_wrong_time_costs_its_own_row_only(rows, wrong_s):
    time_s = 1000.0 + np.arange(1800)
    time_s[rows] = wrong_s
    log = inclination_log(*np.zeros((2, 1800)), time_s)
    cleaned, dropped = inclination.clean(log, RANGE)
    assert dropped == inclination.wrong_times(log) == len(rows)
    assert np.array_equal(cleaned.time_s, np.delete(1000.0 + np.arange(1800), rows))


@pytest.mark.parametrize(("back_s", "kept"), [(100, 1700), (1000, 900)])
def test_a_clock_that_is_set_back_costs_the_repeated_time_only(back_s, kept):
    time_s = np.arange(1800.0) - back_s * (np.arange(1800) >= 900)
    cleaned, _ = inclination.clean(inclination_log(*np.zeros((2, 1800)), time_s), RANGE)
    assert len(cleaned.time_s) == kept
    assert np.all(np.diff(cleaned.time_s) > 0)


def test_as_many_rows_as_possible_are_kept():
    """Against all subsets of nine rows."""
    rng = np.random.default_rng(1)
    for _ in range(100):
        time_s = rng.integers(0, 9, 9).astype(float)
        cleaned, _ = inclination.clean(inclination_log(*np.zeros((2, 9)), time_s), RANGE)
        largest = max(
            size
            for size in range(1, 10)
            if any(np.all(np.diff(time_s[list(rows)]) > 0) for rows in combinations(range(9), size))
        )
        assert len(cleaned.time_s) == largest
        assert np.all(np.diff(cleaned.time_s) > 0)


MOUNT = (
    Rotation.from_euler("z", -75, degrees=True)
    * Rotation.from_euler("y", -1.3, degrees=True)
    * Rotation.from_euler("x", 2.1, degrees=True)
).as_matrix()  # heading, pitch, roll: equations.md, 2.5


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "fault"),
    [
        (2.1, -1.3, None),
        (-2.1, -1.3, "roll has the opposite sign"),
        (2.1, 1.3, "pitch has the opposite sign"),
        (-2.1, 1.3, "roll and pitch have the opposite sign"),
        (-1.3, 2.1, "roll and pitch are swapped"),
        (1.3, -2.1, "roll and pitch are swapped and have the opposite sign"),
        (-1.3, -2.1, "roll and pitch are swapped and the true roll has the opposite sign"),
        (1.3, 2.1, "roll and pitch are swapped and the true pitch has the opposite sign"),
        (3.4, 0.2, None),  # moved by degrees
        (0.0, 0.0, None),
    ],
)
def test_wrong_axes_of_a_log_are_named(roll_deg, pitch_deg, fault):
    """The sensor is off by its constant and its wave, up to 0.05° each: equations.md, 2.7."""
    rng = np.random.default_rng(5)
    wave = np.radians(0.05) * np.sin(np.linspace(0, 3, 900))
    noise = rng.normal(0, NOISE, (2, 900))
    bias = np.radians(0.03)
    log = inclination_log(
        np.radians(roll_deg) + bias + wave + noise[0], np.radians(pitch_deg) - bias - wave + noise[1]
    )
    actual = inclination.axes_warnings(log, MOUNT)
    if fault is None:
        assert actual == []
    else:
        (message,) = actual
        assert f"are wrong: {fault} (" in message
        assert "in the SOP 2.10, -1.30" in message


@pytest.mark.parametrize("roll_deg", [0.0, 0.06])
def test_axes_of_a_level_mount_cannot_be_recognised(roll_deg):
    mount = Rotation.from_euler("x", roll_deg, degrees=True).as_matrix()
    noise = np.random.default_rng(6).normal(0, NOISE, (2, 900))
    log = inclination_log(noise[0] - np.radians(roll_deg + 0.03), noise[1] + np.radians(0.03))
    assert inclination.axes_warnings(log, mount) == []


def test_clean_of_a_log_without_valid_rows():
    cleaned, dropped = inclination.clean(inclination_log(np.array([math.nan]), np.zeros(1)), RANGE)
    assert (len(cleaned.time_s), dropped) == (0, 1)


def test_blackman_window_noise_gain_and_cutoff():
    """Noise gain sqrt(1.73 / N) = 0.13 for 101 samples, -3 dB frequency 0.82 / N: equations.md, 2.8."""
    weights = inclination.blackman(101)
    assert weights.sum() == pytest.approx(1.0)
    assert math.sqrt(np.sum(weights**2)) == pytest.approx(0.13, abs=0.002)
    power = abs(np.sum(weights * np.exp(-2j * math.pi * 0.82 / 101 * np.arange(101)))) ** 2
    assert power == pytest.approx(0.5, abs=0.02)


def test_low_pass_preserves_a_line_to_its_ends():
    line = 0.5 + 0.001 * np.arange(400)
    assert inclination.low_pass(line, inclination.blackman(101)) == pytest.approx(line, abs=0.006)
    assert inclination.low_pass(np.ones(50), inclination.blackman(41)) == pytest.approx(np.ones(50))


def test_window_length_follows_the_spectrum():
    """Motion up to 0.02 or 0.1 Hz under white noise: the cut-off lies just above the motion."""
    rng = np.random.default_rng(4)
    white = rng.normal(0, NOISE, 2400)
    motion = rng.normal(0, 1, 2400)
    slow, fast = (
        20 * NOISE * signal.sosfilt(signal.butter(6, hz, fs=1.0, output="sos"), motion) for hz in (0.02, 0.1)
    )
    long = inclination.window_length(slow + white, 1.0, None)
    short = inclination.window_length(fast + white, 1.0, None)
    assert 0.82 / long == pytest.approx(0.03, abs=0.02)
    assert 0.82 / short == pytest.approx(0.15, abs=0.05)
    assert inclination.window_length(white, 1.0, 0.00812) == 101


def test_cyclic_error_is_recovered_from_one_turn():
    rng = np.random.default_rng(2)
    track = AzimuthTrack(np.array([0.0, 2770.0]), np.array([0.0, 2 * math.pi]))
    time_s = np.arange(0.0, 2770.0)
    roll, pitch = CYCLIC_ERROR.at(head_azimuth(track, time_s))
    fitted = fit_cyclic_error(
        inclination_log(
            roll + rng.normal(0, NOISE, len(roll)), pitch + rng.normal(0, NOISE, len(roll)), time_s
        ),
        track,
        NOISE,
    )
    assert np.degrees(fitted.roll_rad) == pytest.approx(np.degrees(CYCLIC_ERROR.roll_rad), abs=0.001)
    assert np.degrees(fitted.pitch_rad) == pytest.approx(np.degrees(CYCLIC_ERROR.pitch_rad), abs=0.001)


def test_clock_offset_of_a_tilted_mount():
    """A cyclic error of 5° determines the log's clock to well under a second."""
    rng = np.random.default_rng(3)
    cyclic_error = CyclicError((0.0, math.radians(5), 0.0), (0.0, 0.0, math.radians(5)))
    time_s = np.arange(0.0, 920.0)
    roll, pitch = cyclic_error.at(head_azimuth(AZIMUTH_TRACK, time_s))
    log = inclination_log(roll + rng.normal(0, NOISE, 920), pitch + rng.normal(0, NOISE, 920), time_s + 3.3)
    offset_s, sigma_s = clock_offset(log, AZIMUTH_TRACK, cyclic_error, NOISE)
    assert offset_s == pytest.approx(3.3, abs=0.2)
    assert sigma_s < 0.3  # includes drift of the mount


def test_clock_offset_of_a_minute_overrules_the_prior():
    rng = np.random.default_rng(5)
    cyclic_error = CyclicError((0.0, math.radians(5), 0.0), (0.0, 0.0, math.radians(5)))
    time_s = np.arange(-80.0, 1000.0)
    roll, pitch = cyclic_error.at(head_azimuth(AZIMUTH_TRACK, time_s))
    noise = rng.normal(0, NOISE, (2, len(time_s)))
    offset_s, sigma_s = clock_offset(
        inclination_log(roll + noise[0], pitch + noise[1], time_s + 60), AZIMUTH_TRACK, cyclic_error, NOISE
    )
    assert offset_s == pytest.approx(60, abs=0.4)
    assert sigma_s < 0.3


@pytest.mark.integration
def test_clock_offset_sigma_is_calibrated_while_the_mount_moves():
    """Cyclic error of 0.5°; the mount drifts by 0.0018° in the scan of the SOP and in this one: z of one."""
    rng = np.random.default_rng(6)
    cyclic_error = CyclicError((0.0, math.radians(0.5), 0.0), (0.0, 0.0, math.radians(0.5)))
    time_s = np.arange(0.0, 920.0)
    azimuth_rad = head_azimuth(AZIMUTH_TRACK, time_s)

    def drift_and_noise():
        steps = rng.normal(0, math.radians(0.0018) * math.sqrt(2 / 300), (2, 920))
        drift = signal.lfilter([1], [1, -math.exp(-1 / 300)], steps, axis=1)
        return drift + rng.normal(0, NOISE, (2, 920))

    z = []
    for _ in range(60):
        cyclic_tilt = np.stack(cyclic_error.at(azimuth_rad))
        fitted = fit_cyclic_error(
            inclination_log(*(cyclic_tilt + drift_and_noise()), time_s), AZIMUTH_TRACK, NOISE
        )
        delay_s = rng.uniform(-5, 5)
        log = inclination_log(*(cyclic_tilt + drift_and_noise()), time_s + delay_s)
        offset_s, sigma_s = clock_offset(log, AZIMUTH_TRACK, fitted, NOISE)
        z.append((offset_s - delay_s) / sigma_s)
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_a_wave_that_changes_its_shape_is_not_taken_for_a_wrong_clock():
    """Cosine and sine of each axis, of 0.01 to 0.035°, change by 0.003° (1 σ) in every scan."""
    rng = np.random.default_rng(8)
    wave_deg = np.array([[0.0, 0.030, 0.012], [0.0, -0.010, 0.035]])
    time_s = np.arange(0.0, 920.0)
    track = AzimuthTrack(time_s, 2 * np.pi * time_s / 920)
    azimuth_rad = head_azimuth(track, time_s)
    wrong = 0
    for _ in range(200):
        registered, present = (
            CyclicError(*np.radians(wave_deg + rng.normal(0, 0.003, (2, 3)))) for _ in range(2)
        )
        roll, pitch = present.at(azimuth_rad)
        noise = rng.normal(0, NOISE, (2, 920))
        log = inclination_log(roll + noise[0], pitch + noise[1], time_s)
        offset_s, sigma_s = clock_offset(log, track, registered, NOISE)
        wrong += abs(offset_s) > max(4.0, 3 * sigma_s)
    assert wrong <= 1


def test_saturated_samples_are_removed_and_counted():
    roll = np.full(100, math.radians(3.0))
    roll[40:] = RANGE
    log = inclination_log(roll, np.zeros(100))
    assert inclination.saturated_fraction(log, RANGE) == pytest.approx(0.6)
    cleaned, dropped = inclination.clean(log, RANGE)
    assert (len(cleaned.time_s), dropped) == (40, 60)
    assert inclination.saturated_fraction(inclination_log(np.full(50, math.nan), np.zeros(50)), RANGE) == 0.0


def test_clock_offset_without_cyclic_error_is_the_prior():
    rng = np.random.default_rng(3)
    log = inclination_log(*rng.normal(0, NOISE, (2, 900)))
    offset_s, sigma_s = clock_offset(log, AZIMUTH_TRACK, NO_CYCLIC_ERROR, NOISE)
    assert offset_s == pytest.approx(0.0, abs=1e-9)
    assert sigma_s == pytest.approx(2.5, rel=1e-3)


def test_tilt_contained_in_the_sop_is_not_applied_again():
    """For the scan that the SOP was solved from, without motion, the relative tilt is zero."""
    time_s = np.arange(0.0, 920.0)
    log = inclination_log(*CYCLIC_ERROR.at(head_azimuth(AZIMUTH_TRACK, time_s)), time_s)
    cyclic_error = fit_cyclic_error(log, AZIMUTH_TRACK, NOISE)
    record = inclination.relative_tilt(log, AZIMUTH_TRACK, cyclic_error, NOISE)
    assert np.abs(record.tilt.roll_rad).max() < math.radians(1e-4)
    assert np.abs(record.tilt.pitch_rad).max() < math.radians(1e-4)


def test_a_record_follows_the_motion_once_its_clock_offset_is_corrected():
    """A sway of 20 s, in a log without noise that is 4.5 s late; its wave moves by 0.0004° at most."""
    time_s = np.arange(0.0, 920.0)

    def sway(seconds):
        return math.radians(0.004) * np.sin(2 * math.pi * seconds / 20)

    roll, pitch = CYCLIC_ERROR.at(head_azimuth(AZIMUTH_TRACK, time_s))
    late = inclination_log(roll + sway(time_s), pitch + sway(time_s), time_s + 4.5)
    record = inclination.relative_tilt(late, AZIMUTH_TRACK, CYCLIC_ERROR, NOISE)
    corrected = record.with_clock_offset(4.5 - record.offset_s, 0.3)
    assert (corrected.offset_s, corrected.offset_sigma_s) == (pytest.approx(4.5), 0.3)

    def largest_error_deg(record):
        error_rad = record.unfiltered.roll_rad - sway(record.unfiltered.time_s)
        return np.degrees(np.abs(error_rad[10:-10]).max())

    assert largest_error_deg(corrected) < 0.0005
    assert largest_error_deg(record) > 0.004


def test_relative_tilt_passes_drift_and_removes_noise():
    rng = np.random.default_rng(8)
    time_s = np.arange(0.0, 920.0)
    drift = math.radians(0.006) * time_s / 920
    roll, pitch = CYCLIC_ERROR.at(head_azimuth(AZIMUTH_TRACK, time_s))
    log = inclination_log(roll + drift + rng.normal(0, NOISE, 920), pitch + rng.normal(0, NOISE, 920), time_s)
    record = inclination.relative_tilt(log, AZIMUTH_TRACK, CYCLIC_ERROR, NOISE)
    middle = slice(60, -60)
    assert np.degrees(record.tilt.roll_rad - drift)[middle].std() < 0.0015
    assert np.degrees(record.noise_rad) == pytest.approx(0.008, abs=0.001)
    error = np.degrees(np.concatenate([record.tilt.roll_rad - drift, record.tilt.pitch_rad]))
    assert error.std() == pytest.approx(np.degrees(record.filtered_noise_rad), rel=0.5)


def test_a_gap_is_bridged_without_the_noise_of_single_samples():
    """Means of ten samples: noise of 0.008° / √10 at both sides, against 0.008° of the nearest sample."""
    rng = np.random.default_rng(9)
    time_s = np.r_[np.arange(0.0, 300.0), np.arange(600.0, 900.0)]
    errors = []
    for _ in range(200):
        noise = rng.normal(0, NOISE, (2, len(time_s)))
        record = inclination.relative_tilt(
            inclination_log(*noise, time_s), None, NO_CYCLIC_ERROR, NOISE, cutoff_hz=0.82 / 61
        )
        errors.append(np.interp([345.0, 555.0], record.tilt.time_s, record.tilt.roll_rad))
    assert record.gaps_s.tolist() == [[299.0, 600.0]]
    # 45 of 301 s into the gap: the means have the weights 0.85 and 0.15
    assert np.std(errors) == pytest.approx(NOISE / math.sqrt(10) * math.hypot(0.85, 0.15), rel=0.15)
    assert record.end_noise_rad == pytest.approx(NOISE / math.sqrt(10), rel=0.15)
    sampled = record.is_sampled(np.array([-1.0, 0.0, 299.0, 300.0, 599.0, 600.0, 899.0, 900.0]))
    assert sampled.tolist() == [False, True, True, False, False, True, True, False]


def test_a_slow_log_has_no_gaps():
    log = inclination_log(*np.zeros((2, 100)), np.arange(0.0, 1200.0, 12.0))
    assert len(inclination.relative_tilt(log, None, NO_CYCLIC_ERROR, NOISE, filtered=False).gaps_s) == 0


def test_mean_tilt_of_a_real_log(shared_data):
    table = np.loadtxt(shared_data / "riegl" / "140123_202748-incl.txt", delimiter=",", skiprows=1)
    log = InclinationLog(table[:, 0], *np.radians(table[:, 1:].T))
    cleaned, dropped = inclination.clean(log, RANGE)
    assert dropped == 0
    record = inclination.relative_tilt(cleaned, None, NO_CYCLIC_ERROR, NOISE)
    assert math.degrees(record.mean_roll_rad) == pytest.approx(-0.2868, abs=0.001)
