"""Change of the ground since the reference, as unknowns of the adjustment.

Moving ground changes by trends over all of it (mean, east, north, distance, squared distance, height) and
smoothly between knots. Bare ground that is not known to be stable has trends and knots of its own: melt ends
at the edge of the ice, as the refraction of cold air does, and snow does not. Stable ground is not quite at
rest: it heaves, as a whole and by blocks, and after snowfall it may be under thin snow. The sizes of trends
and of the change between knots are not known. A model is one choice of them, of whether the mean is as large
as the trends or free, with slopes of its own or without, and of whether snow has fallen; an adjustment weighs
all models by their likelihood.
Source: equations.md, 6.3; adjustment.md, 5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from station.quantities import Bools, Floats, Ints, Reals
from station.science.adjustment.ground_classes import UNSEEN_SNOW_M, UNSEEN_SNOW_SHARE
from station.science.adjustment.normal_equations import ScaledCholesky, cholesky_inplace
from station.science.adjustment.patches import Patches
from station.science.geometry.air import LAPSE_K_PER_M
from station.science.uncertainty import common_mode
from station.science.uncertainty.parameters import GLOBAL, TILT_KNOT_RAD

CHANGE_AZIMUTH_KNOTS = 4  # sight-tilt knots between two knots of the change
CHANGE_RANGE_BINS = 3  # range bins between two knots of the change
CHANGE_STEPS_M = tuple(float(step) for step in np.geomspace(0.5 / 2**11, 0.5, 12))
TREND_SIZES_M = tuple(float(size) for size in np.geomspace(0.0003, 1.0, 8))
MEAN_RATIO = 1 / 0.6  # of the mean's size to that of a trend: melt from zero to twice the mean
FREE_MEAN_SIGMA_M = 0.5  # of a mean that may exceed the trends by far
FREE_SLOPE_SIGMA_M = 0.01  # of the slopes by distance and by height beside such a mean, at least
TRENDS = 6
SLOPES = [3, 5]  # the trends by distance and by height: ice that settles or melts
KINDS = 2  # of moving ground: ice and snow, bare ground
STABLE = KINDS  # kind of all other ground
KIND_SPACING = 10_000  # of the azimuth knots of two kinds, so that they are not correlated
MIN_SHARE = 1e-6  # of a kind of ground in a patch; less is rounding
# Sigma of the change that neighbouring knots share, in sigmas of one knot: no, some or strong correlation.
CORRELATED_CHANGE_RATIOS = (0.0, 3.0, 10.0)
# Log prior odds against each. Smooth errors of the air look like correlated change too, but raise its log
# likelihood by tens at most; a smooth snowfall raises it by hundreds.
CORRELATION_LOG_PRIORS = (0.0, 12.0, 24.0)
# For a mean that is as large as the trends, for one that may be any of half a metre (as likely as one of
# 25 mm), and for such a mean with slopes (as likely as one of 25 mm with slopes of 5 mm).
MEAN_LOG_PRIORS = (0.0, 3.0, 4.5)
# Against ice that rises while bare ground beside it does not, and both sinking: snow falls on both, and rock
# does not melt. Snow has fallen in one scan of twenty.
UNLIKELY_LOG_PRIOR = 12.0
SNOW_LOG_PRIORS = (0.0, 3.0, UNLIKELY_LOG_PRIOR)
SNOWFALL = 1  # index of the second
# By which snow is likelier: where brightness cannot tell, it has fallen in one scan of two. Where rock looks
# like it there is hardly a doubt; at odds of only e^3 a scanner that sank was likelier than 6 mm of snow.
SHOWN_SNOW_LOG_ODDS = {False: 0.0, None: 3.0, True: 9.0}
SMALL_TREND_LOG_PRIOR = 2.0  # against each factor e by which trends are smaller than the change between knots
CORRELATION_AZIMUTH_KNOTS, CORRELATION_RANGE_KNOTS = 4.0, 2.5  # correlation lengths, in knots
# Mean and sigma of thin snow over its largest depth: stable ground is bare as likely as under any depth that
# does not show.
THIN_SNOW_MEAN_SIGMA = np.array([1 / 4, math.sqrt(1 / 6 - 1 / 16)])
NO_CHANGE_M = 1e-6
# Of the air over thin snow. At most of the warmest places half of what falls at 2.4 °C is snow (Jennings et
# al., 2018), and a thermometer in the sun shows up to 5 K too much.
MAX_SNOW_C = 8.0
# Upper bounds (tan): all, most, some, little snow.
SNOW_SLOPES = tuple(np.tan(np.radians((40.0, 45.0, 50.0, 60.0))))
HEAVE_M = 0.002  # start value of sigma: frost and heat move rock by millimetres
HEAVE_BLOCK_M = 500.0
PRIOR_HEAVE_BLOCKS = 4.0  # weight of the start value, in blocks
MIN_HEAVE_M = 1e-5


class ChangeModel(NamedTuple):
    """Indices into `CORRELATED_CHANGE_RATIOS`, `CHANGE_STEPS_M` and `TREND_SIZES_M`.

    `snow` is 0 if bare ground does not change, 1 if snow has fallen: ice and bare ground rise, and stable
    ground may be under thin snow; 2 if ice and bare ground change otherwise, as when snow melts. `mean` is 0
    if the mean is as large as the trends, 1 if it is free, 2 if slopes are free as well.
    """

    ratio: int
    step: int
    trend: int
    snow: int = 0
    mean: int = 0

    @property
    def mean_sign(self) -> int:
        """Sign of the mean change: snow raises the surface, ice that changes alone melts; 0 if it is open."""
        return (-1, 1, 0)[self.snow]

    @property
    def step_m(self) -> float:
        """One sigma of the change between its knots [m]."""
        return CHANGE_STEPS_M[self.step] * math.hypot(1.0, CORRELATED_CHANGE_RATIOS[self.ratio])

    @property
    def size_m(self) -> float:
        """One sigma of the change of moving ground about its mean [m]."""
        return math.hypot(self.step_m, TREND_SIZES_M[self.trend])

    @property
    def log_prior(self) -> float:
        """Logarithm of the prior odds: correlation, small trends and snow need evidence."""
        below = max(math.log(self.step_m / TREND_SIZES_M[self.trend]), 0.0)
        evidence = CORRELATION_LOG_PRIORS[self.ratio] + SMALL_TREND_LOG_PRIOR * below
        return MEAN_LOG_PRIORS[self.mean] - SNOW_LOG_PRIORS[self.snow] - evidence

    def with_ratio(self, ratio: int) -> ChangeModel:
        """Return the model of another correlation with about the same change between knots."""
        steps_m = np.hypot(1.0, CORRELATED_CHANGE_RATIOS[ratio]) * np.array(CHANGE_STEPS_M)
        return self._replace(ratio=ratio, step=int(np.argmin(np.abs(np.log(steps_m / self.step_m)))))

    def neighbours(self, *, ratios: bool = False) -> list[ChangeModel]:
        """Return the models that differ by one index, in the ratio only with `ratios`."""
        sizes = {"step": len(CHANGE_STEPS_M), "trend": len(TREND_SIZES_M), "mean": len(MEAN_LOG_PRIORS)}
        if ratios:
            sizes["ratio"] = len(CORRELATED_CHANGE_RATIOS)
        return [
            self._replace(**{name: index})
            for name, size in sizes.items()
            for index in (getattr(self, name) - 1, getattr(self, name) + 1)
            if 0 <= index < size
        ] + [self._replace(snow=index) for index in range(len(SNOW_LOG_PRIORS)) if index != self.snow]


START_MODEL = ChangeModel(0, len(CHANGE_STEPS_M) // 2, len(TREND_SIZES_M) // 2)


class ThinSnow(NamedTuple):
    """Snow that stable ground may be under without showing it.

    `temperature_c` is that of the air at the scanner, None if it was not measured, `max_depth_m` the largest
    depth that the brightness of a cell does not show, or `max_share` of the mean depth on moving ground.
    `shows` is True if the brightness of many cells together tells of snow, None if it cannot tell.
    """

    temperature_c: float | None = None
    max_depth_m: float = UNSEEN_SNOW_M
    max_share: float = UNSEEN_SNOW_SHARE
    shows: bool | None = False

    def is_possible(self, patches: Patches) -> Bools:
        """Return True for patches (n,) where it is cold enough; everywhere if no temperature is known.

        It falls with the height. Below the scanner it is taken to do so too: cold air collects in hollows.
        """
        if self.temperature_c is None:
            return np.ones(len(patches), np.bool_)
        return np.asarray(self.temperature_c - LAPSE_K_PER_M * np.abs(patches.height_m) < MAX_SNOW_C)


THIN_SNOW = ThinSnow()


@dataclass(frozen=True)
class GroundChange:
    """Unknown change of patches (n,): trends, knots, depths of thin snow, heave, in this order.

    A patch of moving ground is of the kind that has most of it. `mean_change_m` is the mean change of moving
    ground that the last estimate showed.
    """

    design: sparse.csr_array  # (n, k)
    kind: Ints  # (n,) from 0, STABLE if not moving
    knot_precisions: list[Floats]  # (knots, knots) for a unit step, one per correlation
    knot_log_determinants: list[float]  # of their inverses
    trend_columns: int
    bare_columns: int  # the last of these, trends of bare ground beside ice and snow
    snow_columns: int
    heave_columns: int
    thin_snow: ThinSnow
    mean_change_m: float
    heave_m: float

    @property
    def moving(self) -> Bools:
        """Whether patches are moving ground (n,)."""
        return np.asarray(self.kind != STABLE)

    @property
    def knots(self) -> slice:
        """Columns of the change between knots."""
        last = self.design.shape[1] - self.snow_columns - self.heave_columns
        return slice(self.trend_columns, last)

    @property
    def independent(self) -> Ints:
        """Columns of the other unknowns, which are independent of each other."""
        return np.delete(np.arange(self.design.shape[1]), self.knots)

    def log_prior(self, model: ChangeModel) -> float:
        """Return the logarithm of the prior odds of a model, after what brightness tells of snow."""
        if model.snow != SNOWFALL:
            return model.log_prior
        return model.log_prior + SHOWN_SNOW_LOG_ODDS[self.thin_snow.shows]

    def prior_m(self, model: ChangeModel) -> tuple[Floats, Floats]:
        """Return mean and sigma of the independent unknowns of a model [m]: trends, depths of snow, heave."""
        trends_m = np.full(TRENDS, TREND_SIZES_M[model.trend])
        trends_m[0] *= MEAN_RATIO
        if model.snow == SNOWFALL and self.thin_snow.shows is not False:
            trends_m[0] = max(trends_m[0], self.thin_snow.max_depth_m)
        if model.mean:
            trends_m[0] = FREE_MEAN_SIGMA_M
        largest_m = max(self.thin_snow.max_depth_m, self.thin_snow.max_share * self.mean_change_m)
        depth_m = min(largest_m, math.hypot(model.step_m, trends_m[0]))
        if model.mean > 1:
            trends_m[SLOPES] = np.maximum(trends_m[SLOPES], FREE_SLOPE_SIGMA_M)
        first_bare, first_snow = self.trend_columns - self.bare_columns, self.trend_columns
        first_heave = first_snow + self.snow_columns
        sigma_m = np.full(first_heave + self.heave_columns, NO_CHANGE_M)
        mean_m = np.zeros(len(sigma_m))
        sigma_m[:first_bare] = trends_m[:first_bare]
        if model.snow:
            sigma_m[first_bare:first_snow] = trends_m[: self.bare_columns]
        if model.snow == SNOWFALL:
            thin_snow = np.s_[first_snow:first_heave]
            mean_m[thin_snow], sigma_m[thin_snow] = depth_m * THIN_SNOW_MEAN_SIGMA
        sigma_m[first_heave:] = self.heave_m
        return mean_m, sigma_m

    def knot_precision(self, ratio: int, step: int) -> tuple[Floats, float]:
        """Return the precision (knots, knots) of the change between knots, and log |precision⁻¹|."""
        precision, step_m = self.knot_precisions[ratio], CHANGE_STEPS_M[step]
        log_determinant = self.knot_log_determinants[ratio] + 2 * len(precision) * np.log(step_m)
        return precision / step_m**2, float(log_determinant)

    def precision_at(self, model: ChangeModel) -> tuple[Floats, Floats]:
        """Return the precision (k, k) of a model, and its product with the prior mean (k,)."""
        precision, independent = np.zeros((self.design.shape[1],) * 2), self.independent
        precision[self.knots, self.knots], _ = self.knot_precision(model.ratio, model.step)
        mean_m, sigma_m = self.prior_m(model)
        precision[independent, independent] = 1 / sigma_m**2
        information = np.zeros(len(precision))
        information[independent] = mean_m / sigma_m**2
        return precision, information

    def times_root_precision(self, matrix: Floats, model: ChangeModel) -> Floats:
        """Return the product of a matrix (n, k) and a factor F of the precision F Fᵀ (k, k) of a model."""
        product, independent = np.empty_like(matrix), self.independent
        knot_factor = np.tril(cholesky_inplace(self.knot_precision(model.ratio, model.step)[0]))
        product[:, self.knots] = matrix[:, self.knots] @ knot_factor
        product[:, independent] = matrix[:, independent] / self.prior_m(model)[1]
        return product

    def mean_m(self, estimate_m: Floats) -> float:
        """Return the mean change of moving ground that an estimate (k,) shows [m]; 0 without any."""
        return float((self.design @ estimate_m)[self.moving].mean()) if self.moving.any() else 0.0

    def updated(self, estimate_m: Floats, heave_variance_m2: Floats) -> GroundChange:
        """Return this change with its mean and the size of heave that an estimate (k,) shows.

        The variance of heave is the mean of estimate squared plus posterior variance (heave_columns,), shrunk
        towards the start value (expectation-maximisation).
        """
        heave_m = HEAVE_M
        if self.heave_columns:
            second_moment_m2 = float(np.sum(estimate_m[-self.heave_columns :] ** 2 + heave_variance_m2))
            second_moment_m2 += PRIOR_HEAVE_BLOCKS * HEAVE_M**2
            heave_m = max(np.sqrt(second_moment_m2 / (PRIOR_HEAVE_BLOCKS + self.heave_columns)), MIN_HEAVE_M)
        return replace(self, mean_change_m=self.mean_m(estimate_m), heave_m=heave_m)

    def polar_mean(self, patches: Patches, estimate_m: Floats) -> Floats:
        """Return the mean estimated change of moving ground by azimuth sector and range ring."""
        moving = patches.take(self.moving)
        azimuth_rad = patches.jacobian.params.start_rad + TILT_KNOT_RAD * moving.jacobian.knot_position
        distance_m = (moving.range_bin + 0.5) * patches.bin_m
        return common_mode.polar_mean(azimuth_rad, distance_m, (self.design @ estimate_m)[self.moving])


def ground_change(patches: Patches, moving: Bools, thin_snow: ThinSnow = THIN_SNOW) -> GroundChange:
    """Return the unknown change of patches, of which `moving` (n,) are moving ground."""
    shares = _shares(patches, moving)
    knot_design, precisions, log_determinants = _knots(patches, shares)
    trends = [_trends(patches, share) for share in shares]
    trend_design = sparse.hstack(trends, format="csr")
    snow_design = sparse.csr_array((len(moving), 0))
    if moving.any():
        snow_design = _thin_snow(patches, ~moving & thin_snow.is_possible(patches))
    heave_design = _heave(patches, ~moving)
    return GroundChange(
        sparse.hstack([trend_design, knot_design, snow_design, heave_design], format="csr"),
        np.where(moving, np.argmax(shares, axis=0), STABLE),
        precisions,
        log_determinants,
        trend_design.shape[1],
        trends[1].shape[1] if trends[0].shape[1] else 0,
        snow_design.shape[1],
        heave_design.shape[1],
        thin_snow._replace(shows=thin_snow.shows if snow_design.nnz else False),
        0.0,
        HEAVE_M,
    )


def _shares(patches: Patches, moving: Bools) -> Floats:
    """Return the shares (KINDS, n) of ice and snow, and of bare ground, in moving patches; 0 in others."""
    jacobian = patches.jacobian
    ice_share = np.ones(len(moving))
    moving_row = [name for name, _ in GLOBAL].index("refraction_ice")
    np.divide(jacobian.pose[moving_row], jacobian.refraction, out=ice_share, where=jacobian.refraction != 0)
    return np.stack([ice_share, 1 - ice_share]) * moving


def _knots(patches: Patches, shares: Floats) -> tuple[sparse.csr_array, list[Floats], list[float]]:
    """Return the design (n, knots) of the smooth change, its precisions and log determinants for a unit step.

    Knots form a grid in azimuth and range for each kind of ground; the change is bilinear between them.
    """
    u = patches.jacobian.knot_position / CHANGE_AZIMUTH_KNOTS
    v = (patches.range_bin + 0.5) / CHANGE_RANGE_BINS
    i, j = u.astype(np.int64), v.astype(np.int64)
    u, v = u - i, v - j
    range_knots = int(j.max(initial=0)) + 2
    corners = [(kind, a, b) for kind in range(KINDS) for a in (0, 1) for b in (0, 1)]
    columns = np.concatenate([(kind * KIND_SPACING + i + a) * range_knots + j + b for kind, a, b in corners])
    values = np.concatenate(
        [shares[kind] * (u if a else 1 - u) * (v if b else 1 - v) for kind, a, b in corners]
    )
    rows = np.tile(np.arange(len(u)), len(corners))
    nonzero = values > MIN_SHARE
    knots, columns = np.unique(columns[nonzero], return_inverse=True)
    design = sparse.csr_array((values[nonzero], (rows[nonzero], columns)), shape=(len(u), len(knots)))
    azimuth_knot, range_knot = np.divmod(knots, range_knots)
    distance = np.abs(np.subtract.outer(azimuth_knot, azimuth_knot)) / CORRELATION_AZIMUTH_KNOTS
    distance += np.abs(np.subtract.outer(range_knot, range_knot)) / CORRELATION_RANGE_KNOTS
    factors = [
        ScaledCholesky(np.eye(len(knots)) + ratio**2 * np.exp(-distance))
        for ratio in CORRELATED_CHANGE_RATIOS
    ]
    return design, [factor.inverse() for factor in factors], [factor.log_determinant() for factor in factors]


def _position(patches: Patches) -> tuple[Reals, Reals, Reals]:
    """Return the offset east and north of the scanner, and the distance of patches (n,) [m].

    On a face the distance is the height above its foot (`patches.distance_along_line`). Trends only need
    coordinates that vary smoothly over the ground.
    """
    distance_m = (patches.range_bin + 0.5) * patches.bin_m
    azimuth_rad = patches.jacobian.params.start_rad + TILT_KNOT_RAD * patches.jacobian.knot_position
    east_m, north_m = (distance_m * wave(azimuth_rad) for wave in (np.sin, np.cos))
    return east_m, north_m, distance_m


def _trends(patches: Patches, share: Floats) -> sparse.csr_array:
    """Return the design matrix (n, TRENDS) of the trends of one kind of ground, by its share of patches (n,).

    One is a mean, the others have zero mean and unit variance. There are none without such ground.
    """
    if not (share > MIN_SHARE).any():
        return sparse.csr_array((len(share), 0))
    east_m, north_m, distance_m = _position(patches)
    weight = share * patches.cell_count
    weight /= weight.sum()
    trends = np.stack(
        [np.ones_like(east_m), east_m, north_m, distance_m, distance_m**2, patches.height_m], axis=1
    )
    trends[:, 1:] -= weight @ trends[:, 1:]
    trends[:, 1:] /= np.maximum(np.sqrt(weight @ trends[:, 1:] ** 2), 1e-9)
    return sparse.csr_array(trends * share[:, None])


def _thin_snow(patches: Patches, chosen: Bools) -> sparse.csr_array:
    """Return the design matrix (n, 4) of thin snow on chosen patches, by how much of it their slope holds."""
    snow_class = np.digitize(patches.jacobian.tan_slope, SNOW_SLOPES)
    classes = [(snow_class == index) & chosen for index in range(len(SNOW_SLOPES))]
    return sparse.csr_array(np.stack(classes, axis=1) * 1.0)


def _heave(patches: Patches, stable: Bools) -> sparse.csr_array:
    """Return the design matrix (n, 1 + blocks) of the heave of stable patches: of all, and of each block."""
    if not stable.any():
        return sparse.csr_array((len(stable), 0))
    rows = np.flatnonzero(stable)
    east_m, north_m, _ = _position(patches.take(stable))
    blocks = np.stack([np.floor(axis_m / HEAVE_BLOCK_M) for axis_m in (east_m, north_m)], axis=1)
    _, block = np.unique(blocks, axis=0, return_inverse=True)
    columns = np.concatenate([np.zeros(len(rows), np.int64), 1 + block.ravel()])
    shape = len(stable), int(columns.max()) + 1
    return sparse.csr_array((np.ones(len(columns)), (np.tile(rows, 2), columns)), shape=shape)
