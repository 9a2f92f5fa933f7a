"""What all points of a scan have in common: parameters, their effect on heights, their covariance.

Nine global parameters, and by azimuth (knots every 5°) the lean along the line of sight and the refraction
that they do not hold. The effect of each on a height is analytic in the place of the cell and the gradient
of the terrain, so that it is never stored: with these functions and the covariance in an epoch anyone gets
the uncertainty of a cell, a box, a volume, a difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Floats32, Grid, Ints, Shared
from station.science.air import EARTH_RADIUS_M
from station.science.inclination import Cycle, Lean

GLOBAL = (
    ("tilt_east", "rad"),
    ("tilt_north", "rad"),
    ("heading", "rad"),
    ("translation_east", "m"),
    ("translation_north", "m"),
    ("translation_up", "m"),
    ("range_bias", "m"),
    ("range_scale", "1e-6"),
    ("refraction", "1"),
)
KNOT_RAD = math.radians(5.0)

# Start values of what a scan does not share with the scan before, one sigma; EQUATIONS 6.4 unless said.
SENSOR_BIAS_RAD = math.radians(0.0015)
HEADING_RAD = math.radians(0.0015)
TRANSLATION_M = 0.003
RANGE_BIAS_M = 0.004
RANGE_SCALE_PPM = 0.8
RANGE_SCALE_UNKNOWN_PPM = 4.0  # 5 K and 5 hPa off: 0.737 ppm/K, 0.290 ppm/hPa, EQUATIONS 5.8
REFRACTION = 0.08
REFRACTION_BY_AZIMUTH = 0.02
REFRACTION_MEMORY_RAD = math.radians(15.0)
CYCLE_CHANGE_RAD = math.radians(0.002)
CYCLE_CHANGE_SHARE = 0.2  # of its amplitude, between scans: EQUATIONS 2.7
CYCLE_LARGEST_RAD = math.radians(0.05)  # a larger wave is the mount's lean, which does not change
SLOW_MOTION_RAD, SLOW_MOTION_S = math.radians(0.0018), 300.0
FAST_MOTION_RAD, FAST_MOTION_S = math.radians(0.0010), 3.0
LEAN_UNKNOWN_RAD = math.radians(0.008)  # no log: what a mount was seen to change by, ADJUSTMENT
HEAD_SPEED_RAD_S = math.radians(0.13)  # where the scan does not tell; EQUATIONS 2.10


@dataclass(frozen=True)
class Basis:
    """The parameters of a station: nine, then lean and refraction at `count` knots from `start_rad` on.

    Azimuths count clockwise from grid north. `closed`: the knots go all the way round.
    """

    start_rad: float
    count: int
    closed: bool

    @property
    def azimuth_rad(self) -> Floats:
        """Azimuth of each knot (count,)."""
        return np.asarray(self.start_rad + KNOT_RAD * np.arange(self.count), dtype=np.float64)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each parameter."""
        degrees = [f"{math.degrees(a) % 360:05.1f}" for a in self.azimuth_rad]
        return (
            *(name for name, _ in GLOBAL),
            *(f"lean_{d}" for d in degrees),
            *(f"refraction_{d}" for d in degrees),
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each parameter."""
        return (*(unit for _, unit in GLOBAL), *["rad"] * self.count, *["1"] * self.count)


def basis(grid: Grid, position_m: tuple[float, float, float]) -> Basis:
    """Return the parameters for a grid seen from a scanner: knots over the sector it fills."""
    east = np.array([grid.west_m, grid.west_m + grid.nx * grid.cell_m]) - position_m[0]
    north = np.array([grid.north_m - grid.ny * grid.cell_m, grid.north_m]) - position_m[1]
    full = round(2 * math.pi / KNOT_RAD)
    if east[0] <= 0 <= east[1] and north[0] <= 0 <= north[1]:
        return Basis(0.0, full, closed=True)
    corners = np.array([math.atan2(e, n) for e in east for n in north])
    middle = math.atan2(east.mean(), north.mean())
    beside = (corners - middle + math.pi) % (2 * math.pi) - math.pi
    first = math.floor((middle + beside.min()) / KNOT_RAD)
    last = math.ceil((middle + beside.max()) / KNOT_RAD)
    return Basis(first * KNOT_RAD, last - first + 1, closed=False)


@dataclass(frozen=True)
class Sensitivities:
    """Effect of a unit of each parameter on the heights of cells: the matrix J, without its zeros.

    A cell feels the nine globals and the two knots beside its azimuth.
    """

    of: Basis
    globals_: Floats  # (9, n)
    lean: Floats  # (n,) per rad
    refraction: Floats  # (n,) per unit of k
    knot: Ints  # (n,) the knot before the cell's azimuth
    share: Floats  # (n,) of the knot after it

    def total(self, weights: Floats) -> Floats:
        """Effect of each parameter (p,) on the weighted sum of heights: g = Jᵀ a.

        Source: EQUATIONS 6.2.
        """
        after = (self.knot + 1) % self.of.count
        knots = []
        for effect in (self.lean * weights, self.refraction * weights):
            early = np.bincount(self.knot, effect * (1 - self.share), self.of.count)
            knots.append(early + np.bincount(after, effect * self.share, self.of.count))
        return np.concatenate([self.globals_ @ weights, *knots])

    def variance(self, covariance: Floats) -> Floats:
        """Variance of each cell's height (n,) [m²]: the diagonal of J C Jᵀ."""
        variance_m2 = np.empty(len(self.knot))
        order = np.argsort(self.knot, kind="stable")
        bounds = np.searchsorted(self.knot[order], np.arange(self.of.count + 1))
        for knot in np.flatnonzero(np.diff(bounds)):
            cells = order[bounds[knot] : bounds[knot + 1]]
            after = (knot + 1) % self.of.count
            first = len(GLOBAL) + knot, len(GLOBAL) + after
            felt = [*range(len(GLOBAL)), *first, *(i + self.of.count for i in first)]
            share, lean, bend = self.share[cells], self.lean[cells], self.refraction[cells]
            columns = np.vstack(
                [self.globals_[:, cells], lean * (1 - share), lean * share, bend * (1 - share), bend * share]
            )
            variance_m2[cells] = np.sum(columns * (covariance[np.ix_(felt, felt)] @ columns), axis=0)
        return np.maximum(variance_m2, 0.0)


def sensitivities(
    of: Basis, offset_m: tuple[Floats, Floats, Floats], east_gradient: Floats, north_gradient: Floats
) -> Sensitivities:
    """Effect of unit errors on the heights of cells at `offset_m` (each (n,)) from the scanner.

    Signs: scanner's state less the assumed one. Source: EQUATIONS 6.1.
    """
    x_m, y_m, z_m = offset_m
    horizontal_m = np.maximum(np.hypot(x_m, y_m), 1e-6)
    along_m = z_m - east_gradient * x_m - north_gradient * y_m  # n_u · P
    range_m = np.hypot(horizontal_m, z_m)
    rise_m = horizontal_m + z_m * (east_gradient * x_m + north_gradient * y_m) / horizontal_m  # F
    one = np.ones_like(x_m)
    position = ((np.arctan2(x_m, y_m) - of.start_rad) % (2 * math.pi)) / KNOT_RAD
    knot = np.minimum(position.astype(np.int64), of.count - (1 if of.closed else 2))
    return Sensitivities(
        of=of,
        globals_=np.stack(
            [
                -(y_m + north_gradient * z_m),
                x_m + east_gradient * z_m,
                east_gradient * y_m - north_gradient * x_m,
                east_gradient,
                north_gradient,
                -one,
                along_m / range_m,
                along_m * 1e-6,
                horizontal_m * rise_m / (2 * EARTH_RADIUS_M),
            ]
        ),
        lean=-rise_m,
        refraction=horizontal_m * rise_m / (2 * EARTH_RADIUS_M),
        knot=knot,
        share=np.clip(position - knot, 0.0, 1.0),
    )


def cell_sensitivities(
    of: Basis,
    grid: Grid,
    position_m: tuple[float, float, float],
    elevation_m: Floats | Floats32,
    gradient: tuple[Floats32, Floats32],
    cells: Bools,
) -> Sensitivities:
    """Effect of unit errors on the heights of the chosen cells (ny, nx) of a surface."""
    row, column = np.nonzero(cells)
    east, north = (np.nan_to_num(g[row, column].astype(np.float64)) for g in gradient)
    offset_m = (
        grid.x_m[column] - position_m[0],
        grid.y_m[row] - position_m[1],
        elevation_m[row, column].astype(np.float64) - position_m[2],
    )
    return sensitivities(of, offset_m, east, north)


def aggregate_variance(
    weights: Floats, random_variance_m2: Floats, felt: Sensitivities, covariance: Floats
) -> float:
    """Variance of a weighted sum of cell heights: Σ a² σ_r² + gᵀ C g.

    For a difference of two epochs add both covariances; what a reference shares with both cancels.
    Source: EQUATIONS 6.2; Hartzell et al. (2015), Eq. 14 and 21, lack the second term.
    """
    g = felt.total(weights)
    return float(np.sum(weights**2 * random_variance_m2) + g @ covariance @ g)


def covariance_without_adjustment(
    of: Basis,
    lean: Lean | None,
    zero: Cycle,
    scanner_azimuth_rad: Floats,
    head_speed_rad_s: float,
    *,
    weather_known: bool,
) -> Shared:
    """Return what is unknown of a scan corrected by its log and the weather alone, all estimates nought.

    `scanner_azimuth_rad` (knots,) is the azimuth of the knots in the scanner's own frame. What the log
    cannot know is here: its bias, the change of its cyclic error, the noise the filter leaves, the motion it
    takes away; without a log, all motion.
    """
    scale_ppm = RANGE_SCALE_PPM if weather_known else RANGE_SCALE_UNKNOWN_PPM
    tilt_rad = SENSOR_BIAS_RAD if lean else LEAN_UNKNOWN_RAD
    sigma = [tilt_rad, tilt_rad, HEADING_RAD, *[TRANSLATION_M] * 3, RANGE_BIAS_M, scale_ppm, REFRACTION]
    count = of.count
    covariance = np.zeros((len(GLOBAL) + 2 * count,) * 2)
    covariance[: len(GLOBAL), : len(GLOBAL)] = np.diag(np.square(sigma))
    apart_rad = np.abs(np.subtract.outer(of.azimuth_rad, of.azimuth_rad))
    apart_rad = np.minimum(apart_rad, 2 * math.pi - apart_rad)
    lean_knots = slice(len(GLOBAL), len(GLOBAL) + count)
    covariance[lean_knots, lean_knots] = _lean_covariance(
        lean, zero, scanner_azimuth_rad, apart_rad, head_speed_rad_s
    )
    bend_knots = slice(len(GLOBAL) + count, None)
    covariance[bend_knots, bend_knots] = REFRACTION_BY_AZIMUTH**2 * np.exp(-apart_rad / REFRACTION_MEMORY_RAD)
    return Shared(of.names, of.units, np.zeros(len(covariance)), covariance)


def _lean_covariance(
    lean: Lean | None, zero: Cycle, azimuth_rad: Floats, apart_rad: Floats, speed_rad_s: float
) -> Floats:
    """Covariance (knots, knots) of the unknown lean along the line of sight [rad²]."""
    apart_s = apart_rad / speed_rad_s
    # Fast motion averages over the time the head takes for a knot; hats between independent knots hold two
    # thirds of their variance, so these get one and a half of it.
    knot_s = KNOT_RAD / speed_rad_s
    fast = 1.5 * FAST_MOTION_RAD**2 * min(1.0, 2 * FAST_MOTION_S / knot_s) * np.eye(len(apart_s))
    if lean is None:
        return np.asarray(fast + SLOW_MOTION_RAD**2 * np.exp(-apart_s / SLOW_MOTION_S))
    # The share of the slow motion's spectrum (a Lorentzian) that lies above the cut-off.
    missed = 1 - 2 / math.pi * math.atan(2 * math.pi * lean.cutoff_hz * SLOW_MOTION_S)
    width_s = lean.memory_s / (2 * math.sqrt(math.pi))  # of the Gaussian window with the same memory
    noise = np.exp(-((apart_s / width_s) ** 2) / 4) * np.cos(apart_rad)
    cos, sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
    waves = [
        (wave[1] * cos + wave[2] * sin)
        * arm
        * min(1.0, CYCLE_LARGEST_RAD / max(math.hypot(*wave[1:]), 1e-12))
        for wave, arm in ((zero.roll_rad, sin), (zero.pitch_rad, -cos))
    ]
    return np.asarray(
        fast
        + 1.5 * SLOW_MOTION_RAD**2 * missed * np.eye(len(apart_s))
        + lean.filtered_noise_rad**2 * noise
        + CYCLE_CHANGE_RAD**2 * np.cos(apart_rad) ** 2
        + CYCLE_CHANGE_SHARE**2 * sum(np.outer(w, w) for w in waves)
    )
