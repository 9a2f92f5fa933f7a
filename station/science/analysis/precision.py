"""Precision of a scanner's ranges and angles, estimated from its own scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import optimize, special

from station.quantities import Bools, Floats, Ints
from station.science.geometry.beam import polar

CC_RAD = math.pi / 2e6  # a centesimal second: 1e-4 gon
MIN_SHOTS = 12  # of a plane
TARGET_SHOTS = 30
COARSE_WINDOW_RAD = math.radians(0.5)  # of windows that are tested for shots
MAX_THICKNESS_RATIO = 0.2  # spread across a plane over the smaller one along it
MIN_COS_INCIDENCE = math.cos(math.radians(80.0))
MIN_LINE_SHOTS = 10  # matching shots of two scans on a line
MIN_PLANES = 30
ROUGH_RATIO = 1.2
MIN_INTENSITY = 1e-3  # intensity
MIN_INTENSITY_RATIO = 1.5  # 90th over 10th percentile; below, intensity is not fitted


@dataclass(frozen=True)
class Planes:
    """Small planes (m,) fitted to a scan: viewing geometry and residuals of the shots."""

    range_m: Floats
    cos_incidence: Floats
    intensity: Floats  # 0-1
    residual_m: Floats  # standard deviation across the plane
    shots: Ints

    def take(self, chosen: Bools) -> Planes:
        """Return the chosen planes (m,)."""
        return Planes(
            self.range_m[chosen], self.cos_incidence[chosen], self.intensity[chosen], self.residual_m[chosen],
            self.shots[chosen],
        )  # fmt: skip

    @property
    def sigma_range_m(self) -> Floats:
        """Standard deviation of the range on each plane (m,)."""
        return sigma_range(self.residual_m, self.cos_incidence)


def sigma_range(residual_m: Floats, cos_incidence: Floats) -> Floats:
    """Standard deviation of ranges from that of shots across a plane [m].

    A range error moves a shot along the beam, and cos α of it is across the plane: at 30° the range sigma is
    15 % and at 45° 41 % larger than the residual. Source: Ozendi et al. (2016), section 4, who do not divide.
    """
    return residual_m / cos_incidence


def window_width(xyz_m: Floats) -> float:
    """Width of a window of azimuth and elevation that holds about thirty of the shots (n, 3) [rad]."""
    _, elevation_rad, azimuth_rad = polar(xyz_m)
    filled = int(_window_index(elevation_rad, azimuth_rad, COARSE_WINDOW_RAD).max()) + 1
    return COARSE_WINDOW_RAD * math.sqrt(TARGET_SHOTS * filled / len(xyz_m))


def _window_index(elevation_rad: Floats, azimuth_rad: Floats, width_rad: float) -> Ints:
    """Index of the window that each shot lies in (n,)."""
    across = np.floor(azimuth_rad * np.cos(elevation_rad) / width_rad).astype(np.int64)
    upward = np.floor(elevation_rad / width_rad).astype(np.int64)
    _, window = np.unique(across * (4 * np.ptp(upward) + 4) + upward, return_inverse=True)
    return np.ravel(window)


def find_planes(xyz_m: Floats, intensity: Floats, window_rad: float) -> Planes:
    """Fit a plane to the shots (n, 3) in each window of azimuth and elevation; return the valid planes.

    Orthogonal least squares. Windows with fewer than twelve shots, rough surfaces, or incidence over 80° are
    dropped.
    """
    range_m, elevation_rad, azimuth_rad = polar(xyz_m)
    window = _window_index(elevation_rad, azimuth_rad, window_rad)
    shots = np.bincount(window)
    mean = _mean(window, shots, xyz_m)
    deviation_m = xyz_m - mean[window]
    moments = _mean(
        window, shots, (deviation_m[:, :, None] * deviation_m[:, None, :]).reshape(-1, 9)
    ).reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(moments)
    distance_m = np.linalg.norm(mean, axis=1)
    cos_incidence = np.abs(np.sum(mean * vectors[:, :, 0], axis=1)) / np.maximum(distance_m, 1e-9)
    with np.errstate(invalid="ignore", divide="ignore"):
        across_m2 = np.maximum(values[:, 0], 0.0) * shots / (shots - 3.0)
    planes = Planes(
        np.bincount(window, range_m) / shots,
        cos_incidence,
        np.bincount(window, intensity) / shots,
        np.sqrt(np.maximum(across_m2, 0.0)),
        shots,
    )
    flat = values[:, 0] < MAX_THICKNESS_RATIO**2 * values[:, 1]
    return planes.take((shots >= MIN_SHOTS) & flat & (cos_incidence > MIN_COS_INCIDENCE) & (across_m2 > 0))


def _mean(group: Ints, count: Ints, columns: Floats) -> Floats:
    return np.stack([np.bincount(group, column) / count for column in columns.T], axis=1)


@dataclass(frozen=True)
class RangeModel:
    """Standard deviation of a range by echo intensity, a I^b + c; a is zero if intensity hardly varies.

    `typical_m` is the value at the median intensity and `typical_error` its relative error: beyond a third,
    the planes cannot separate it from the noise of the angles.
    """

    a_m: float
    b: float
    c_m: float
    typical_m: float
    typical_error: float
    sigma_angle_rad: float  # of one angle, the beam's width included
    planes: int

    def sigma_m(self, intensity: Floats | float) -> Floats:
        """Standard deviation of a range at an intensity of 0-1 [m].

        Source: equations.md, 3.7 (after Wujanz et al. 2017); Ozendi et al. publish no formula.
        """
        return _range_sigma(intensity, self.a_m, self.b, self.c_m)


def _range_sigma(intensity: Floats | float, a_m: float, b: float, c_m: float) -> Floats:
    return np.asarray(a_m * np.maximum(intensity, MIN_INTENSITY) ** b + c_m)


def sigma_by_class(planes: Planes) -> list[dict[str, float | str]]:
    """Return the median σ of ranges by range, by incidence and by intensity, per quarter of the planes."""
    rows: list[dict[str, float | str]] = []
    for name, values in (
        ("range_m", planes.range_m),
        ("incidence_deg", np.degrees(np.arccos(np.minimum(planes.cos_incidence, 1.0)))),
        ("intensity", planes.intensity),
    ):
        edges = np.unique(np.quantile(values, (0.0, 0.25, 0.5, 0.75, 1.0)))
        for low, high in pairwise(edges.tolist()):
            inside = (values >= low) & ((values < high) | (high == edges[-1]))
            rows.append(
                {
                    "by": name, "from": low, "to": high, "planes": float(np.count_nonzero(inside)),
                    "sigma_range_m": float(np.median(planes.sigma_range_m[inside])),
                }
            )  # fmt: skip
    return rows


def is_surface_rough(model: RangeModel, wider: RangeModel) -> bool:
    """Return True if planes in wider windows are noisier: the ground is rough, not the scanner noisy."""
    return wider.typical_m > ROUGH_RATIO * model.typical_m


def fit_range_model(planes: Planes) -> RangeModel | None:
    """Fit σ_R = a I^b + c and the angle noise to planes; None if there are too few.

    The residual variance across a plane is (σ_R cos α)² + (R σ_a sin α)². Without the second term, the beam's
    width would count as range noise at oblique incidence. Logarithms of variances are fitted, robustly:
    planes rougher than similar ones are down-weighted.
    """
    if len(planes.shots) < MIN_PLANES:
        return None
    intensity = planes.intensity
    sine_m = planes.range_m * np.sqrt(1 - planes.cos_incidence**2)
    half = (planes.shots - 3) / 2  # half the degrees of freedom, for the logarithm of a sample variance
    log_scatter = np.sqrt(special.polygamma(1, half))
    observed = 2 * np.log(planes.residual_m) + np.log(half) - special.digamma(half)
    median_intensity = float(np.median(intensity))
    intensity_varies = np.percentile(intensity, 90) > MIN_INTENSITY_RATIO * max(
        float(np.percentile(intensity, 10)), MIN_INTENSITY
    )

    def unpack(x: Floats) -> tuple[float, float, float]:
        c_m = float(np.exp(x[0]))
        return (float(np.exp(x[2])), float(x[3]), c_m) if intensity_varies else (0.0, 0.0, c_m)

    def residuals(x: Floats) -> Floats:
        across_m2 = (_range_sigma(intensity, *unpack(x)) * planes.cos_incidence) ** 2 + (
            sine_m * np.exp(x[1])
        ) ** 2
        return np.asarray((observed - np.log(across_m2)) / log_scatter)

    guess = np.log(float(np.median(planes.sigma_range_m)) / 2)
    count = 4 if intensity_varies else 2
    start = np.array([guess, np.log(2e-5), guess - 1, -0.5])[:count]
    bounds = ([-16.0, -16.0, -25.0, -3.0][:count], [0.0, -2.0, 0.0, -0.05][:count])
    solution = optimize.least_squares(residuals, start, loss="soft_l1", bounds=bounds)
    scatter = max(2 * solution.cost / len(observed), 1.0)
    jacobian = np.asarray(solution.jac, dtype=np.float64)
    covariance = scatter * np.linalg.inv(jacobian.T @ jacobian + 1e-9 * np.eye(count))

    def log_typical(x: Floats) -> float:
        return float(np.log(_range_sigma(median_intensity, *unpack(x))))

    gradient = optimize.approx_fprime(solution.x, log_typical, 1e-6)
    typical_m = float(_range_sigma(median_intensity, *unpack(solution.x)))
    error = float(np.sqrt(gradient @ covariance @ gradient))
    return RangeModel(*unpack(solution.x), typical_m, error, float(np.exp(solution.x[1])), len(observed))


@dataclass(frozen=True)
class AnglePrecision:
    """Repeatability of an angle between two scans of one scene, as a standard deviation of one scan [rad].

    `sampling_rad` arises because each line starts at another angle, so other spots were hit: it is not an
    error of the angles. `precision_rad` is the rest.
    """

    observed_rad: float
    sampling_rad: float
    precision_rad: float
    step_rad: float  # between the shots of a line
    shots: int


@dataclass(frozen=True)
class _ScanRaster:
    """The shots (n,) of a scan by line and index on the line, in order of shooting."""

    line: Ints
    shot_index: Ints  # missing echoes are counted
    elevation_rad: Floats
    azimuth_rad: Floats
    step_rad: float  # signed
    start_rad: Floats  # elevation at shot index 0 of each line
    line_azimuth_rad: Floats

    @classmethod
    def from_points(cls, xyz_m: Floats) -> _ScanRaster:
        _, elevation_rad, azimuth_rad = polar(xyz_m)
        azimuth_rad = np.unwrap(azimuth_rad)
        steps = np.diff(elevation_rad)
        step_rad = float(np.median(steps))
        restarts = steps * np.sign(step_rad) < -3 * abs(step_rad)
        line = np.concatenate([[0], np.cumsum(restarts.astype(np.int64))])
        steps_passed = np.concatenate(
            [[0], np.cumsum(np.where(restarts, 0, np.rint(steps / step_rad)))]
        ).astype(np.int64)
        first = np.flatnonzero(np.concatenate([[True], restarts]))
        shot_index = steps_passed - steps_passed[first][line]
        count = np.bincount(line)
        deviation = shot_index - (np.bincount(line, shot_index) / count)[line]
        spread = np.bincount(line, deviation**2)
        slope = np.bincount(line, deviation * elevation_rad)[spread > 0] / spread[spread > 0]
        if len(slope):
            step_rad = float(np.median(slope))
        # With the step known, an index no longer accumulates the errors of those preceding it.
        shot_index = np.rint((elevation_rad - elevation_rad[first][line]) / step_rad).astype(np.int64)
        start_rad = np.bincount(line, elevation_rad - step_rad * shot_index) / count
        return cls(
            line,
            shot_index,
            elevation_rad,
            azimuth_rad,
            step_rad,
            start_rad,
            np.bincount(line, azimuth_rad) / count,
        )


def angle_precision(scan_m: Floats, repeat_m: Floats) -> tuple[AnglePrecision, AnglePrecision] | None:
    """Compare elevations and azimuths of two scans (n, 3) of one scene, in the order of shooting.

    Each line is matched with the nearest line of the other scan, and shots along it; None if too few match.
    The mean difference of a line and its trend along the line are the sampling.
    Source: Ozendi et al. (2016), section 4, who take the sum of both for the precision (equations.md, 3.8).
    """
    if min(len(scan_m), len(repeat_m)) < MIN_SHOTS:
        return None
    first, second = _ScanRaster.from_points(scan_m), _ScanRaster.from_points(repeat_m)
    order = np.argsort(second.line_azimuth_rad)
    nearest = order[_nearest(second.line_azimuth_rad[order], first.line_azimuth_rad)]
    shift = np.rint((first.start_rad - second.start_rad[nearest]) / first.step_rad).astype(np.int64)
    stride = int(max(np.ptp(first.shot_index), np.ptp(second.shot_index)) * 2 + np.abs(shift).max() + 1)
    first_key = nearest[first.line] * stride + first.shot_index + shift[first.line]
    second_key = second.line * stride + second.shot_index
    _, in_first, in_second = np.intersect1d(first_key, second_key, return_indices=True)
    enough = np.bincount(first.line[in_first], minlength=len(shift)) >= MIN_LINE_SHOTS
    kept = enough[first.line[in_first]]
    in_first, in_second = in_first[kept], in_second[kept]
    if len(in_first) < MIN_SHOTS * MIN_LINE_SHOTS:
        return None
    line, shot_index = np.unique(first.line[in_first], return_inverse=True)[1], first.shot_index[in_first]
    elevation, azimuth = (
        _split_differences(line, shot_index, first_rad[in_first] - second_rad[in_second], abs(first.step_rad))
        for first_rad, second_rad in (
            (first.elevation_rad, second.elevation_rad),
            (first.azimuth_rad, second.azimuth_rad),
        )
    )
    return elevation, azimuth


def _nearest(sorted_: Floats, targets: Floats) -> Ints:
    upper = np.clip(np.searchsorted(sorted_, targets), 1, max(len(sorted_) - 1, 1))
    upper = np.minimum(upper, len(sorted_) - 1)
    lower = np.maximum(upper - 1, 0)
    return np.where(targets - sorted_[lower] < sorted_[upper] - targets, lower, upper)


def _split_differences(
    line: Ints, shot_index: Ints, difference_rad: Floats, step_rad: float
) -> AnglePrecision:
    """Split differences of two scans into a part common to each line and a remainder."""
    count = np.bincount(line)
    deviation = shot_index - (np.bincount(line, shot_index) / count)[line]
    mean = np.bincount(line, difference_rad) / count
    slope = np.bincount(line, deviation * difference_rad) / np.bincount(line, deviation**2)
    residual_rad = difference_rad - mean[line] - slope[line] * deviation
    observed2 = float(np.mean(difference_rad**2) / 2)
    precision2 = float(np.sum(residual_rad**2) / (2 * np.sum(count - 2)))
    sampling_rad = math.sqrt(max(observed2 - precision2, 0.0))
    return AnglePrecision(math.sqrt(observed2), sampling_rad, math.sqrt(precision2), step_rad, len(line))
