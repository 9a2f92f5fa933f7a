"""From what the inclination sensor wrote to the lean of every shot."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from station.quantities import Floats, HeadTrack, InclinationLog, Tilt

SENSOR_STEP_RAD = math.radians(0.001)  # the log's last digit
HAMPEL_HALF_WIDTH = 7  # samples
HAMPEL_SIGMAS = 5.0
WINDOW_SAMPLES = (5, 301)  # shortest that filters, longest that still follows five minutes
# A minute's window for a scan that is adjusted: what is faster the adjustment finds from the raw log and the
# ground, while noise that a short window lets through differs from shot to shot and is lost to it.
GENTLE_CUTOFF_HZ = 0.82 / 61
BLACKMAN_CUTOFF = 0.82  # -3 dB frequency of an N-sample Blackman window times N, EQUATIONS 2.8
CYCLE_PRIOR_RAD = math.radians(0.05)  # largest cyclic error seen at Helheim, EQUATIONS 2.7
OFFSET_PRIOR_S = 2.5  # clocks differ by up to 5 s, taken as two sigma: Voordendag et al. (2023), section 3.1
OFFSET_LARGEST_S = 600.0  # one sigma of a clock that nobody sets
OFFSET_SIGMAS = 5.0  # of what is thought of clocks, before a log refutes it
OFFSET_ROUNDS = 4
OFFSET_STEP_S = 10.0
# What a mount moves within two scans, that of the wave and this one, with its drift: EQUATIONS 6.3, 6.4.
MOTION_RAD, MOTION_S = math.radians(0.003), 300.0


def clean(log: InclinationLog, range_rad: float) -> tuple[InclinationLog, int]:
    """Return the log without what no sensor can have meant, and how many rows that was.

    Goes: not a number, at the end of the sensor's range or beyond, time not increasing, spikes (Hampel: five
    robust sigmas from the median of the fifteen neighbours).
    """
    columns = np.stack([log.time_s, log.roll_rad, log.pitch_rad])
    columns = columns[:, np.all(np.isfinite(columns), axis=0)]
    columns = columns[:, np.all(np.abs(columns[1:]) < range_rad - SENSOR_STEP_RAD / 2, axis=0)]
    if columns.shape[1]:
        columns = columns[:, np.diff(np.maximum.accumulate(columns[0]), prepend=-np.inf) > 0]
    if columns.shape[1] > 2 * HAMPEL_HALF_WIDTH:
        width = (1, 2 * HAMPEL_HALF_WIDTH + 1)
        apart = np.abs(columns[1:] - ndimage.median_filter(columns[1:], width, mode="nearest"))
        robust = 1.4826 * ndimage.median_filter(apart, width, mode="nearest")  # of a normal distribution
        spike = apart > HAMPEL_SIGMAS * np.maximum(robust, SENSOR_STEP_RAD)
        columns = columns[:, ~np.any(spike, axis=0)]
    kept = InclinationLog(columns[0], columns[1], columns[2])
    return kept, len(log.time_s) - len(kept.time_s)


def pegged(log: InclinationLog, range_rad: float) -> float:
    """Share of an uncleaned log's rows that lie at the end of the sensor's range or beyond."""
    lean_rad = np.maximum(np.abs(log.roll_rad), np.abs(log.pitch_rad))
    return float(np.mean(lean_rad >= range_rad - SENSOR_STEP_RAD / 2)) if len(lean_rad) else 0.0


@dataclass(frozen=True)
class Cycle:
    """Lean as a wave over one turn of the head: b0 + b1 cos θ + b2 sin θ.

    Source: EQUATIONS 2.7, the sinusoid of Voordendag et al. (2023), Fig. 3.
    """

    roll_rad: tuple[float, float, float]
    pitch_rad: tuple[float, float, float]

    def at(self, azimuth_rad: Floats) -> tuple[Floats, Floats]:
        """Roll and pitch at head azimuths (n,) [rad]."""
        wave = _waves(azimuth_rad)
        return np.asarray(wave @ self.roll_rad), np.asarray(wave @ self.pitch_rad)


LEVEL = Cycle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def _waves(azimuth_rad: Floats) -> Floats:
    return np.stack([np.ones_like(azimuth_rad), np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)


def head_azimuth(track: HeadTrack, time_s: Floats) -> Floats:
    """Azimuth of the scanner's head at times (n,) [rad]; held still before and after the scan."""
    return np.interp(time_s, track.time_s, track.azimuth_rad)


def fit_cycle(log: InclinationLog, track: HeadTrack, sigma_rad: float) -> Cycle:
    """Fit the wave over one turn to the part of a clean log that lies within the scan.

    A sector of a turn does not tell the wave from its mean: a prior of 0.05° on the wave settles it.
    Source: EQUATIONS 2.7.
    """
    inside = (log.time_s >= track.time_s[0]) & (log.time_s <= track.time_s[-1])
    design = _waves(head_azimuth(track, log.time_s[inside]))
    normal = design.T @ design + np.diag([0.0, 1.0, 1.0]) * (sigma_rad / CYCLE_PRIOR_RAD) ** 2
    roll, pitch = (
        np.linalg.lstsq(normal, design.T @ lean_rad[inside], rcond=None)[0]
        for lean_rad in (log.roll_rad, log.pitch_rad)
    )
    return Cycle((roll[0], roll[1], roll[2]), (pitch[0], pitch[1], pitch[2]))


def clock_offset(log: InclinationLog, track: HeadTrack, zero: Cycle, sigma_rad: float) -> tuple[float, float]:
    """How late the log's clock is against the scan's, and its uncertainty [s].

    The known wave is fitted to the log with free mean, amplitude and phase; phase over head speed is time.
    What the mount moves in earnest looks like phase too, and is part of the uncertainty. That clocks agree to
    5 s (two sigma) draws it to nought where the wave is too small to tell, unless the log refutes it.
    Source: EQUATIONS 2.10.
    """
    late_s, sigma_s = 0.0, OFFSET_LARGEST_S
    for _ in range(OFFSET_ROUNDS):
        time_s = log.time_s - late_s
        inside = (time_s >= track.time_s[0]) & (time_s <= track.time_s[-1])
        if np.count_nonzero(inside) < 60:
            return 0.0, OFFSET_PRIOR_S
        more_s, sigma_s = _later(
            time_s[inside], log.roll_rad[inside], log.pitch_rad[inside], track, zero, sigma_rad
        )
        late_s += more_s
    if abs(late_s) > OFFSET_SIGMAS * math.hypot(sigma_s, OFFSET_PRIOR_S):
        return late_s, sigma_s
    worth = OFFSET_PRIOR_S**2 / (OFFSET_PRIOR_S**2 + sigma_s**2)
    return late_s * worth, sigma_s * math.sqrt(worth)


def _later(
    time_s: Floats, roll_rad: Floats, pitch_rad: Floats, track: HeadTrack, zero: Cycle, sigma_rad: float
) -> tuple[float, float]:
    """How much later than thought a log is by its wave, and the uncertainty [s]."""
    part = ((time_s - time_s[0]) / OFFSET_STEP_S).astype(np.int64)
    _, part = np.unique(part, return_inverse=True)
    count = np.bincount(part)
    azimuth_rad = head_azimuth(track, time_s)
    speed_rad_s = np.gradient(azimuth_rad, time_s)
    cos, sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
    middle_s = np.bincount(part, time_s) / count
    moved = MOTION_RAD**2 * np.exp(-np.abs(np.subtract.outer(middle_s, middle_s)) / MOTION_S)
    root = np.linalg.cholesky(moved + np.diag(sigma_rad**2 / count))
    # Amplitude changes by ±20 % between scans, EQUATIONS 2.7.
    normal = np.diag([1 / OFFSET_LARGEST_S**2, 1 / 0.2**2, 0.0, 0.0])
    right = np.zeros(4)
    for axis, (lean_rad, wave) in enumerate(((roll_rad, zero.roll_rad), (pitch_rad, zero.pitch_rad))):
        shape = wave[1] * cos + wave[2] * sin
        late = (wave[1] * sin - wave[2] * cos) * speed_rad_s
        mean = [np.full_like(time_s, axis == other) for other in (0, 1)]
        columns = [late, shape, *mean, lean_rad - wave[0] - shape]
        means = np.stack([np.bincount(part, column) / count for column in columns], axis=-1)
        white = np.linalg.solve(root, means)
        normal += white[:, :4].T @ white[:, :4]
        right += white[:, :4].T @ white[:, 4]
    covariance = np.linalg.inv(normal)
    return float((covariance @ right)[0]), float(math.sqrt(covariance[0, 0]))


def blackman(samples: int) -> Floats:
    """Weights (N,) of a Blackman window that sum to one [1].

    Source: EQUATIONS 2.8, Voordendag et al. (2023), section 3.1.
    """
    window = np.blackman(samples)
    return np.asarray(window / window.sum())


def low_pass(values: Floats, weights: Floats) -> Floats:
    """Values (n,) convolved with symmetric weights, mirrored oddly beyond both ends.

    The mirror turns about the mean of the first and last ten values. Source: EQUATIONS 2.8.
    """
    half = len(weights) // 2
    ends = min(10, len(values))
    before = 2 * values[:ends].mean() - values[half:0:-1]
    after = 2 * values[-ends:].mean() - values[-2 : -half - 2 : -1]
    return np.convolve(np.concatenate([before, values, after]), weights, mode="valid")


def window_length(values: Floats, rate_hz: float, cutoff_hz: float | None) -> int:
    """Samples the window needs, odd: for a given cut-off, or for where the spectrum sinks into noise.

    Noise is the median of the spectrum's upper half; the cut-off is where five smoothed bins first fall
    below twice that. Source: EQUATIONS 2.8.
    """
    if cutoff_hz is None:
        frequency_hz, power = spectrum(values, rate_hz)
        smooth = ndimage.uniform_filter1d(power, 5, mode="nearest")
        noise = np.median(power[frequency_hz > frequency_hz[-1] / 2])
        quiet = np.flatnonzero(smooth[1:] < 2 * noise)
        cutoff_hz = float(frequency_hz[1:][quiet[0]] if len(quiet) else frequency_hz[-1] / 2)
    shortest, longest = WINDOW_SAMPLES
    longest = max(shortest, min(longest, len(values) // 3))
    samples = int(np.clip(round(BLACKMAN_CUTOFF * rate_hz / cutoff_hz), shortest, longest))
    return samples | 1


def spectrum(values: Floats, rate_hz: float) -> tuple[Floats, Floats]:
    """Frequencies [Hz] and power density [1/Hz] of values (n,) without their trend: of windowed stretches.

    As scipy.signal, whose import costs more than all that is done with a log. Source: Welch (1967).
    """
    number = np.arange(len(values))
    free = values - np.polynomial.Polynomial.fit(number, values, 1)(number)
    length = min(256, len(values))
    window = np.hanning(length + 1)[:-1]
    stretches = np.lib.stride_tricks.sliding_window_view(free, length)[:: length - length // 2]
    windowed = (stretches - stretches.mean(axis=1, keepdims=True)) * window
    power = np.mean(np.abs(np.fft.rfft(windowed)) ** 2, axis=0) / (rate_hz * np.sum(window**2))
    power[1 : (length + 1) // 2] *= 2  # of negative frequencies too, but for the ends
    return np.asarray(np.fft.rfftfreq(length, 1 / rate_hz)), np.asarray(power, dtype=np.float64)


@dataclass(frozen=True)
class Lean:
    """What the log says of a scan: the tilt to apply and how well it is known.

    `raw` is the same before the filter. `noise_rad` is of one raw sample, `filtered_noise_rad` of the
    filtered signal, whose errors are common to everything measured within `memory_s`. `gap_s` is the longest
    stretch without a sample.
    """

    tilt: Tilt
    raw: Tilt
    mean_roll_rad: float
    mean_pitch_rad: float
    noise_rad: float
    filtered_noise_rad: float
    memory_s: float
    cutoff_hz: float
    offset_s: float
    offset_sigma_s: float
    gap_s: float


def without_time(lean: Lean) -> Lean:
    """Return one mean lean for a scan whose points carry no time."""
    roll_rad, pitch_rad = lean.tilt.roll_rad.mean(), lean.tilt.pitch_rad.mean()
    still = Tilt(np.zeros(1), np.array([roll_rad]), np.array([pitch_rad]))
    return replace(lean, tilt=still)


def relative_lean(
    log: InclinationLog,
    track: HeadTrack | None,
    zero: Cycle,
    sigma_rad: float,
    cutoff_hz: float | None = None,
    *,
    filtered: bool = True,
) -> Lean:
    """Return the lean beyond what the SOP already holds, filtered, from a clean log of a scan.

    `zero` is the wave of the scan the SOP was solved from (`LEVEL` where the SOP holds no lean). It goes
    before the filter does its work, so that the filter's ends have little left to spoil.
    Source: EQUATIONS 2.5, 2.8-2.10; absolute lean and SOP together would apply it twice.
    """
    offset_s, offset_sigma_s = 0.0, OFFSET_PRIOR_S
    azimuth_rad = np.zeros_like(log.time_s)
    time_s = log.time_s
    if track is not None:
        offset_s, offset_sigma_s = clock_offset(log, track, zero, sigma_rad)
        time_s = log.time_s - offset_s
        azimuth_rad = head_azimuth(track, time_s)
    zero_roll, zero_pitch = zero.at(azimuth_rad)
    step_s = float(np.median(np.diff(time_s)))
    even_s = np.arange(time_s[0], time_s[-1] + step_s / 2, step_s)
    roll, pitch = (
        np.interp(even_s, time_s, v) for v in (log.roll_rad - zero_roll, log.pitch_rad - zero_pitch)
    )
    weights = np.ones(1)
    if filtered:
        samples = max(window_length(values, 1 / step_s, cutoff_hz) for values in (roll, pitch))
        weights = blackman(samples)
    smooth_roll, smooth_pitch = low_pass(roll, weights), low_pass(pitch, weights)
    noise_rad = sigma_rad
    if filtered:
        noise_rad = float(np.sqrt(np.mean([np.var(roll - smooth_roll), np.var(pitch - smooth_pitch)])))
    return Lean(
        tilt=Tilt(even_s, smooth_roll, smooth_pitch),
        raw=Tilt(even_s, roll, pitch),
        mean_roll_rad=float(log.roll_rad.mean()),
        mean_pitch_rad=float(log.pitch_rad.mean()),
        noise_rad=noise_rad,
        filtered_noise_rad=noise_rad * float(np.sqrt(np.sum(weights**2))),
        memory_s=step_s / float(np.sum(weights**2)),
        cutoff_hz=BLACKMAN_CUTOFF / (len(weights) * step_s),
        offset_s=offset_s,
        offset_sigma_s=offset_sigma_s,
        gap_s=float(np.max(np.diff(time_s))),
    )
