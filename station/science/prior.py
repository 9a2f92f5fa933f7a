"""What is known of a scan before its points are looked at: how far its scanner, log and air may be off."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from station.quantities import Floats, Habits, HeadTrack, Shared, Tilt
from station.science.inclination import SENSOR_STEP_RAD, Cycle, Lean
from station.science.leans import OwnLeans
from station.science.normals import Beforehand, LineLog
from station.science.shared import GLOBAL, LEAN_PER_REFRACTION, LINES_A_KNOT, Basis, by_knots, tilt_along

REFRACTION_MEMORY_RAD = math.radians(15.0)
RANGE_SCALE_UNKNOWN_PPM = 4.0  # no weather: 5 K and 5 hPa off, 0.737 ppm/K, 0.290 ppm/hPa, EQUATIONS 5.8
CYCLE_CHANGE_RAD = math.radians(0.002)
CYCLE_CHANGE_SHARE = 0.2  # of its amplitude, between scans: EQUATIONS 2.7
CYCLE_LARGEST_RAD = math.radians(0.05)  # a larger wave is the mount's lean, which does not change
SLOW_MOTION_S = 300.0
FAST_MOTION_S = 3.0
SENSOR_BIAS_RAD = math.radians(0.0015)
BIASES = 2  # of the faults of a `LineLog`, which come first: in roll and pitch
SCANS_WORTH = 8  # what start values weigh against scans
MOTION_STEPS = 10
MOTIONS = ("slow_motion_rad", "fast_motion_rad", "line_motion_rad")
SHOWN = {  # habits by the global parameters that show them
    "tilt_rad": slice(2),
    "heading_rad": slice(2, 3),
    "translation_m": slice(3, 6),
    "range_bias_m": slice(6, 7),
    "range_scale_ppm": slice(7, 8),
    "refraction": slice(8, 9),
}
HEAD_SPEED_RAD_S = math.radians(0.13)  # where the scan does not tell; EQUATIONS 2.10


def globals_sigma(habits: Habits, *, weather_known: bool) -> Floats:
    """One sigma of each global parameter (9,)."""
    scale_ppm = habits.range_scale_ppm if weather_known else RANGE_SCALE_UNKNOWN_PPM
    turns, shifts = (habits.tilt_rad, habits.tilt_rad, habits.heading_rad), (habits.translation_m,) * 3
    return np.array([*turns, *shifts, habits.range_bias_m, scale_ppm, habits.refraction])


@dataclass(frozen=True)
class Lines:
    """How the head passed the groups of lines: azimuth in the scanner's own frame, and when.

    Azimuth about the scanner's z axis, counter-clockwise from x; `time_s` in the scan's time base.
    """

    azimuth_rad: Floats  # (lines,)
    time_s: Floats  # (lines,)


def lines_of(of: Basis, to_local: Floats, track: HeadTrack | None) -> Lines:
    """Return when the head passed each group of lines, from its track; without one, at a usual speed.

    `to_local` (3, 3) turns the scanner's frame into the map's. Beyond the scan the head is taken to go on.
    """
    x, y, _ = to_local.T @ of.outward
    azimuth_rad = np.unwrap(np.arctan2(y, x))
    if track is None:
        return Lines(azimuth_rad, np.abs(azimuth_rad - azimuth_rad[0]) / HEAD_SPEED_RAD_S)
    middle = (track.azimuth_rad.min() + track.azimuth_rad.max()) / 2
    azimuth_rad = middle + (azimuth_rad - middle + math.pi) % (2 * math.pi) - math.pi
    onwards = np.argsort(track.azimuth_rad)
    passed_rad, passed_s = track.azimuth_rad[onwards], track.time_s[onwards]
    speed_s = float(np.ptp(passed_s) / np.ptp(passed_rad)) * (1 if passed_s[-1] > passed_s[0] else -1)
    time_s = np.interp(azimuth_rad, passed_rad, passed_s)
    beyond_rad = azimuth_rad - np.clip(azimuth_rad, passed_rad[0], passed_rad[-1])
    return Lines(azimuth_rad, time_s + beyond_rad * speed_s)


def turn_of(tilt: Tilt, to_local: Floats, time_s: Floats) -> Floats:
    """Rotation about east, north and up (3, n) [rad] that a lean of the scanner is at some times (n,)."""
    roll_rad, pitch_rad = (np.interp(time_s, tilt.time_s, v) for v in (tilt.roll_rad, tilt.pitch_rad))
    return np.asarray(to_local @ np.stack([roll_rad, pitch_rad, np.zeros_like(roll_rad)]))


def line_log(of: Basis, lines: Lines, lean: Lean, zero: Cycle, to_local: Floats) -> LineLog:
    """Return what the log says of each group of lines, projected on the line of sight, and its faults.

    Source: ADJUSTMENT, observation 2; EQUATIONS 6.3.
    """
    onwards = np.argsort(lines.time_s)
    times_s = lines.time_s[onwards]
    edges_s = (times_s[1:] + times_s[:-1]) / 2
    time_s = lean.raw.time_s
    inside = (time_s >= 2 * times_s[0] - edges_s[0]) & (time_s <= 2 * times_s[-1] - edges_s[-1])
    line = onwards[np.searchsorted(edges_s, time_s[inside])]
    east, north, _ = turn_of(lean.raw, to_local, time_s[inside])
    azimuth_rad = of.line_azimuth_rad
    sight_rad = np.cos(azimuth_rad[line]) * east - np.sin(azimuth_rad[line]) * north
    count = np.bincount(line, minlength=of.line_count)
    one = np.ones_like(azimuth_rad)
    faults = np.concatenate(
        [
            tilt_along(azimuth_rad) * SENSOR_BIAS_RAD,
            np.stack([one, np.cos(2 * azimuth_rad), np.sin(2 * azimuth_rad)], axis=-1) * CYCLE_CHANGE_RAD,
            cycle_changes(lines, zero),
        ],
        axis=1,
    )
    noise_rad = max(lean.noise_rad, SENSOR_STEP_RAD)
    mean_rad = np.bincount(line, sight_rad, of.line_count) / np.maximum(count, 1)
    return LineLog(mean_rad, count / noise_rad**2, faults)


def motions(lines: Lines) -> tuple[Floats, Floats, Floats]:
    """Correlations (lines, lines) of slow, fast and line motion.

    Source: EQUATIONS 6.3.
    """
    slow, fast = (_faded(lines.time_s, memory_s) for memory_s in (SLOW_MOTION_S, FAST_MOTION_S))
    return slow, fast, np.eye(len(slow))


def _faded(time_s: Floats, memory_s: float) -> Floats:
    """Correlation (n, n) of what fades by so much a time, between some times (n,)."""
    return np.asarray(np.exp(-np.abs(np.subtract.outer(time_s, time_s)) / memory_s))


def motion(habits: Habits, lines: Lines) -> Floats:
    """Covariance of the lean along the line of sight (lines, lines) [rad²]."""
    slow, fast, white = motions(lines)
    return np.asarray(
        habits.slow_motion_rad**2 * slow
        + habits.fast_motion_rad**2 * fast
        + habits.line_motion_rad**2 * white
    )


def bending(habits: Habits, of: Basis) -> Floats:
    """Covariance of the refraction that varies with azimuth (knots, knots)."""
    apart_rad = np.abs(np.subtract.outer(of.refraction_azimuth_rad, of.refraction_azimuth_rad))
    apart_rad = np.minimum(apart_rad, 2 * math.pi - apart_rad)
    return np.asarray(habits.refraction_by_azimuth**2 * np.exp(-apart_rad / REFRACTION_MEMORY_RAD))


def across(habits: Habits, of: Basis, lines: Lines) -> Floats:
    """Covariance (knots, knots) of the lean across the line of sight [rad²]: that of the slow motion.

    Of the fast one, knots a half minute apart hold nothing; the jitter of the mirror lifts lines, no more.
    """
    slow, _, _ = motions(_knots(of, lines))
    return np.asarray(habits.slow_motion_rad**2 * slow)


def _knots(of: Basis, lines: Lines) -> Lines:
    """How the head passed the knots of the refraction and of the lean across."""
    place = LINES_A_KNOT * LEAN_PER_REFRACTION * np.arange(of.refraction_count) - 0.5
    azimuth_rad, time_s = (
        np.interp(place, np.arange(of.line_count), values) for values in (lines.azimuth_rad, lines.time_s)
    )
    return Lines(azimuth_rad, time_s)


def by_line(of: Basis, globals_sigma: Floats, lean: Floats, bend: Floats, across_rad2: Floats) -> Floats:
    """Covariance of globals, leans of lines, refraction and lean across, independent of each other."""
    first, last = len(GLOBAL), len(GLOBAL) + of.line_count
    beyond = last + of.refraction_count
    covariance = np.zeros((beyond + of.refraction_count,) * 2)
    covariance[:first, :first] = np.diag(np.square(globals_sigma))
    covariance[first:last, first:last] = lean
    covariance[last:beyond, last:beyond] = bend
    covariance[beyond:, beyond:] = across_rad2
    return covariance


def beforehand(of: Basis, lines: Lines, habits: Habits, *, weather_known: bool) -> Beforehand:
    """Return what is known of a scan's state: the slow motion at knots, what is faster line by line.

    Where the slow motion is not straight between knots, also at the seam of a scan all round, each line has
    what is missing for its own, so that its variance is right; the rest of its correlation is left out.
    """
    before_s, after_s = lines.time_s[::LINES_A_KNOT], lines.time_s[1::LINES_A_KNOT]
    knot_s = before_s - (after_s - before_s) / 2
    if not of.closed:
        knot_s = np.append(knot_s, lines.time_s[-1] + (lines.time_s[-1] - lines.time_s[-2]) / 2)
    slow = _faded(knot_s, SLOW_MOTION_S)
    first, last = len(GLOBAL), len(GLOBAL) + of.lean_count
    knots = np.zeros((len(of.names),) * 2)
    knots[:first, :first] = np.diag(np.square(globals_sigma(habits, weather_known=weather_known)))
    knots[first:last, first:last] = habits.slow_motion_rad**2 * slow
    beyond = last + of.refraction_count
    knots[last:beyond, last:beyond] = bending(habits, of)
    knots[beyond:, beyond:] = across(habits, of, lines)
    apart = 1 - slow[np.arange(of.intervals), (np.arange(of.intervals) + 1) % of.lean_count]
    share = (np.arange(LINES_A_KNOT) + 0.5) / LINES_A_KNOT
    bent = 2 * np.outer(apart, share * (1 - share)).ravel()
    order = np.argsort(lines.time_s)
    return Beforehand(
        of,
        knots,
        OwnLeans(
            order=order,
            likeness=np.exp(-np.diff(lines.time_s[order]) / FAST_MOTION_S),
            alike_rad2=habits.fast_motion_rad**2,
            alone_rad2=habits.line_motion_rad**2 + habits.slow_motion_rad**2 * bent,
        ),
    )


def covariance_without_adjustment(
    of: Basis, lines: Lines, lean: Lean | None, zero: Cycle, habits: Habits, *, weather_known: bool
) -> Shared:
    """Return what is unknown of a scan corrected by its log and the weather alone, all estimates nought.

    What the log cannot know is here: its bias, the change of its cyclic error, the noise the filter leaves,
    the motion it takes away; without a log, all motion.
    """
    told = replace(habits, tilt_rad=SENSOR_BIAS_RAD) if lean else habits
    slow = replace(habits, fast_motion_rad=0.0, line_motion_rad=0.0)
    covariance = by_line(
        of,
        globals_sigma(told, weather_known=weather_known),
        _missed_by_log(lines, lean, zero, habits) if lean else motion(habits, lines),
        bending(habits, of),
        _missed_by_log(_knots(of, lines), lean, zero, slow, math.pi / 2)
        if lean
        else across(habits, of, lines),
    )
    return by_knots(of, np.zeros(len(covariance)), covariance)


def _missed_by_log(lines: Lines, lean: Lean, zero: Cycle, habits: Habits, beside_rad: float = 0.0) -> Floats:
    """Covariance (lines, lines) of the lean that the filtered log leaves [rad²].

    Along the line of sight, or along a direction so far counter-clockwise beside it.
    """
    time_s, along = lines.time_s, tilt_along(lines.azimuth_rad)
    alike = along @ along.T  # the cosine of the angle between lines
    # The share of the slow motion's spectrum (a Lorentzian) that lies above the cut-off.
    share = 1 - 2 / math.pi * math.atan(2 * math.pi * lean.cutoff_hz * SLOW_MOTION_S)
    width_s = lean.memory_s / (2 * math.sqrt(math.pi))  # of the Gaussian window with the same memory
    filtered = np.exp(-((np.subtract.outer(time_s, time_s) / width_s) ** 2) / 4)
    changes = cycle_changes(lines, zero, beside_rad)
    missed_rad2 = changes @ changes.T + CYCLE_CHANGE_RAD**2 * alike**2
    missed_rad2 += lean.filtered_noise_rad**2 * filtered * alike
    missed_rad2 += habits.fast_motion_rad**2 * _faded(time_s, FAST_MOTION_S)
    missed_rad2 += habits.slow_motion_rad**2 * share * _faded(time_s, max(lean.memory_s, 1.0))
    missed_rad2[np.diag_indices_from(missed_rad2)] += habits.line_motion_rad**2
    return np.asarray(missed_rad2)


def cycle_changes(lines: Lines, zero: Cycle, beside_rad: float = 0.0) -> Floats:
    """Effect on the line of sight (lines, 2) of one sigma of change in the sensor's waves [rad].

    Or on a direction so far counter-clockwise beside it. Source: EQUATIONS 2.7.
    """
    cos, sin = np.cos(lines.azimuth_rad), np.sin(lines.azimuth_rad)
    toward_rad = lines.azimuth_rad + beside_rad
    waves = [
        (wave[1] * cos + wave[2] * sin)
        * arm
        * min(1.0, CYCLE_LARGEST_RAD / max(math.hypot(*wave[1:]), 1e-12))
        for wave, arm in ((zero.roll_rad, np.sin(toward_rad)), (zero.pitch_rad, -np.cos(toward_rad)))
    ]
    return CYCLE_CHANGE_SHARE * np.stack(waves, axis=-1)


def learned(start: Habits, of: Basis, scans: Iterable[tuple[Lines, Floats, Floats]]) -> Habits:
    """Return the habits that estimates (u,) and covariances (u, u) of several scans speak for.

    Each variance is what the scans show (estimate squared plus what is unknown of it), drawn to its start
    value as if that came from `SCANS_WORTH` scans. Motions are told apart by their correlation in time, by
    steps of the expectation-maximisation of variance components.
    """
    first, last = len(GLOBAL), len(GLOBAL) + of.line_count
    lean = slice(first, last)
    shown, moved = np.zeros(last + 2 * of.refraction_count), np.zeros((of.line_count,) * 2)
    passed: list[Lines] = []
    for lines, estimate, covariance in scans:  # one after the other: covariances are large
        passed.append(lines)
        shown += estimate**2 + np.diag(covariance)
        moved += np.outer(estimate[lean], estimate[lean]) + covariance[lean, lean]
    count = len(passed)
    if count < 2:
        return start
    shown, moved = shown / (count - 1), moved / count

    def drawn(name: str, variance: float) -> float:
        mass = count + SCANS_WORTH
        return math.sqrt((variance * count + getattr(start, name) ** 2 * SCANS_WORTH) / mass)

    seen = {name: float(shown[place].mean()) for name, place in SHOWN.items()}
    seen["refraction_by_azimuth"] = float(shown[last : last + of.refraction_count].mean())
    kernels = motions(passed[0])
    now = start
    for _ in range(MOTION_STEPS):
        weight = np.linalg.inv(motion(now, passed[0]))
        shown_by = weight @ moved @ weight
        for name, kernel in zip(MOTIONS, kernels, strict=True):
            seen[name] = getattr(now, name) ** 2 * float(np.sum(shown_by * kernel) / np.sum(weight * kernel))
        now = replace(now, **{name: math.sqrt(seen[name]) for name in MOTIONS})
    return replace(start, **{name: drawn(name, variance) for name, variance in seen.items()})
