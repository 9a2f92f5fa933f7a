"""How precisely a scanner measures ranges and angles, from its own scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import optimize, special

from station.quantities import Bools, Floats, Ints
from station.science.beam import polar

CC_RAD = math.pi / 2e6  # a centesimal second: 1e-4 gon
FEWEST_SHOTS = 12  # of a plane
WANTED_SHOTS = 30
WIDE_RAD = math.radians(0.5)  # of windows that are filled or not
FLAT = 0.2  # largest spread across a plane against the smaller one along it
STEEPEST_COS = math.cos(math.radians(80.0))
FEWEST_LINE = 10  # shots that two scans have in common on a line
FEWEST_PLANES = 30
ROUGHER = 1.2
FAINTEST = 1e-3  # intensity
VARIES = 1.5  # brightest to faintest tenth, below which nothing is learned of intensity


@dataclass(frozen=True)
class Planes:
    """Small planes (m,) that a scan has found: how they were seen and how far its shots lie off them."""

    range_m: Floats
    cos_incidence: Floats
    intensity: Floats  # 0-1
    residual_m: Floats  # standard deviation across the plane
    shots: Ints

    def some(self, chosen: Bools) -> Planes:
        """Return the chosen (m,)."""
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

    A range error moves a shot along the beam, of which the plane's normal sees cos α: at 30° that is 15 % and
    at 45° 41 % more than the residual. Source: Ozendi et al. (2016), section 4, who do not divide.
    """
    return residual_m / cos_incidence


def window_for(xyz_m: Floats) -> float:
    """Width of a window of azimuth and elevation that holds about thirty of the shots (n, 3) [rad]."""
    _, elevation_rad, azimuth_rad = polar(xyz_m)
    filled = int(_windows(elevation_rad, azimuth_rad, WIDE_RAD).max()) + 1
    return WIDE_RAD * math.sqrt(WANTED_SHOTS * filled / len(xyz_m))


def _windows(elevation_rad: Floats, azimuth_rad: Floats, width_rad: float) -> Ints:
    """Number of the window (n,) that each shot lies in."""
    across = np.floor(azimuth_rad * np.cos(elevation_rad) / width_rad).astype(np.int64)
    upward = np.floor(elevation_rad / width_rad).astype(np.int64)
    _, of = np.unique(across * (4 * np.ptp(upward) + 4) + upward, return_inverse=True)
    return np.ravel(of)


def find_planes(xyz_m: Floats, intensity: Floats, window_rad: float) -> Planes:
    """Fit a plane to the shots (n, 3) in each window of azimuth and elevation, and keep those that are one.

    Orthogonal least squares; left out are windows of fewer than twelve shots, or rough, or seen at over 80°.
    """
    range_m, elevation_rad, azimuth_rad = polar(xyz_m)
    of = _windows(elevation_rad, azimuth_rad, window_rad)
    shots = np.bincount(of)
    mean = _mean(of, shots, xyz_m)
    apart_m = xyz_m - mean[of]
    moments = _mean(of, shots, (apart_m[:, :, None] * apart_m[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(moments)
    away_m = np.linalg.norm(mean, axis=1)
    cos_incidence = np.abs(np.sum(mean * vectors[:, :, 0], axis=1)) / np.maximum(away_m, 1e-9)
    with np.errstate(invalid="ignore", divide="ignore"):
        across_m2 = np.maximum(values[:, 0], 0.0) * shots / (shots - 3.0)
    planes = Planes(
        np.bincount(of, range_m) / shots,
        cos_incidence,
        np.bincount(of, intensity) / shots,
        np.sqrt(np.maximum(across_m2, 0.0)),
        shots,
    )
    flat = values[:, 0] < FLAT**2 * values[:, 1]
    return planes.some((shots >= FEWEST_SHOTS) & flat & (cos_incidence > STEEPEST_COS) & (across_m2 > 0))


def _mean(of: Ints, count: Ints, columns: Floats) -> Floats:
    return np.stack([np.bincount(of, column) / count for column in columns.T], axis=1)


@dataclass(frozen=True)
class RangeModel:
    """Standard deviation of a range by the brightness of its echo: a I^b + c; a is nought where I is all one.

    `typical_m` is that at the median brightness, `typical_error` its own relative error: beyond a third, the
    planes do not tell it from the noise of the angles.
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

        Source: EQUATIONS 3.7 (after Wujanz et al. 2017); Ozendi et al. publish no formula.
        """
        return _sigma(intensity, self.a_m, self.b, self.c_m)


def _sigma(intensity: Floats | float, a_m: float, b: float, c_m: float) -> Floats:
    return np.asarray(a_m * np.maximum(intensity, FAINTEST) ** b + c_m)


def by_class(planes: Planes) -> list[dict[str, float | str]]:
    """Return the median σ of ranges by range, by incidence, by intensity, in quarters of the planes each."""
    told: list[dict[str, float | str]] = []
    for name, values in (
        ("range_m", planes.range_m),
        ("incidence_deg", np.degrees(np.arccos(np.minimum(planes.cos_incidence, 1.0)))),
        ("intensity", planes.intensity),
    ):
        edges = np.unique(np.quantile(values, (0.0, 0.25, 0.5, 0.75, 1.0)))
        for low, high in pairwise(edges.tolist()):
            inside = (values >= low) & ((values < high) | (high == edges[-1]))
            told.append(
                {
                    "by": name, "from": low, "to": high, "planes": float(np.count_nonzero(inside)),
                    "sigma_range_m": float(np.median(planes.sigma_range_m[inside])),
                }
            )  # fmt: skip
    return told


def is_rough(model: RangeModel, wider: RangeModel) -> bool:
    """Tell whether planes fitted in wider windows are noisier: then it is the ground, and not the scanner."""
    return wider.typical_m > ROUGHER * model.typical_m


def fit_range_model(planes: Planes) -> RangeModel | None:
    """Fit σ_R = a I^b + c, and the angle noise, to planes; None where there are too few.

    What lies across a plane is (σ_R cos α)² + (R σ_a sin α)²: without its second part the beam's width would
    be taken for range noise wherever a surface is seen aslant. Variances are compared by their logarithms,
    and planes that are rougher than others of their kind count little.
    """
    if len(planes.shots) < FEWEST_PLANES:
        return None
    intensity = planes.intensity
    sine_m = planes.range_m * np.sqrt(1 - planes.cos_incidence**2)
    half = (planes.shots - 3) / 2  # of the degrees of freedom; the logarithm of a variance from so many shots
    log_scatter = np.sqrt(special.polygamma(1, half))
    observed = 2 * np.log(planes.residual_m) + np.log(half) - special.digamma(half)
    middle = float(np.median(intensity))
    varies = np.percentile(intensity, 90) > VARIES * max(float(np.percentile(intensity, 10)), FAINTEST)

    def of(at: Floats) -> tuple[float, float, float]:
        c_m = float(np.exp(at[0]))
        return (float(np.exp(at[2])), float(at[3]), c_m) if varies else (0.0, 0.0, c_m)

    def off(at: Floats) -> Floats:
        across_m2 = (_sigma(intensity, *of(at)) * planes.cos_incidence) ** 2 + (sine_m * np.exp(at[1])) ** 2
        return np.asarray((observed - np.log(across_m2)) / log_scatter)

    guess = np.log(float(np.median(planes.sigma_range_m)) / 2)
    many = 4 if varies else 2
    start = np.array([guess, np.log(2e-5), guess - 1, -0.5])[:many]
    bounds = ([-16.0, -16.0, -25.0, -3.0][:many], [0.0, -2.0, 0.0, -0.05][:many])
    found = optimize.least_squares(off, start, loss="soft_l1", bounds=bounds)
    scatter = max(2 * found.cost / len(observed), 1.0)
    jacobian = np.asarray(found.jac, dtype=np.float64)
    covariance = scatter * np.linalg.inv(jacobian.T @ jacobian + 1e-9 * np.eye(many))

    def log_typical(at: Floats) -> float:
        return float(np.log(_sigma(middle, *of(at))))

    by = optimize.approx_fprime(found.x, log_typical, 1e-6)
    typical_m = float(_sigma(middle, *of(found.x)))
    error = float(np.sqrt(by @ covariance @ by))
    return RangeModel(*of(found.x), typical_m, error, float(np.exp(found.x[1])), len(observed))


@dataclass(frozen=True)
class AnglePrecision:
    """How well two scans of one scene repeat an angle, as a standard deviation of one scan [rad].

    `sampling_rad` comes from each line having begun elsewhere, so that other spots were hit: it is no error
    of the angles. `precision_rad` is what is left.
    """

    observed_rad: float
    sampling_rad: float
    precision_rad: float
    step_rad: float  # between the shots of a line
    shots: int


@dataclass(frozen=True)
class _Raster:
    """The shots (n,) of a scan by line and number on it, as they follow one another."""

    line: Ints
    number: Ints  # missing echoes are counted
    elevation_rad: Floats
    azimuth_rad: Floats
    step_rad: float  # signed
    start_rad: Floats  # elevation at number nought of each line
    line_azimuth_rad: Floats

    @classmethod
    def of(cls, xyz_m: Floats) -> _Raster:
        _, elevation_rad, azimuth_rad = polar(xyz_m)
        azimuth_rad = np.unwrap(azimuth_rad)
        steps = np.diff(elevation_rad)
        step_rad = float(np.median(steps))
        back = steps * np.sign(step_rad) < -3 * abs(step_rad)
        line = np.concatenate([[0], np.cumsum(back.astype(np.int64))])
        passed = np.concatenate([[0], np.cumsum(np.where(back, 0, np.rint(steps / step_rad)))]).astype(
            np.int64
        )
        first = np.flatnonzero(np.concatenate([[True], back]))
        number = passed - passed[first][line]
        count = np.bincount(line)
        off = number - (np.bincount(line, number) / count)[line]
        spread = np.bincount(line, off**2)
        slope = np.bincount(line, off * elevation_rad)[spread > 0] / spread[spread > 0]
        if len(slope):
            step_rad = float(np.median(slope))
        # With the step known, a number no longer carries the errors of all before it.
        number = np.rint((elevation_rad - elevation_rad[first][line]) / step_rad).astype(np.int64)
        start_rad = np.bincount(line, elevation_rad - step_rad * number) / count
        return cls(
            line,
            number,
            elevation_rad,
            azimuth_rad,
            step_rad,
            start_rad,
            np.bincount(line, azimuth_rad) / count,
        )


def angle_precision(scan_m: Floats, again_m: Floats) -> tuple[AnglePrecision, AnglePrecision] | None:
    """Compare elevations and azimuths of two scans (n, 3) of one scene, in the order of shooting.

    Lines are set against the nearest of the other scan, and on them shots; None where too few match. The mean
    difference of a line, and what grows along it, is the sampling.
    Source: Ozendi et al. (2016), section 4, who take the sum of both for the precision (EQUATIONS 3.8).
    """
    if min(len(scan_m), len(again_m)) < FEWEST_SHOTS:
        return None
    one, other = _Raster.of(scan_m), _Raster.of(again_m)
    order = np.argsort(other.line_azimuth_rad)
    nearest = order[_nearest(other.line_azimuth_rad[order], one.line_azimuth_rad)]
    shift = np.rint((one.start_rad - other.start_rad[nearest]) / one.step_rad).astype(np.int64)
    wide = int(max(np.ptp(one.number), np.ptp(other.number)) * 2 + np.abs(shift).max() + 1)
    here = nearest[one.line] * wide + one.number + shift[one.line]
    there = other.line * wide + other.number
    _, at, at_other = np.intersect1d(here, there, return_indices=True)
    many = np.bincount(one.line[at], minlength=len(shift)) >= FEWEST_LINE
    kept = many[one.line[at]]
    at, at_other = at[kept], at_other[kept]
    if len(at) < FEWEST_SHOTS * FEWEST_LINE:
        return None
    of, place = np.unique(one.line[at], return_inverse=True)[1], one.number[at]
    elevation, azimuth = (
        _precision(of, place, after[at] - before[at_other], abs(one.step_rad))
        for after, before in (
            (one.elevation_rad, other.elevation_rad),
            (one.azimuth_rad, other.azimuth_rad),
        )
    )
    return elevation, azimuth


def _nearest(sorted_: Floats, wanted: Floats) -> Ints:
    after = np.clip(np.searchsorted(sorted_, wanted), 1, max(len(sorted_) - 1, 1))
    after = np.minimum(after, len(sorted_) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted - sorted_[before] < sorted_[after] - wanted, before, after)


def _precision(of: Ints, place: Ints, apart_rad: Floats, step_rad: float) -> AnglePrecision:
    """Split differences of two scans, by line, into what a whole line has in common and the rest."""
    count = np.bincount(of)
    off = place - (np.bincount(of, place) / count)[of]
    mean = np.bincount(of, apart_rad) / count
    slope = np.bincount(of, off * apart_rad) / np.bincount(of, off**2)
    left = apart_rad - mean[of] - slope[of] * off
    observed2 = float(np.mean(apart_rad**2) / 2)
    precision2 = float(np.sum(left**2) / (2 * np.sum(count - 2)))
    sampling_rad = math.sqrt(max(observed2 - precision2, 0.0))
    return AnglePrecision(math.sqrt(observed2), sampling_rad, math.sqrt(precision2), step_rad, len(of))
