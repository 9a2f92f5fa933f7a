"""Wave in an inclination log over a turn of the head: its amplitude, and by its phase the log's clock."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from station.quantities import AzimuthTrack, Floats, InclinationLog

CYCLIC_ERROR_PRIOR_RAD = math.radians(0.05)  # largest cyclic error seen at Helheim, equations.md, 2.7
CYCLIC_CHANGE_SHARE = 0.2  # of its amplitude, between scans: equations.md, 2.7
# Of its change of shape between scans, along the line of sight. An adjustment and the clock allow root two
# times as much; without an adjustment sigma of heights on the map would then be too large.
CYCLIC_CHANGE_RAD = math.radians(0.002)
OFFSET_PRIOR_S = 2.5  # clocks differ by up to 5 s, taken as two sigma: Voordendag et al. (2023), section 3.1
OFFSET_LARGEST_S = 600.0  # one sigma of a clock that is never set
OFFSET_SIGMAS = 5.0  # deviation from the clock prior beyond which the log overrules it
OFFSET_ROUNDS = 4
OFFSET_STEP_S = 10.0
# Tilt drift of the mount during this scan and that of the cyclic error: equations.md, 6.3 and 6.4.
MOTION_RAD, MOTION_S = math.radians(0.003), 300.0


@dataclass(frozen=True)
class CyclicError:
    """Cyclic error of the tilt over one turn of the head [rad]: b0 + b1 cos θ + b2 sin θ.

    Source: equations.md, 2.7, the sinusoid of Voordendag et al. (2023), Fig. 3.
    """

    roll_rad: tuple[float, float, float]
    pitch_rad: tuple[float, float, float]

    def at(self, azimuth_rad: Floats) -> tuple[Floats, Floats]:
        """Roll and pitch at head azimuths (n,) [rad]."""
        wave = _waves(azimuth_rad)
        return np.asarray(wave @ self.roll_rad), np.asarray(wave @ self.pitch_rad)


NO_CYCLIC_ERROR = CyclicError((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def _waves(azimuth_rad: Floats) -> Floats:
    return np.stack([np.ones_like(azimuth_rad), np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)


def head_azimuth(track: AzimuthTrack, time_s: Floats) -> Floats:
    """Azimuth of the scan head at times (n,) [rad]; constant before and after the scan."""
    return np.interp(time_s, track.time_s, track.azimuth_rad)


def fit_cyclic_error(log: InclinationLog, track: AzimuthTrack, sigma_rad: float) -> CyclicError:
    """Return the cyclic error fitted to the part of a clean log that lies within the scan.

    A sector of a turn cannot separate the wave from its mean: a prior of 0.05° on the wave resolves this.
    Source: equations.md, 2.7.
    """
    inside = (log.time_s >= track.time_s[0]) & (log.time_s <= track.time_s[-1])
    design = _waves(head_azimuth(track, log.time_s[inside]))
    normal = design.T @ design + np.diag([0.0, 1.0, 1.0]) * (sigma_rad / CYCLIC_ERROR_PRIOR_RAD) ** 2
    roll, pitch = (
        np.linalg.lstsq(normal, design.T @ tilt_rad[inside], rcond=None)[0]
        for tilt_rad in (log.roll_rad, log.pitch_rad)
    )
    return CyclicError((roll[0], roll[1], roll[2]), (pitch[0], pitch[1], pitch[2]))


def clock_offset(
    log: InclinationLog, track: AzimuthTrack, zero: CyclicError, sigma_rad: float
) -> tuple[float, float]:
    """Delay of the log's clock against the scan's, and its uncertainty [s].

    The known cyclic error is fitted to the log with free mean, amplitude and phase; phase over head speed is
    time. Real motion of the mount looks like phase too, and so does a wave that has changed its shape: both
    are part of the uncertainty. The prior that clocks agree to 5 s (two sigma) shrinks the delay where the
    wave is too small to determine it, unless the log contradicts that prior.
    Source: equations.md, 2.10.
    """
    delay_s, sigma_s = 0.0, OFFSET_LARGEST_S
    for _ in range(OFFSET_ROUNDS):
        time_s = log.time_s - delay_s
        inside = (time_s >= track.time_s[0]) & (time_s <= track.time_s[-1])
        if np.count_nonzero(inside) < 60:
            return 0.0, OFFSET_PRIOR_S
        step_s, sigma_s = _phase_delay(
            time_s[inside], log.roll_rad[inside], log.pitch_rad[inside], track, zero, sigma_rad
        )
        delay_s += step_s
    if abs(delay_s) > OFFSET_SIGMAS * math.hypot(sigma_s, OFFSET_PRIOR_S):
        return delay_s, sigma_s
    shrinkage = OFFSET_PRIOR_S**2 / (OFFSET_PRIOR_S**2 + sigma_s**2)
    return delay_s * shrinkage, sigma_s * math.sqrt(shrinkage)


def _phase_delay(
    time_s: Floats,
    roll_rad: Floats,
    pitch_rad: Floats,
    track: AzimuthTrack,
    zero: CyclicError,
    sigma_rad: float,
) -> tuple[float, float]:
    """Return the delay of a log by the phase of its cyclic error, and its uncertainty [s]."""
    bin_index = ((time_s - time_s[0]) / OFFSET_STEP_S).astype(np.int64)
    _, bin_index = np.unique(bin_index, return_inverse=True)
    count = np.bincount(bin_index)
    azimuth_rad = head_azimuth(track, time_s)
    speed_rad_s = np.gradient(azimuth_rad, time_s)
    cos, sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
    middle_s, middle_rad = (np.bincount(bin_index, values) / count for values in (time_s, azimuth_rad))
    drift_rad2 = MOTION_RAD**2 * np.exp(-np.abs(np.subtract.outer(middle_s, middle_s)) / MOTION_S)
    shape_rad2 = 2 * CYCLIC_CHANGE_RAD**2 * np.cos(np.subtract.outer(middle_rad, middle_rad))
    cholesky = np.linalg.cholesky(drift_rad2 + shape_rad2 + np.diag(sigma_rad**2 / count))
    normal = np.diag([1 / OFFSET_LARGEST_S**2, 1 / CYCLIC_CHANGE_SHARE**2, 0.0, 0.0])
    rhs = np.zeros(4)
    for axis, (tilt_rad, wave) in enumerate(((roll_rad, zero.roll_rad), (pitch_rad, zero.pitch_rad))):
        expected = wave[1] * cos + wave[2] * sin
        per_second = (wave[1] * sin - wave[2] * cos) * speed_rad_s
        mean = [np.full_like(time_s, axis == other) for other in (0, 1)]
        columns = [per_second, expected, *mean, tilt_rad - wave[0] - expected]
        means = np.stack([np.bincount(bin_index, column) / count for column in columns], axis=-1)
        whitened = np.linalg.solve(cholesky, means)
        normal += whitened[:, :4].T @ whitened[:, :4]
        rhs += whitened[:, :4].T @ whitened[:, 4]
    covariance = np.linalg.inv(normal)
    return float((covariance @ rhs)[0]), float(math.sqrt(covariance[0, 0]))
