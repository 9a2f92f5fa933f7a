"""Tilt of every shot from the inclination log: cleaning, gaps and low-pass filter."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from station.quantities import AzimuthTrack, Bools, Floats, InclinationLog, Ints, TiltSeries
from station.science.geometry.cyclic_error import (
    CYCLIC_ERROR_PRIOR_RAD,
    OFFSET_PRIOR_S,
    CyclicError,
    clock_offset,
    head_azimuth,
)
from station.science.geometry.robust_statistics import NORMAL_MAD

SENSOR_STEP_RAD = math.radians(0.001)  # resolution of the log
MIN_GAP_S, MIN_GAP_STEPS = 10.0, 3.0  # a longer interval without a sample is a gap, so is one of more steps
MAX_ISOLATION_S, MAX_ISOLATION_STEPS = 60.0, 10.0  # of the first or last row; further off its time is wrong
END_SAMPLES = 10  # whose mean stands at the ends of the log and of its gaps
HAMPEL_HALF_WIDTH = 7  # samples
HAMPEL_SIGMAS = 5.0
MIN_TIMED_ROWS = 4  # fewer do not show which of them is isolated
WINDOW_SAMPLES = (5, 301)  # shortest that smooths; longest that still follows changes within five minutes
# A one-minute window for a scan that is adjusted: the adjustment estimates faster tilt from the raw log
# and the ground, but it cannot remove noise passed by a short window, which differs from shot to shot.
JOINT_CUTOFF_HZ = 0.82 / 61
BLACKMAN_CUTOFF = 0.82  # -3 dB frequency of an N-sample Blackman window times N, equations.md, 2.8
AXES_MARGIN = 4.0  # by how much closer to the SOP the log must be with its axes swapped or reversed
WRONG_AXES = (
    ("roll has the opposite sign", [0, 1], (-1, 1)),
    ("pitch has the opposite sign", [0, 1], (1, -1)),
    ("roll and pitch have the opposite sign", [0, 1], (-1, -1)),
    ("roll and pitch are swapped", [1, 0], (1, 1)),
    ("roll and pitch are swapped and have the opposite sign", [1, 0], (-1, -1)),
    ("roll and pitch are swapped and the true roll has the opposite sign", [1, 0], (-1, 1)),
    ("roll and pitch are swapped and the true pitch has the opposite sign", [1, 0], (1, -1)),
)


def joined(logs: Sequence[InclinationLog]) -> InclinationLog:
    """Return the logs of the files of one scan as one, by their first times; each time is kept once."""
    if len(logs) == 1:
        return logs[0]
    ordered = sorted(logs, key=lambda log: min(log.time_s, default=0.0))
    columns = np.hstack([np.stack([log.time_s, log.roll_rad, log.pitch_rad]) for log in ordered])
    _, first = np.unique(columns[0], return_index=True)
    columns = columns[:, np.sort(first)]
    return InclinationLog(columns[0], columns[1], columns[2])


def clean(log: InclinationLog, range_rad: float) -> tuple[InclinationLog, int]:
    """Return the log without invalid rows, and the number of rows removed.

    Removed are values that are not finite or at the end of the sensor's range or beyond, rows with a wrong
    time, and spikes (Hampel: five robust sigmas from the median of fifteen neighbours).
    """
    columns = np.stack([log.time_s, log.roll_rad, log.pitch_rad])
    columns = columns[:, np.all(np.isfinite(columns), axis=0)]
    columns = columns[:, np.all(np.abs(columns[1:]) < range_rad - SENSOR_STEP_RAD / 2, axis=0)]
    columns = columns[:, _in_time_order(columns[0])]
    if columns.shape[1] > 2 * HAMPEL_HALF_WIDTH:
        width = (1, 2 * HAMPEL_HALF_WIDTH + 1)
        deviation = np.abs(columns[1:] - ndimage.median_filter(columns[1:], width, mode="nearest"))
        sigma = NORMAL_MAD * ndimage.median_filter(deviation, width, mode="nearest")
        spike = deviation > HAMPEL_SIGMAS * np.maximum(sigma, SENSOR_STEP_RAD)
        columns = columns[:, ~np.any(spike, axis=0)]
    cleaned = InclinationLog(columns[0], columns[1], columns[2])
    return cleaned, len(log.time_s) - len(cleaned.time_s)


def wrong_times(log: InclinationLog) -> int:
    """Return the number of rows of an uncleaned log with a wrong time; one that is only repeated is none."""
    time_s = log.time_s[np.isfinite(log.time_s)]
    run = np.cumsum(np.diff(time_s, prepend=time_s[:1]) != 0)  # rows of the same time
    return int(np.count_nonzero(~np.isin(run, run[_in_time_order(time_s)])))


def _in_time_order(time_s: Floats) -> Ints:
    """Return the indices of the rows with a plausible time: as many as possible with times that increase.

    First or last rows far from all others are left out too. Takes O(n log n).
    """
    rows = _longest_increasing(time_s)
    if len(rows) < MIN_TIMED_ROWS:
        return rows
    steps_s = np.diff(time_s[rows])
    is_close = steps_s <= max(MAX_ISOLATION_S, MAX_ISOLATION_STEPS * float(np.median(steps_s)))
    first, last = int(np.argmax(is_close)), len(rows) - int(np.argmax(is_close[::-1]))
    return rows[first:last]


def _longest_increasing(values: Floats) -> Ints:
    """Return the indices of a longest strictly increasing subsequence of values (n,)."""
    if np.all(np.diff(values) > 0):
        return np.arange(len(values))
    smallest_ends: list[float] = []  # of the subsequences of each length
    end_rows: list[int] = []
    previous = np.full(len(values), -1, np.int64)
    for row, value in enumerate(values.tolist()):
        length = bisect_left(smallest_ends, value)
        if length:
            previous[row] = end_rows[length - 1]
        smallest_ends[length : length + 1] = [value]
        end_rows[length : length + 1] = [row]
    rows = end_rows[-1:]
    while previous[rows[-1]] >= 0:
        rows.append(int(previous[rows[-1]]))
    return np.array(rows[::-1])


def saturated_fraction(log: InclinationLog, range_rad: float) -> float:
    """Fraction of the rows of an uncleaned log that are at the end of the sensor's range or beyond [1]."""
    tilt_rad = np.maximum(np.abs(log.roll_rad), np.abs(log.pitch_rad))
    return float(np.mean(tilt_rad >= range_rad - SENSOR_STEP_RAD / 2)) if len(tilt_rad) else 0.0


def mount_inclination(mount: Floats) -> Floats:
    """Return roll and pitch (2,) [rad] that a sensor without error shows on a mount.

    `mount` (3, 3) rotates the scanner's frame into the local frame, the tilt of the mount included.
    """
    return np.array([math.atan2(mount[2, 1], mount[2, 2]), -math.asin(np.clip(mount[2, 0], -1.0, 1.0))])


def axes_warnings(log: InclinationLog, mount: Floats) -> list[str]:
    """Return a message if roll and pitch of a clean log agree with the SOP only if swapped or reversed.

    `mount` is that of `mount_inclination`. Logs of a level mount, and of one whose tilt is not contained in
    the SOP, get no message.
    """
    expected_rad = mount_inclination(mount)
    mean_rad = np.array([log.roll_rad.mean(), log.pitch_rad.mean()])
    tolerance_rad = 2 * CYCLIC_ERROR_PRIOR_RAD + 2 * max(log.roll_rad.std(), log.pitch_rad.std())
    deviation_rad = float(np.linalg.norm(mean_rad - expected_rad))
    if deviation_rad < AXES_MARGIN * tolerance_rad:
        return []
    for fault, order, signs in WRONG_AXES:
        corrected_rad = mean_rad[order] * signs
        if np.linalg.norm(corrected_rad - expected_rad) < min(tolerance_rad, deviation_rad / AXES_MARGIN):
            (roll, pitch), (sop_roll, sop_pitch) = np.degrees(mean_rad), np.degrees(expected_rad)
            message = (
                f"axes of the inclination log are wrong: {fault} (roll {roll:.2f}, pitch {pitch:.2f} degrees,"
                f" in the SOP {sop_roll:.2f}, {sop_pitch:.2f})"
            )
            return [message]
    return []


def blackman(samples: int) -> Floats:
    """Weights (N,) of a Blackman window, normalised to a sum of one [1].

    Source: equations.md, 2.8, Voordendag et al. (2023), section 3.1.
    """
    window = np.blackman(samples)
    return np.asarray(window / window.sum())


def low_pass(values: Floats, weights: Floats) -> Floats:
    """Values (n,) convolved with symmetric weights, with odd reflection beyond both ends.

    The values are reflected about the mean of the first and of the last ten. Source: equations.md, 2.8.
    """
    half = len(weights) // 2
    ends = min(END_SAMPLES, len(values))
    mirrored_start = 2 * values[:ends].mean() - values[half:0:-1]
    mirrored_end = 2 * values[-ends:].mean() - values[-2 : -half - 2 : -1]
    return np.convolve(np.concatenate([mirrored_start, values, mirrored_end]), weights, mode="valid")


def window_length(values: Floats, rate_hz: float, cutoff_hz: float | None) -> int:
    """Odd window length [samples] for a cut-off; without one, for where the spectrum falls to the noise.

    The noise is the median of the spectrum's upper half; the cut-off is where the spectrum, smoothed over
    five bins, first falls below twice that. Source: equations.md, 2.8.
    """
    if cutoff_hz is None:
        from scipy import signal  # noqa: PLC0415 - takes 0.8 s of CPU time, and few scans need it

        frequency_hz, power = signal.welch(signal.detrend(values), rate_hz, nperseg=min(256, len(values)))
        smooth = ndimage.uniform_filter1d(power, 5, mode="nearest")
        noise = np.median(power[frequency_hz > frequency_hz[-1] / 2])
        quiet = np.flatnonzero(smooth[1:] < 2 * noise)
        cutoff_hz = float(frequency_hz[1:][quiet[0]] if len(quiet) else frequency_hz[-1] / 2)
    shortest, longest = WINDOW_SAMPLES
    longest = max(shortest, min(longest, len(values) // 3))
    samples = int(np.clip(round(BLACKMAN_CUTOFF * rate_hz / cutoff_hz), shortest, longest))
    return samples | 1


@dataclass(frozen=True)
class TiltRecord:
    """Tilt to apply to a scan, from the log, and its uncertainty.

    `unfiltered` is the tilt before the low-pass filter. `noise_rad` is the noise of one unfiltered sample,
    `filtered_noise_rad` that of the filtered tilt, whose errors are correlated over `correlation_time_s`.
    `gaps_s` (g, 2) are first and last time of each gap between samples, which is bridged by a line. Before
    and after the log the tilt is kept constant.
    """

    tilt: TiltSeries
    unfiltered: TiltSeries
    mean_roll_rad: float
    mean_pitch_rad: float
    noise_rad: float
    filtered_noise_rad: float
    correlation_time_s: float
    cutoff_hz: float
    offset_s: float
    offset_sigma_s: float
    gaps_s: Floats

    @property
    def is_constant(self) -> bool:
        """True if it is one mean tilt for the whole scan."""
        return len(self.tilt.time_s) == 1

    @property
    def end_noise_rad(self) -> float:
        """Noise of the tilt at the ends of the log and of its gaps: a mean of ten samples [rad]."""
        return max(self.filtered_noise_rad, self.noise_rad / math.sqrt(END_SAMPLES))

    def with_clock_offset(self, offset_s: float, sigma_s: float) -> TiltRecord:
        """Return the record with its times corrected for a further clock offset of the log [s].

        The cyclic error keeps the azimuths at which it was subtracted: 0.0005° for a wave of 0.04° and 5 s,
        and the offset of a log with a larger wave is known already.
        """
        tilt, unfiltered = (
            replace(series, time_s=series.time_s - offset_s) for series in (self.tilt, self.unfiltered)
        )
        return replace(
            self,
            tilt=tilt,
            unfiltered=unfiltered,
            gaps_s=self.gaps_s - offset_s,
            offset_s=self.offset_s + offset_s,
            offset_sigma_s=sigma_s,
        )

    def is_sampled(self, time_s: Floats) -> Bools:
        """Return True where the log has samples around times (n,): within it and not in a gap."""
        first_s, last_s = self.unfiltered.time_s[[0, -1]]
        return np.asarray((time_s >= first_s) & (time_s <= last_s) & ~_inside(self.gaps_s, time_s))


def mean_tilt(record: TiltRecord) -> TiltRecord:
    """Return the record with its mean tilt only, for a scan whose points carry no time."""
    roll_rad, pitch_rad = record.tilt.roll_rad.mean(), record.tilt.pitch_rad.mean()
    constant = TiltSeries(np.zeros(1), np.array([roll_rad]), np.array([pitch_rad]))
    return replace(record, tilt=constant)


def relative_tilt(
    log: InclinationLog,
    track: AzimuthTrack | None,
    zero: CyclicError,
    sigma_rad: float,
    cutoff_hz: float | None = None,
    *,
    filtered: bool = True,
) -> TiltRecord:
    """Return the filtered tilt relative to that contained in the SOP, from a clean log of a scan.

    `zero` is the cyclic error of the scan that the SOP was solved from, `NO_CYCLIC_ERROR` if the SOP contains
    no tilt. It is subtracted before filtering, which leaves little signal for the filter's ends to distort.
    Source: equations.md, 2.5 and 2.8-2.10; absolute tilt and SOP together would apply it twice.
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
    gaps_s = _gaps(time_s, step_s)
    roll, pitch = (
        _resample(even_s, time_s, tilt_rad, gaps_s)
        for tilt_rad in (log.roll_rad - zero_roll, log.pitch_rad - zero_pitch)
    )
    weights = np.ones(1)
    if filtered:
        samples = max(window_length(values, 1 / step_s, cutoff_hz) for values in (roll, pitch))
        weights = blackman(samples)
    smooth_roll, smooth_pitch = low_pass(roll, weights), low_pass(pitch, weights)
    noise_rad = sigma_rad
    if filtered:
        noise = np.stack([roll - smooth_roll, pitch - smooth_pitch])[:, ~_inside(gaps_s, even_s)]
        noise_rad = float(np.sqrt(np.mean(np.var(noise, axis=1))))
    return TiltRecord(
        tilt=TiltSeries(even_s, smooth_roll, smooth_pitch),
        unfiltered=TiltSeries(even_s, roll, pitch),
        mean_roll_rad=float(log.roll_rad.mean()),
        mean_pitch_rad=float(log.pitch_rad.mean()),
        noise_rad=noise_rad,
        filtered_noise_rad=noise_rad * float(np.sqrt(np.sum(weights**2))),
        correlation_time_s=step_s / float(np.sum(weights**2)),
        cutoff_hz=BLACKMAN_CUTOFF / (len(weights) * step_s),
        offset_s=offset_s,
        offset_sigma_s=offset_sigma_s,
        gaps_s=gaps_s,
    )


def _gaps(time_s: Floats, step_s: float) -> Floats:
    """Return first and last time of each gap between samples at times (n,) as (g, 2) [s]."""
    before = np.flatnonzero(np.diff(time_s) > max(MIN_GAP_S, MIN_GAP_STEPS * step_s))
    return np.stack([time_s[before], time_s[before + 1]], axis=-1)


def _inside(gaps_s: Floats, time_s: Floats) -> Bools:
    """Return True where times (n,) are in a gap (g, 2)."""
    gap = np.searchsorted(gaps_s[:, 0], time_s) - 1
    return np.asarray((gap >= 0) & (time_s < np.append(gaps_s[:, 1], -np.inf)[gap]))


def _resample(even_s: Floats, time_s: Floats, tilt_rad: Floats, gaps_s: Floats) -> Floats:
    """Return samples (n,) interpolated at even times; across a gap, between means of the samples beside it.

    A line between the two single samples would carry their noise through the whole gap.
    """
    resampled = np.interp(even_s, time_s, tilt_rad)
    for first_s, last_s in gaps_s:
        before, after = np.searchsorted(time_s, [first_s, last_s])
        ends_rad = (
            tilt_rad[max(before + 1 - END_SAMPLES, 0) : before + 1].mean(),
            tilt_rad[after : after + END_SAMPLES].mean(),
        )
        inside = slice(*np.searchsorted(even_s, [first_s, last_s], side="right"))
        resampled[inside] = np.interp(even_s[inside], (first_s, last_s), ends_rad)
    return resampled
