"""Prior of a scan: expected errors of the scanner's state, the inclination log and the air."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from station.quantities import (
    AzimuthTrack,
    Floats,
    Ints,
    SharedParameters,
    TiltSeries,
    VarianceComponents,
)
from station.science.adjustment.line_tilt import LineTiltPrior
from station.science.adjustment.normal_equations import LineInclination, StatePrior
from station.science.geometry.cyclic_error import (
    CYCLIC_CHANGE_RAD,
    CYCLIC_CHANGE_SHARE,
    NO_CYCLIC_ERROR,
    CyclicError,
)
from station.science.geometry.inclination import SENSOR_STEP_RAD, TiltRecord
from station.science.uncertainty.jacobian import sight_tilt_of
from station.science.uncertainty.parameters import (
    GLOBAL,
    LINE_GROUPS_PER_KNOT,
    TILT_KNOTS_PER_REFRACTION,
    ParameterLayout,
)
from station.science.uncertainty.propagation import condense_to_knots

REFRACTION_CORRELATION_RAD = math.radians(15.0)
RANGE_SCALE_UNKNOWN_PPM = 4.0  # no weather: 5 K and 5 hPa off, 0.737 ppm/K, 0.290 ppm/hPa, equations.md, 5.8
MAX_CYCLIC_ERROR_RAD = math.radians(0.05)  # a larger wave is the mount's tilt, which does not change
TILT_DRIFT_S = 300.0
TILT_JITTER_S = 3.0
PRIOR_INCREMENTS = 4  # of the drift in a scan's log: as many as a log of ten minutes shows
CYCLIC_ERROR_RMS_RAD = math.radians(0.04) / math.sqrt(2)  # 0.03° to 0.05° of any phase: equations.md, 2.7
SENSOR_BIAS_RAD = math.radians(0.0015)
BIAS_MODES = 2  # first error modes of a `LineInclination`: bias in roll and in pitch
HEAD_SPEED_RAD_S = math.radians(0.13)  # if the scan has no azimuth track; equations.md, 2.10


def globals_sigma(components: VarianceComponents, *, weather_known: bool) -> Floats:
    """Return one sigma of each global parameter (10,), in its own unit."""
    scale_ppm = components.range_scale_ppm if weather_known else RANGE_SCALE_UNKNOWN_PPM
    rotations, translations = (
        (components.tilt_rad, components.tilt_rad, components.heading_rad),
        (components.translation_m,) * 3,
    )
    refraction = components.refraction, components.refraction_ice
    return np.array([*rotations, *translations, components.range_bias_m, scale_ppm, *refraction])


@dataclass(frozen=True)
class LineTimes:
    """Head azimuth and time of each scan-line group.

    Azimuth is in the scanner's frame: about its z axis, counter-clockwise from x. `time_s` is in the scan's
    time base.
    """

    azimuth_rad: Floats  # (lines,)
    time_s: Floats  # (lines,)


def line_times(params: ParameterLayout, to_local: Floats, track: AzimuthTrack | None) -> LineTimes:
    """Return the azimuth and time of each line group, from the azimuth track or the head's usual speed.

    `to_local` (3, 3) rotates the scanner's frame into the map frame. Times outside the scan are extrapolated.
    """
    x, y, _ = to_local.T @ params.sight_directions
    azimuth_rad = np.unwrap(np.arctan2(y, x))
    if track is None:
        return LineTimes(azimuth_rad, np.abs(azimuth_rad - azimuth_rad[0]) / HEAD_SPEED_RAD_S)
    middle = (track.azimuth_rad.min() + track.azimuth_rad.max()) / 2
    azimuth_rad = middle + (azimuth_rad - middle + math.pi) % (2 * math.pi) - math.pi
    order = np.argsort(track.azimuth_rad)
    track_rad, track_s = track.azimuth_rad[order], track.time_s[order]
    seconds_per_rad = float(np.ptp(track_s) / np.ptp(track_rad)) * (1 if track_s[-1] > track_s[0] else -1)
    time_s = np.interp(azimuth_rad, track_rad, track_s)
    extrapolated_rad = azimuth_rad - np.clip(azimuth_rad, track_rad[0], track_rad[-1])
    return LineTimes(azimuth_rad, time_s + extrapolated_rad * seconds_per_rad)


def tilt_rotation(tilt: TiltSeries, to_local: Floats, time_s: Floats) -> Floats:
    """Return the scanner's tilt at given times (n,) as a rotation about east, north and up (3, n) [rad]."""
    roll_rad, pitch_rad = (
        np.interp(time_s, tilt.time_s, values) for values in (tilt.roll_rad, tilt.pitch_rad)
    )
    return np.asarray(to_local @ np.stack([roll_rad, pitch_rad, np.zeros_like(roll_rad)]))


def line_inclination(
    params: ParameterLayout,
    lines: LineTimes,
    tilt_record: TiltRecord,
    tilt_offset: CyclicError,
    to_local: Floats,
) -> LineInclination:
    """Return the inclination log per line group, projected on the line of sight, with its error modes.

    Line groups without a sample, as in a gap, have the weight zero.
    Source: adjustment.md, 4; equations.md, 6.3.
    """
    order = np.argsort(lines.time_s)
    times_s = lines.time_s[order]
    edges_s = (times_s[1:] + times_s[:-1]) / 2
    time_s = tilt_record.unfiltered.time_s
    inside = tilt_record.is_sampled(time_s)
    inside &= (time_s >= 2 * times_s[0] - edges_s[0]) & (time_s <= 2 * times_s[-1] - edges_s[-1])
    line = order[np.searchsorted(edges_s, time_s[inside])]
    east, north, _ = tilt_rotation(tilt_record.unfiltered, to_local, time_s[inside])
    azimuth_rad = params.line_azimuth_rad
    sight_rad = np.cos(azimuth_rad[line]) * east - np.sin(azimuth_rad[line]) * north
    count = np.bincount(line, minlength=params.line_groups)
    ones = np.ones_like(azimuth_rad)
    error_modes = np.concatenate(
        [
            sight_tilt_of(azimuth_rad) * SENSOR_BIAS_RAD,
            np.stack([ones, np.cos(2 * azimuth_rad), np.sin(2 * azimuth_rad)], axis=-1) * CYCLIC_CHANGE_RAD,
            cyclic_error_modes(lines, tilt_offset),
        ],
        axis=1,
    )
    noise_rad = max(tilt_record.noise_rad, SENSOR_STEP_RAD)
    mean_rad = np.bincount(line, sight_rad, params.line_groups) / np.maximum(count, 1)
    return LineInclination(mean_rad, count / noise_rad**2, error_modes)


def tilt_correlations(lines: LineTimes) -> tuple[Floats, Floats, Floats]:
    """Return the correlations (lines, lines) of tilt drift, tilt jitter and line jitter.

    Source: equations.md, 6.3.
    """
    drift, jitter = (
        _exponential_correlation(lines.time_s, correlation_s)
        for correlation_s in (TILT_DRIFT_S, TILT_JITTER_S)
    )
    return drift, jitter, np.eye(len(drift))


def _exponential_correlation(time_s: Floats, correlation_s: float) -> Floats:
    """Return the correlation (n, n) between times (n,) of a process with exponential correlation."""
    return np.asarray(np.exp(-np.abs(np.subtract.outer(time_s, time_s)) / correlation_s))


def tilt_covariance(components: VarianceComponents, lines: LineTimes) -> Floats:
    """Return the prior covariance (lines, lines) of the sight tilt [rad²]."""
    drift, jitter, white = tilt_correlations(lines)
    return np.asarray(
        components.tilt_drift_rad**2 * drift
        + components.tilt_jitter_rad**2 * jitter
        + components.line_jitter_rad**2 * white
    )


def refraction_covariance(components: VarianceComponents, params: ParameterLayout) -> Floats:
    """Return the prior covariance (knots, knots) of the azimuth-dependent refraction."""
    separation_rad = np.abs(np.subtract.outer(params.refraction_azimuth_rad, params.refraction_azimuth_rad))
    separation_rad = np.minimum(separation_rad, 2 * math.pi - separation_rad)
    return np.asarray(
        components.refraction_by_azimuth**2 * np.exp(-separation_rad / REFRACTION_CORRELATION_RAD)
    )


def cross_tilt_covariance(
    components: VarianceComponents, params: ParameterLayout, lines: LineTimes
) -> Floats:
    """Return the prior covariance (knots, knots) of the cross tilt [rad²], which is that of the tilt drift.

    Knots half a minute from each other cannot represent tilt jitter. Line jitter comes from the mirror and
    acts along the line of sight only.
    """
    drift, _, _ = tilt_correlations(_knot_times(params, lines))
    return np.asarray(components.tilt_drift_rad**2 * drift)


def _knot_times(params: ParameterLayout, lines: LineTimes) -> LineTimes:
    """Return the azimuth and time of the refraction knots, which are also the cross-tilt knots."""
    position = LINE_GROUPS_PER_KNOT * TILT_KNOTS_PER_REFRACTION * np.arange(params.refraction_knots) - 0.5
    azimuth_rad, time_s = (
        np.interp(position, np.arange(params.line_groups), values)
        for values in (lines.azimuth_rad, lines.time_s)
    )
    return LineTimes(azimuth_rad, time_s)


def block_diagonal_covariance(
    params: ParameterLayout, sigmas: Floats, tilt_rad2: Floats, refraction: Floats, cross_tilt_rad2: Floats
) -> Floats:
    """Return the covariance (u, u) of globals, tilt by line group, refraction and cross tilt as blocks."""
    first, last = len(GLOBAL), len(GLOBAL) + params.line_groups
    cross_tilt_start = last + params.refraction_knots
    covariance = np.zeros((cross_tilt_start + params.refraction_knots,) * 2)
    covariance[:first, :first] = np.diag(np.square(sigmas))
    covariance[first:last, first:last] = tilt_rad2
    covariance[last:cross_tilt_start, last:cross_tilt_start] = refraction
    covariance[cross_tilt_start:, cross_tilt_start:] = cross_tilt_rad2
    return covariance


def state_prior(
    params: ParameterLayout, lines: LineTimes, components: VarianceComponents, *, weather_known: bool
) -> StatePrior:
    """Return the prior of a scan's state: tilt drift at knots, faster motion by line group.

    Tilt drift is not linear between knots, nor across the seam of a full-circle scan. The variance that this
    omits is added to the line tilts, so that the variance of each line group is exact; the correlation of the
    omitted part is neglected.
    """
    first_line_s, second_line_s = lines.time_s[::LINE_GROUPS_PER_KNOT], lines.time_s[1::LINE_GROUPS_PER_KNOT]
    knot_s = first_line_s - (second_line_s - first_line_s) / 2
    if not params.full_circle:
        knot_s = np.append(knot_s, lines.time_s[-1] + (lines.time_s[-1] - lines.time_s[-2]) / 2)
    drift = _exponential_correlation(knot_s, TILT_DRIFT_S)
    first, last = len(GLOBAL), len(GLOBAL) + params.sight_tilt_knots
    covariance = np.zeros((len(params.names),) * 2)
    covariance[:first, :first] = np.diag(np.square(globals_sigma(components, weather_known=weather_known)))
    covariance[first:last, first:last] = components.tilt_drift_rad**2 * drift
    cross_tilt_start = last + params.refraction_knots
    covariance[last:cross_tilt_start, last:cross_tilt_start] = refraction_covariance(components, params)
    covariance[cross_tilt_start:, cross_tilt_start:] = cross_tilt_covariance(components, params, lines)
    decorrelation = (
        1
        - drift[
            np.arange(params.knot_intervals), (np.arange(params.knot_intervals) + 1) % params.sight_tilt_knots
        ]
    )
    fraction = (np.arange(LINE_GROUPS_PER_KNOT) + 0.5) / LINE_GROUPS_PER_KNOT
    interpolation_variance = 2 * np.outer(decorrelation, fraction * (1 - fraction)).ravel()
    order = np.argsort(lines.time_s)
    return StatePrior(
        params,
        covariance,
        LineTiltPrior(
            order=order,
            lag_correlation=np.exp(-np.diff(lines.time_s[order]) / TILT_JITTER_S),
            correlated_variance_rad2=components.tilt_jitter_rad**2,
            white_variance_rad2=components.line_jitter_rad**2
            + components.tilt_drift_rad**2 * interpolation_variance,
        ),
    )


def log_only_covariance(
    params: ParameterLayout,
    lines: LineTimes,
    tilt_record: TiltRecord | None,
    tilt_offset: CyclicError,
    components: VarianceComponents,
    *,
    weather_known: bool,
) -> SharedParameters:
    """Return SharedParameters of a scan corrected by its log and the weather only, with zero estimates.

    The covariance holds the errors of the log: bias, change of the cyclic error, noise that passes the filter
    and motion that the filter removes, and in its gaps and beyond its ends the motion of the mount since the
    last sample. Without a log it holds all motion.
    """
    assumed = replace(components, tilt_rad=SENSOR_BIAS_RAD) if tilt_record else components
    drift_only = replace(components, tilt_jitter_rad=0.0, line_jitter_rad=0.0)
    covariance = block_diagonal_covariance(
        params,
        globals_sigma(assumed, weather_known=weather_known),
        _unfiltered_tilt(lines, tilt_record, tilt_offset, components)
        if tilt_record
        else tilt_covariance(components, lines),
        refraction_covariance(components, params),
        _unfiltered_tilt(_knot_times(params, lines), tilt_record, tilt_offset, drift_only, math.pi / 2)
        if tilt_record
        else cross_tilt_covariance(components, params, lines),
    )
    return condense_to_knots(params, np.zeros(len(covariance)), covariance)


def _unfiltered_tilt(
    lines: LineTimes,
    tilt_record: TiltRecord,
    tilt_offset: CyclicError,
    components: VarianceComponents,
    direction_rad: float = 0.0,
) -> Floats:
    """Return the covariance (lines, lines) of the tilt that remains after the filtered log is applied [rad²].

    Along the line of sight, or along a direction `direction_rad` counter-clockwise from it.
    """
    time_s, directions = lines.time_s, sight_tilt_of(lines.azimuth_rad)
    cos_angle = directions @ directions.T  # cosine of the angle between line groups
    # Share of the drift's spectrum (a Lorentzian) above the cut-off frequency.
    share = 1 - 2 / math.pi * math.atan(2 * math.pi * tilt_record.cutoff_hz * TILT_DRIFT_S)
    width_s = tilt_record.correlation_time_s / (
        2 * math.sqrt(math.pi)
    )  # Gaussian window of the same correlation time
    filter_correlation = np.exp(-((np.subtract.outer(time_s, time_s) / width_s) ** 2) / 4)
    cyclic_modes = cyclic_error_modes(lines, tilt_offset, direction_rad)
    unfiltered_rad2 = cyclic_modes @ cyclic_modes.T + CYCLIC_CHANGE_RAD**2 * cos_angle**2
    unfiltered_rad2 += tilt_record.filtered_noise_rad**2 * filter_correlation * cos_angle
    unfiltered_rad2 += components.tilt_jitter_rad**2 * _exponential_correlation(time_s, TILT_JITTER_S)
    unfiltered_rad2 += (
        components.tilt_drift_rad**2
        * share
        * _exponential_correlation(time_s, max(tilt_record.correlation_time_s, 1.0))
    )
    unfiltered_rad2[np.diag_indices_from(unfiltered_rad2)] += components.line_jitter_rad**2
    if not tilt_record.is_constant:
        unsampled, motion_rad2 = _unsampled_motion(lines, tilt_record, tilt_offset, components)
        unfiltered_rad2[np.ix_(unsampled, unsampled)] += motion_rad2 * cos_angle[np.ix_(unsampled, unsampled)]
    return np.asarray(unfiltered_rad2)


def _unsampled_motion(
    lines: LineTimes, tilt_record: TiltRecord, tilt_offset: CyclicError, components: VarianceComponents
) -> tuple[Ints, Floats]:
    """Return the m lines without samples of the log, and the covariance (m, m) of their tilt per axis [rad²].

    Beyond the log its last tilt is kept, across a gap a line is drawn. The error is the motion of the mount
    that this omits, by the process of the tilt drift, and the noise of the ends. In an absolute log, whose
    cyclic error is not subtracted, it is also that wave.
    Source: equations.md, 2.9.
    """
    unsampled = np.flatnonzero(~tilt_record.is_sampled(lines.time_s))
    time_s, gaps_s = lines.time_s[unsampled], tilt_record.gaps_s
    gap = np.unique(np.searchsorted(gaps_s[:, 0], time_s) - 1)  # a log may have thousands more
    ends_s = np.unique([*tilt_record.unfiltered.time_s[[0, -1]], *gaps_s[gap[gap >= 0]].ravel()])
    interpolation = np.stack([np.interp(time_s, ends_s, end) for end in np.eye(len(ends_s))], axis=-1)
    error = np.hstack([np.eye(len(time_s)), -interpolation])
    times_s = np.concatenate([time_s, ends_s])
    motion_rad2 = observed_drift_rad2(tilt_record, components) * _exponential_correlation(
        times_s, TILT_DRIFT_S
    )
    ends = np.arange(len(time_s), len(times_s))
    motion_rad2[ends, ends] += tilt_record.end_noise_rad**2 - tilt_record.filtered_noise_rad**2
    if tilt_offset == NO_CYCLIC_ERROR:
        order = np.argsort(lines.time_s)
        azimuth_rad = np.interp(times_s, lines.time_s[order], lines.azimuth_rad[order])
        waves_cos = np.cos(np.subtract.outer(azimuth_rad, azimuth_rad))
        motion_rad2 += CYCLIC_ERROR_RMS_RAD**2 * waves_cos
    return unsampled, np.asarray(error @ motion_rad2 @ error.T)


def observed_drift_rad2(tilt_record: TiltRecord, components: VarianceComponents) -> float:
    """Return the variance of the tilt drift per axis, from the components and the log of the scan [rad²].

    The log shows it by the increments of its filtered tilt over a lag of at most its correlation time;
    the components count as `PRIOR_INCREMENTS` of them. A scan on a windy day thus has the σ of its own drift.
    """
    tilt = tilt_record.tilt
    step_s = float(tilt.time_s[1] - tilt.time_s[0])
    lag = max(1, round(min(TILT_DRIFT_S, np.ptp(tilt.time_s) / 2) / step_s))
    axes = np.stack([tilt.roll_rad, tilt.pitch_rad])
    increment_rad2 = float(np.mean((axes[:, lag:] - axes[:, :-lag]) ** 2))
    increment_rad2 = max(increment_rad2 - 2 * tilt_record.filtered_noise_rad**2, 0.0)
    observed_rad2 = increment_rad2 / (2 * (1 - math.exp(-lag * step_s / TILT_DRIFT_S)))
    count = float(axes.size / lag)
    prior_share = PRIOR_INCREMENTS / (PRIOR_INCREMENTS + count)
    return prior_share * components.tilt_drift_rad**2 + (1 - prior_share) * observed_rad2


def cyclic_error_modes(lines: LineTimes, tilt_offset: CyclicError, direction_rad: float = 0.0) -> Floats:
    """Return the effect (lines, 2) of 1 σ of change in the sensor's cyclic errors on the sight tilt [rad].

    Or on the tilt along a direction `direction_rad` counter-clockwise from the line of sight.
    Source: equations.md, 2.7.
    """
    cos, sin = np.cos(lines.azimuth_rad), np.sin(lines.azimuth_rad)
    toward_rad = lines.azimuth_rad + direction_rad
    waves = [
        (wave[1] * cos + wave[2] * sin)
        * lever
        * min(1.0, MAX_CYCLIC_ERROR_RAD / max(math.hypot(*wave[1:]), 1e-12))
        for wave, lever in (
            (tilt_offset.roll_rad, np.sin(toward_rad)),
            (tilt_offset.pitch_rad, -np.cos(toward_rad)),
        )
    ]
    return CYCLIC_CHANGE_SHARE * np.stack(waves, axis=-1)
