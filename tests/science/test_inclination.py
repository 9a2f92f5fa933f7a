"""The inclination log: cleaned, filtered, relative, in time."""

import math

import numpy as np
import pytest
from scipy import signal

from station.quantities import HeadTrack, InclinationLog
from station.science import inclination
from station.science.inclination import LEVEL, Cycle

STEP = math.radians(0.001)
NOISE = math.radians(0.008)
RANGE = math.radians(10.0)
TRACK = HeadTrack(np.linspace(0.0, 920.0, 200), np.radians(np.linspace(10.0, 130.0, 200)))
WAVE = Cycle((0.001, math.radians(0.04), 0.0), (-0.002, 0.0, math.radians(0.03)))


def log_of(roll_rad, pitch_rad, time_s=None):
    time_s = np.arange(len(roll_rad), dtype=float) if time_s is None else time_s
    return InclinationLog(time_s, roll_rad, pitch_rad)


def test_cleaning_drops_what_no_sensor_meant():
    roll = np.full(100, 0.01)
    roll[20] = 0.02  # a spike
    roll[30] = math.nan
    roll[40] = 3.0
    time_s = np.arange(100.0)
    time_s[50] = 49.0  # a duplicate
    time_s[60] = 10.0  # back in time
    kept, dropped = inclination.clean(log_of(roll, np.zeros(100), time_s), RANGE)
    assert dropped == 5
    assert np.all(np.diff(kept.time_s) > 0)
    assert np.all(kept.roll_rad == 0.01)


def test_cleaning_survives_an_empty_log():
    kept, dropped = inclination.clean(log_of(np.array([math.nan]), np.zeros(1)), RANGE)
    assert (len(kept.time_s), dropped) == (0, 1)


def test_blackman_of_101_samples_leaves_an_eighth_of_white_noise():
    """EQUATIONS 2.8: sqrt(1.73 / N) = 0.13; the -3 dB point at 0.82 / N."""
    weights = inclination.blackman(101)
    assert weights.sum() == pytest.approx(1.0)
    assert math.sqrt(np.sum(weights**2)) == pytest.approx(0.13, abs=0.002)
    power = abs(np.sum(weights * np.exp(-2j * math.pi * 0.82 / 101 * np.arange(101)))) ** 2
    assert power == pytest.approx(0.5, abs=0.02)


def test_low_pass_keeps_a_line_to_its_ends():
    line = 0.5 + 0.001 * np.arange(400)
    assert inclination.low_pass(line, inclination.blackman(101)) == pytest.approx(line, abs=0.006)
    assert inclination.low_pass(np.ones(50), inclination.blackman(41)) == pytest.approx(np.ones(50))


def test_cut_off_follows_the_spectrum():
    """Motion up to 0.01 or 0.1 Hz under white noise: the window is as long as it may be and no longer."""
    rng = np.random.default_rng(4)
    white = rng.normal(0, NOISE, 2400)
    motion = rng.normal(0, 1, 2400)
    slow, fast = (
        20 * NOISE * signal.sosfilt(signal.butter(6, hz, fs=1.0, output="sos"), motion) for hz in (0.02, 0.1)
    )
    wide = inclination.window_length(slow + white, 1.0, None)
    narrow = inclination.window_length(fast + white, 1.0, None)
    assert 0.82 / wide == pytest.approx(0.03, abs=0.02)
    assert 0.82 / narrow == pytest.approx(0.15, abs=0.05)
    assert inclination.window_length(white, 1.0, 0.00812) == 101


def test_cycle_is_recovered_from_one_turn():
    rng = np.random.default_rng(2)
    track = HeadTrack(np.array([0.0, 2770.0]), np.array([0.0, 2 * math.pi]))
    time_s = np.arange(0.0, 2770.0)
    roll, pitch = WAVE.at(inclination.head_azimuth(track, time_s))
    fitted = inclination.fit_cycle(
        log_of(roll + rng.normal(0, NOISE, len(roll)), pitch + rng.normal(0, NOISE, len(roll)), time_s),
        track,
        NOISE,
    )
    assert np.degrees(fitted.roll_rad) == pytest.approx(np.degrees(WAVE.roll_rad), abs=0.001)
    assert np.degrees(fitted.pitch_rad) == pytest.approx(np.degrees(WAVE.pitch_rad), abs=0.001)


def test_clock_offset_of_a_leaning_mount():
    """A mount that leans 5° tells the log's clock to well under a second."""
    rng = np.random.default_rng(3)
    wave = Cycle((0.0, math.radians(5), 0.0), (0.0, 0.0, math.radians(5)))
    time_s = np.arange(0.0, 920.0)
    roll, pitch = wave.at(inclination.head_azimuth(TRACK, time_s))
    late = log_of(roll + rng.normal(0, NOISE, 920), pitch + rng.normal(0, NOISE, 920), time_s + 3.3)
    offset_s, sigma_s = inclination.clock_offset(late, TRACK, wave, NOISE)
    assert offset_s == pytest.approx(3.3, abs=0.2)
    assert sigma_s < 0.3  # the mount may move meanwhile


def test_a_clock_a_minute_off_is_found_though_nobody_expects_it():
    rng = np.random.default_rng(5)
    wave = Cycle((0.0, math.radians(5), 0.0), (0.0, 0.0, math.radians(5)))
    time_s = np.arange(-80.0, 1000.0)
    roll, pitch = wave.at(inclination.head_azimuth(TRACK, time_s))
    noise = rng.normal(0, NOISE, (2, len(time_s)))
    offset_s, sigma_s = inclination.clock_offset(
        log_of(roll + noise[0], pitch + noise[1], time_s + 60), TRACK, wave, NOISE
    )
    assert offset_s == pytest.approx(60, abs=0.4)
    assert sigma_s < 0.3


def test_clock_offset_sigma_holds_while_the_mount_moves():
    """A wave of 0.5°, and a mount that wanders by 0.0018° in the scan of the SOP and in this: z of one."""
    rng = np.random.default_rng(6)
    wave = Cycle((0.0, math.radians(0.5), 0.0), (0.0, 0.0, math.radians(0.5)))
    time_s = np.arange(0.0, 920.0)
    azimuth_rad = inclination.head_azimuth(TRACK, time_s)

    def wandering():
        kick = rng.normal(0, math.radians(0.0018) * math.sqrt(2 / 300), (2, 920))
        wander = signal.lfilter([1], [1, -math.exp(-1 / 300)], kick, axis=1)
        return wander + rng.normal(0, NOISE, (2, 920))

    z = []
    for _ in range(60):
        still = np.stack(wave.at(azimuth_rad))
        zero = inclination.fit_cycle(log_of(*(still + wandering()), time_s), TRACK, NOISE)
        late_s = rng.uniform(-5, 5)
        log = log_of(*(still + wandering()), time_s + late_s)
        offset_s, sigma_s = inclination.clock_offset(log, TRACK, zero, NOISE)
        z.append((offset_s - late_s) / sigma_s)
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_a_sensor_at_the_end_of_its_range_tells_nothing():
    roll = np.full(100, math.radians(3.0))
    roll[40:] = RANGE
    log = log_of(roll, np.zeros(100))
    assert inclination.pegged(log, RANGE) == pytest.approx(0.6)
    kept, dropped = inclination.clean(log, RANGE)
    assert (len(kept.time_s), dropped) == (40, 60)
    assert inclination.pegged(log_of(np.full(50, math.nan), np.zeros(50)), RANGE) == 0.0


def test_clock_offset_stays_at_nought_where_nothing_tells():
    rng = np.random.default_rng(3)
    log = log_of(*rng.normal(0, NOISE, (2, 900)))
    offset_s, sigma_s = inclination.clock_offset(log, TRACK, LEVEL, NOISE)
    assert offset_s == pytest.approx(0.0, abs=1e-9)
    assert sigma_s == pytest.approx(2.5, rel=1e-3)


def test_lean_the_sop_holds_is_not_applied_again():
    """The very scan the SOP was solved from, motionless: nothing is left to apply."""
    time_s = np.arange(0.0, 920.0)
    log = log_of(*WAVE.at(inclination.head_azimuth(TRACK, time_s)), time_s)
    zero = inclination.fit_cycle(log, TRACK, NOISE)
    lean = inclination.relative_lean(log, TRACK, zero, NOISE)
    assert np.abs(lean.tilt.roll_rad).max() < math.radians(1e-4)
    assert np.abs(lean.tilt.pitch_rad).max() < math.radians(1e-4)


def test_drift_comes_through_and_noise_does_not():
    rng = np.random.default_rng(8)
    time_s = np.arange(0.0, 920.0)
    drift = math.radians(0.006) * time_s / 920
    roll, pitch = WAVE.at(inclination.head_azimuth(TRACK, time_s))
    log = log_of(roll + drift + rng.normal(0, NOISE, 920), pitch + rng.normal(0, NOISE, 920), time_s)
    lean = inclination.relative_lean(log, TRACK, WAVE, NOISE)
    middle = slice(60, -60)
    assert np.degrees(lean.tilt.roll_rad - drift)[middle].std() < 0.0015
    assert np.degrees(lean.noise_rad) == pytest.approx(0.008, abs=0.001)
    error = np.degrees(np.concatenate([lean.tilt.roll_rad - drift, lean.tilt.pitch_rad]))
    assert error.std() == pytest.approx(np.degrees(lean.filtered_noise_rad), rel=0.5)


def test_real_log(shared_data):
    table = np.loadtxt(shared_data / "riegl" / "140123_202748-incl.txt", delimiter=",", skiprows=1)
    log = InclinationLog(table[:, 0], *np.radians(table[:, 1:].T))
    kept, dropped = inclination.clean(log, RANGE)
    assert dropped == 0
    lean = inclination.relative_lean(kept, None, LEVEL, NOISE)
    assert math.degrees(lean.mean_roll_rad) == pytest.approx(-0.2868, abs=0.001)


@pytest.mark.parametrize("count", [100, 257, 900])
def test_the_spectrum_is_that_of_scipy(count):
    values = np.random.default_rng(count).normal(size=count).cumsum()
    frequency_hz, power = inclination.spectrum(values, 1.3)
    wanted_hz, wanted = signal.welch(signal.detrend(values), fs=1.3, nperseg=min(256, count))
    assert frequency_hz == pytest.approx(wanted_hz)
    assert power == pytest.approx(wanted)
