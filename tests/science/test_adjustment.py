"""The joint estimate against dense algebra and against simulated scans whose truth is known."""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Habits, Shared
from station.science import adjustment, prior, shared
from station.science.adjustment import adjust
from station.science.likeness import common_errors
from station.science.normals import LineLog
from station.science.patches import Kind, Patches
from station.science.verdict import distrust

HABITS = Habits()
FIRST_DEG, WIDE_DEG = 20, 40  # the sector that is looked at
OF = shared.Basis(math.radians(FIRST_DEG), WIDE_DEG, closed=False)
ROUND = replace(OF, intervals=360, closed=True)  # the last knot is the first
STILL = np.zeros((3, OF.line_count))
STRETCHES = range(6, 38)  # 480 to 3,040 m away
GLOBALS = 9


@cache
def prior_of(of):
    """Covariance (u, u) of a scan's state before anything is seen, and a root of it."""
    lines = prior.lines_of(of, np.eye(3), None)
    sigma = prior.globals_sigma(HABITS, weather_known=True)
    leans = prior.motion(HABITS, lines), prior.bending(HABITS, of), prior.across(HABITS, of, lines)
    covariance = prior.by_line(of, sigma, *leans)
    return covariance, np.linalg.cholesky(covariance)


@cache
def known_before(of):
    """The same as the adjustment takes it: the slow motion straight between knots."""
    return prior.beforehand(of, prior.lines_of(of, np.eye(3), None), HABITS, weather_known=True)


@dataclass
class Ground:
    """Places on a line and a stretch of range, on slopes."""

    line: np.ndarray
    stretch: np.ndarray
    offset_m: tuple
    east: np.ndarray
    north: np.ndarray

    def matrix(self, of=OF):
        """Effect of the state on heights (n, u), written down anew from EQUATIONS 6.1."""
        x, y, z = self.offset_m
        away, east, north = np.hypot(x, y), self.east, self.north
        along = z - east * x - north * y
        rise = away + z * (east * x + north * y) / away
        bend = away * rise / (2 * 6_371_000.0)
        globals_ = [-(y + north * z), x + east * z, east * y - north * x, east, north, -np.ones_like(x)]
        globals_ += [along / np.hypot(away, z), along * 1e-6, bend]
        azimuth_deg = (np.degrees(np.arctan2(x, y)) - FIRST_DEG) % 360
        line = np.floor(azimuth_deg / 0.2)[:, None] == np.arange(of.line_count)
        knot = np.maximum(1 - abs(azimuth_deg[:, None] / 5 - np.arange(of.intervals / 5 + 1)), 0)
        if of.closed:
            knot[:, 0] += knot[:, -1]
            knot = knot[:, :-1]
        sideways = z * (east * y - north * x) / away  # of a turn about the line to the place below or above
        effects = [-rise[:, None] * line, bend[:, None] * knot, sideways[:, None] * knot]
        return np.hstack([np.stack(globals_, axis=-1), *effects])

    def felt(self, of=OF):
        return shared.sensitivities(of, self.offset_m, self.east, self.north)

    def patches(self, residual_m, sigma_m=0.01, kind=Kind.STABLE, of=OF):
        count = len(self.line)
        return Patches(
            self.felt(of),
            self.stretch,
            np.full(count, kind, np.int64) if np.ndim(kind) == 0 else kind,
            np.asarray(residual_m, dtype=float),
            np.full(count, sigma_m**2),
            np.full(count, 20.0),
        )

    def some(self, chosen):
        offset_m = tuple(axis[chosen] for axis in self.offset_m)
        return Ground(
            self.line[chosen], self.stretch[chosen], offset_m, self.east[chosen], self.north[chosen]
        )


def ground(seed, count, within_deg=(0, WIDE_DEG), steep=0.7):
    """Random patches, each once, within some azimuths of the sector."""
    rng = np.random.default_rng(seed)
    lines = np.arange(5 * within_deg[0], 5 * within_deg[1])
    place = rng.choice(len(lines) * len(STRETCHES), count, replace=False)
    line, stretch = lines[place % len(lines)], STRETCHES[0] + place // len(lines)
    azimuth = np.radians(FIRST_DEG + 0.2 * (line + 0.5))
    away_m = 80 * (stretch + 0.5)
    height_m = rng.uniform(-300, 600, count)
    slopes = rng.uniform(-steep, steep, (2, count))
    return Ground(line, stretch, (away_m * np.sin(azimuth), away_m * np.cos(azimuth), height_m), *slopes)


def together(*patches):
    """Patches of several kinds as one."""
    felt = [one.felt for one in patches]
    return Patches(
        shared.Sensitivities(
            felt[0].of,
            np.hstack([one.globals_ for one in felt]),
            *(
                np.concatenate([getattr(one, name) for one in felt])
                for name in ("lean", "refraction", "across", "passed")
            ),
        ),
        *(
            np.concatenate([getattr(one, name) for one in patches])
            for name in ("stretch", "kind", "residual_m", "variance_m2", "cells")
        ),
    )


def nothing():
    return ground(0, 1).patches([0.0]).some(np.array([False]))


FAULTS_RAD = np.radians(0.0015)


def log_faults(of=OF):
    """Effect of a bias about east and north, and of a change of two waves [rad]."""
    azimuth = of.line_azimuth_rad
    columns = [np.cos(azimuth), -np.sin(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth)]
    return FAULTS_RAD * np.stack(columns, axis=-1)


def line_of_sight(of=OF):
    """Effect of the state on what the log measures (lines, u): EQUATIONS 6.3."""
    azimuth = np.radians(FIRST_DEG + 0.2 * (np.arange(of.line_count) + 0.5))
    effect = np.zeros((of.line_count, len(prior_of(of)[0])))
    effect[:, 0], effect[:, 1] = np.cos(azimuth), -np.sin(azimuth)
    effect[:, GLOBALS : GLOBALS + of.line_count] = np.eye(of.line_count)
    return effect


LOG_SIGMA_RAD = np.radians(0.008)


def log_of(state, rng):
    """What a log with its faults and noise says of a state."""
    faults = log_faults()
    told = line_of_sight() @ state + faults @ rng.normal(size=faults.shape[1])
    return LineLog(
        told + rng.normal(0, LOG_SIGMA_RAD, len(told)), np.full(len(told), LOG_SIGMA_RAD**-2), faults
    )


def sigmas(found, cells):
    return np.sqrt(cells.felt().variance(found.shared()))


def simulated(seed, stable, *, log=False, moving=0, change_m=None, sigma_m=0.01):
    """Errors of the adjusted heights all over the sector, and their stated sigmas, in one scan."""
    rng = np.random.default_rng(seed)
    _, root = prior_of(OF)
    state = root @ rng.normal(size=len(root))
    seen = stable.patches(stable.matrix() @ state + rng.normal(0, sigma_m, len(stable.line)), sigma_m)
    if moving:
        snow = ground(seed + 10_000, moving, steep=0.3)
        raised_m = snow.matrix() @ state + rng.normal(0, sigma_m, moving)
        raised_m += 0.0 if change_m is None else change_m(snow, rng)
        seen = together(seen, snow.patches(raised_m, sigma_m, Kind.MOVING))
    found = adjust(seen, STILL, known_before(OF), log_of(state, rng) if log else None)
    cells = ground(seed + 20_000, 200)
    return cells.matrix() @ state - found.effect(cells.felt()), sigmas(found, cells), found


def smooth_snow(mean_m):
    """Snow that varies by a third over the glacier, in waves of 20° and 1.5 km to a side."""

    def fallen(snow, rng):
        turn = rng.uniform(0, 2 * math.pi, 2)
        waves = np.cos(math.radians(1.8) * snow.line + turn[0]) * np.cos(snow.stretch / 12 + turn[1])
        return mean_m * (1 + 0.3 * waves)

    return fallen


def standardised(draws, stable, **scan):
    """Errors over sigmas, and both, of many scans of other states."""
    error_m, sigma_m, _ = zip(*(simulated(seed, stable, **scan) for seed in range(draws)), strict=True)
    return np.array(error_m) / np.array(sigma_m), np.array(error_m), np.array(sigma_m)


def dense(design, residual_m, variance_m2, covariance):
    """Generalised least squares by the gain: estimate and covariance, no normal equations."""
    across = covariance @ design.T
    gain = np.linalg.solve(design @ across + np.diag(variance_m2), across.T).T
    return gain @ residual_m, covariance - gain @ across.T


@pytest.mark.parametrize("with_log", [False, True], ids=["no log", "log"])
@pytest.mark.parametrize(
    "of", [pytest.param(OF, id="sector"), pytest.param(ROUND, id="all round", marks=pytest.mark.slow)]
)
def test_estimate_and_covariance_are_those_of_dense_least_squares(of, with_log, monkeypatch):
    monkeypatch.setattr(adjustment, "ROUNDS", 1)  # weights as they are at first
    rng = np.random.default_rng(1)
    motion, root = prior_of(of)
    covariance = known_before(of).by_line()
    stable, still = ground(2, 2000, within_deg=(0, of.intervals)), np.zeros((3, of.line_count))
    design, variance_m2 = stable.matrix(of), np.full(2000, 0.02**2)
    state = root @ rng.normal(size=len(root))
    residual_m = design @ state + rng.normal(0, 0.02, 2000)
    lines = line_of_sight(of)
    faults, lean_rad = log_faults(of), lines @ state
    log = LineLog(lean_rad, np.full(of.line_count, LOG_SIGMA_RAD**-2), faults) if with_log else None
    found = adjust(stable.patches(residual_m, 0.02, of=of), still, known_before(of), log)
    # What differs between stable patches beyond their random errors is taken to be 2 mm at least.
    spread = variance_m2 + 0.002**2
    wide, wanted, known = design, residual_m, covariance
    if with_log:
        known = np.block(
            [[covariance, np.zeros((len(covariance), 4))], [np.zeros((4, len(covariance))), np.eye(4)]]
        )
        wide = np.block([[design, np.zeros((2000, 4))], [lines, faults]])
        wanted = np.concatenate([residual_m, lean_rad])
        spread = np.concatenate([spread, np.full(of.line_count, LOG_SIGMA_RAD**2)])
    estimate, unknown = dense(wide, wanted, spread, known)
    sigma = np.sqrt(np.diag(unknown))[: len(covariance)]
    told, unknown = (
        c[: len(sigma), : len(sigma)] / np.outer(sigma, sigma) for c in (found.covariance, unknown)
    )
    assert np.abs((found.estimate - estimate[: len(covariance)]) / sigma).max() < 1e-8
    assert np.abs(told - unknown).max() < 1e-8
    assert np.abs(found.effect(stable.felt(of)) - design @ found.estimate).max() < 1e-9
    # The slow motion is straight between knots there. Line by line, as it is, the answer is the same but for
    # the seam, where the head begins and ends.
    wave = np.zeros_like(known)
    wave[: len(motion), : len(motion)] = motion - covariance
    estimate, unknown = dense(wide, wanted, spread, known + wave)
    off = np.abs((found.estimate - estimate[: len(covariance)]) / sigma)
    seam = [*range(9, 24), *range(9 + of.line_count - 15, 9 + of.line_count)] if of.closed else []
    assert np.delete(off, seam).max() < (0.1 if of.closed else 0.01)
    assert off.max() < 0.5
    variance = np.diag(unknown)[: len(sigma)]
    assert np.delete(variance, seam) == pytest.approx(
        np.delete(sigma**2, seam), rel=0.02 if of.closed else 0.01
    )
    assert np.all(variance[seam] < 1.02 * sigma[seam] ** 2)  # they know less there than they could
    kept = shared.by_knots(of, found.estimate, found.covariance)
    assert found.shared().covariance == pytest.approx(kept.covariance, rel=1e-6, abs=1e-9 * sigma[0] ** 2)
    assert found.shared().noise_variance == pytest.approx(kept.noise_variance, rel=1e-6)
    assert found.shared().estimate == pytest.approx(kept.estimate, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("stable", "scan"),
    [
        (ground(31, 150), {}),
        (ground(32, 60, within_deg=(0, 10)), {"log": True}),
        (ground(33, 60, within_deg=(0, 10)), {"moving": 600}),
    ],
    ids=["stable ground all round", "a far ridge and the log", "a far ridge and a glacier at rest"],
)
def test_stated_sigmas_are_those_of_simulated_scans(stable, scan):
    z, error_m, sigma_m = standardised(60 if "moving" not in scan else 30, stable, **scan)
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15
    assert 0.90 < np.mean(np.abs(z) < 1.96) < 0.99
    assert abs(z.mean()) < 0.25
    assert error_m.std() == pytest.approx(np.sqrt(np.mean(sigma_m**2)), rel=0.25)


def test_what_the_points_were_turned_by_before_changes_no_height():
    rng = np.random.default_rng(4)
    _, root = prior_of(OF)
    stable, cells = ground(5, 300), ground(6, 200)
    raw_m = stable.matrix() @ (root @ rng.normal(size=len(root))) + rng.normal(0, 0.01, 300)
    assumed_rad = np.radians(rng.normal(0, 0.003, (3, OF.line_count)))

    def raised_by_turning(places):
        """How much higher turned points lie above the slopes they were on [m], from rotation matrices."""
        before = np.stack(places.offset_m, axis=-1)
        moved = Rotation.from_rotvec(assumed_rad[:, places.line].T).apply(before) - before
        return moved[:, 2] - places.east * moved[:, 0] - places.north * moved[:, 1]

    plain = adjust(stable.patches(raw_m), STILL, known_before(OF), None)
    turned = adjust(stable.patches(raw_m + raised_by_turning(stable)), assumed_rad, known_before(OF), None)
    assert np.abs(raised_by_turning(cells)).max() > 0.1
    # The corrected height of a turned cell: up by the turn, down by the state beyond the turn.
    corrected_m = raised_by_turning(cells) - (
        turned.effect(cells.felt()) - adjustment.turned(cells.felt(), assumed_rad)
    )
    assert corrected_m == pytest.approx(-plain.effect(cells.felt()), abs=2e-4)


def test_a_log_alone_gives_the_lean_it_shows_no_better_than_it_is():
    covariance, _ = prior_of(OF)
    lines, faults = line_of_sight(), log_faults()
    shown = np.zeros(len(covariance))
    shown[0] = np.radians(0.01)
    log = LineLog(lines @ shown, np.full(OF.line_count, LOG_SIGMA_RAD**-2), faults)
    found = adjust(nothing(), STILL, known_before(OF), log)
    assert lines @ found.estimate == pytest.approx(lines @ shown, rel=0.2)
    told, before = (
        np.sqrt(np.einsum("ij,jk,ik->i", lines, c, lines)) for c in (found.covariance, covariance)
    )
    noise_rad = LOG_SIGMA_RAD / math.sqrt(OF.line_count)
    assert (told > np.radians(0.0015)).all()  # its bias stays
    assert (told > noise_rad).all()
    assert (told < 0.5 * before).all()
    cells, stable = ground(7, 200), ground(8, 300)
    with_ground = adjust(stable.patches(np.zeros(300)), STILL, known_before(OF), log)
    assert np.median(sigmas(found, cells)) > 3 * np.median(sigmas(with_ground, cells))
    assert distrust(found, HABITS) == ["no stable ground seen"]


def reference_of(sigma_rad):
    """A reference that leans by so much, as a whole and from knot to knot, and is right otherwise."""
    names, lean = OF.names, slice(GLOBALS, GLOBALS + OF.lean_count)
    covariance = np.zeros((len(names),) * 2)
    covariance[[0, 1], [0, 1]] = sigma_rad**2
    knots = np.arange(OF.lean_count)
    covariance[lean, lean] = sigma_rad**2 * np.exp(-np.abs(np.subtract.outer(knots, knots)) / 20)
    return Shared(names, OF.units, np.zeros(len(names)), covariance, np.zeros(len(names)))


@pytest.mark.parametrize(("sigma_deg", "too_sure"), [(0.002, 1.3), (0.004, 2.0)])
def test_a_log_does_not_feel_what_the_reference_leans_by(sigma_deg, too_sure):
    """Scans differ from such a reference by more than their logs can know; σ says by how much."""
    lines, reference = line_of_sight(), reference_of(math.radians(sigma_deg))
    before = known_before(OF).against(reference)
    root = np.linalg.cholesky(reference.covariance + 1e-24 * np.eye(len(OF.names)))
    known, ignored = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        state = prior_of(OF)[1] @ rng.normal(size=len(prior_of(OF)[0]))
        log = log_of(state, rng)
        state -= shared.rows_at_lines(OF, root @ rng.normal(size=(len(root), 1)))[:, 0]
        for ratios, told in ((known, log.against(OF, reference.covariance)), (ignored, log)):
            found = adjust(nothing(), STILL, before, told)
            sigma_rad = np.sqrt(np.einsum("ij,jk,ik->i", lines, found.covariance, lines))
            ratios.append(lines @ (found.estimate - state) / sigma_rad)
    assert 0.85 < np.sqrt(np.mean(np.square(known))) < 1.15
    assert np.sqrt(np.mean(np.square(ignored))) > too_sure


def test_what_a_log_should_have_said_is_known_as_well_as_stated():
    """With ground and a reference that leans: the scan's own lean, which is the sum of both."""
    lines, stable, reference = line_of_sight(), ground(3, 400), reference_of(math.radians(0.003))
    before, ratios = known_before(OF).against(reference), []
    root = np.linalg.cholesky(reference.covariance + 1e-24 * np.eye(len(OF.names)))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        own = prior_of(OF)[1] @ rng.normal(size=len(prior_of(OF)[0]))
        state = own - shared.rows_at_lines(OF, root @ rng.normal(size=(len(root), 1)))[:, 0]
        residual_m = stable.matrix() @ state + rng.normal(0, 0.01, 400)
        log = log_of(own, rng).against(OF, reference.covariance)
        found = adjust(stable.patches(residual_m), STILL, before, log)
        sigma_rad = np.sqrt(np.diag(found.unknown.along_sight(log)))
        ratios.append((found.logged_rad - lines @ own) / sigma_rad)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1, abs=0.3)


def test_a_dead_stretch_of_the_log_counts_nothing():
    lean_rad = np.full(OF.line_count, 1e-4)
    weight = np.where(np.arange(OF.line_count) < 100, LOG_SIGMA_RAD**-2, 0.0)
    wild_rad = np.where(weight > 0, lean_rad, 0.3)
    quiet, wild = (
        adjust(nothing(), STILL, known_before(OF), LineLog(told, weight, log_faults()))
        for told in (lean_rad, wild_rad)
    )
    assert np.array_equal(quiet.estimate, wild.estimate)


def test_nothing_seen_leaves_what_was_known_before():
    covariance = known_before(OF).by_line()
    found = adjust(nothing(), STILL, known_before(OF), None)
    assert np.abs(found.estimate).max() == 0.0
    sigma = np.sqrt(np.diag(covariance))
    assert found.covariance / np.outer(sigma, sigma) == pytest.approx(
        covariance / np.outer(sigma, sigma), abs=1e-6
    )


def test_smooth_snow_on_the_glacier_leaks_little_where_stable_ground_is_spread():
    stable = ground(41, 100)
    for seed in range(4):
        error_m, sigma_m, found = simulated(seed, stable, moving=1000, change_m=smooth_snow(0.4))
        assert found.change_step_m >= 0.05
        assert np.abs(error_m).max() < 0.06
        assert np.sqrt(np.mean(error_m**2)) < 0.02
        assert np.sqrt(np.mean((error_m / sigma_m) ** 2)) < 2.0


@pytest.mark.parametrize(
    ("stable", "log"),
    [(ground(42, 60, within_deg=(0, 10)), False), (ground(43, 1, within_deg=(0, 10)), True)],
    ids=["a far ridge", "the log alone"],
)
def test_stated_sigmas_hold_while_snow_falls_and_little_is_stable(stable, log):
    z, _, _ = standardised(12, stable, log=log, moving=800, change_m=smooth_snow(0.4))
    assert np.sqrt(np.mean(z**2)) < 2.0


def test_a_glacier_at_rest_helps():
    stable = ground(44, 60, within_deg=(0, 10))
    with_it, without = (simulated(45, stable, moving=moving) for moving in (1000, 0))
    assert with_it[2].change_step_m <= 0.005
    assert np.median(with_it[1]) < 0.3 * np.median(without[1])
    assert np.sqrt(np.mean(with_it[0] ** 2)) < 0.015


def wrong_by(seed, count, share):
    """Adjust to stable ground of which a share, at random, is a metre too high."""
    rng = np.random.default_rng(seed)
    _, root = prior_of(OF)
    stable, cells = ground(seed + 51, count), ground(seed + 500, 200)
    state = root @ rng.normal(size=len(root))
    residual_m = stable.matrix() @ state + rng.normal(0, 0.01, count)
    wrong = rng.uniform(size=count) < share
    found = adjust(stable.patches(residual_m + wrong), STILL, known_before(OF), None)
    return cells.matrix() @ state - found.effect(cells.felt()), sigmas(found, cells), found, wrong


def test_a_tenth_of_the_stable_ground_a_metre_too_high_does_no_harm():
    error_m, sigma_m, found, wrong = zip(*(wrong_by(seed, 1000, 0.1) for seed in range(8)), strict=True)
    clean_m = np.array([wrong_by(seed, 1000, 0.0)[0] for seed in range(8)])
    z = np.array(error_m) / np.array(sigma_m)
    assert np.sqrt(np.mean(z**2)) < 1.2
    assert np.median(np.abs(error_m)) < 1.5 * np.median(np.abs(clean_m))
    for one, bad in zip(found, wrong, strict=True):
        assert one.stable_weight[bad].max() == 0.0
        assert np.median(one.stable_weight[~bad]) > 0.9
        assert distrust(one, HABITS) == []


def test_stable_ground_that_disagrees_with_itself_is_distrusted():
    _, _, found, _ = wrong_by(53, 400, 0.4)
    assert any("disagrees with itself" in reason for reason in distrust(found, HABITS))


@pytest.mark.parametrize(
    ("place", "size", "word"), [(0, 0.0006, "leans"), (2, 0.00011, "turned"), (5, 0.013, "shifted")]
)
def test_a_scanner_that_was_moved_is_told(place, size, word):
    covariance, _ = prior_of(OF)
    at_rest = adjust(ground(54, 400).patches(np.zeros(400)), STILL, known_before(OF), None)
    assert distrust(at_rest, HABITS) == []
    for share, wanted in ((0.5, []), (1.0, [word])):
        moved = np.zeros(len(covariance))
        moved[place] = share * size
        reasons = distrust(replace(at_rest, estimate=moved), HABITS)
        assert [word for reason in reasons if word in reason] == wanted
        assert len(reasons) == len(wanted)


def test_withheld_and_unused_patches_are_not_looked_at():
    rng = np.random.default_rng(60)
    stable = ground(61, 300)
    kind = rng.choice([Kind.STABLE, Kind.WITHHELD], 300, p=[0.9, 0.1])
    residual_m = rng.normal(0, 0.01, 300)
    found, again = (
        adjust(stable.patches(told, kind=kind), STILL, known_before(OF), None)
        for told in (residual_m, residual_m + 5.0 * (kind == Kind.WITHHELD))
    )
    assert np.array_equal(found.estimate, again.estimate)
    assert np.array_equal(found.covariance, again.covariance)
    assert len(found.stable_weight) == np.count_nonzero(kind == Kind.STABLE)


def test_an_avalanche_stays_where_it_is():
    rng = np.random.default_rng(70)
    _, root = prior_of(OF)
    state = root @ rng.normal(size=len(root))
    stable, glacier, cells = ground(71, 100), ground(72, 3000, steep=0.3), ground(73, 400)
    path = (np.abs(glacier.line - 100) < 4) & (np.abs(glacier.stretch - 20) < 3)
    assert 8 <= np.count_nonzero(path) <= 30
    plain_m = glacier.matrix() @ state + rng.normal(0, 0.01, 3000)
    seen = stable.patches(stable.matrix() @ state + rng.normal(0, 0.01, 100))
    found, struck = (
        adjust(together(seen, glacier.patches(told, kind=Kind.MOVING)), STILL, known_before(OF), None)
        for told in (plain_m, plain_m + 2.0 * path)
    )
    apart_m = struck.effect(cells.felt()) - found.effect(cells.felt())
    elsewhere = np.abs(cells.line - 100) > 12
    assert np.abs(apart_m[elsewhere]).max() < 0.005
    assert struck.change_step_m <= 0.005


def thin_snow(seed, risen_m):
    """Errors over sigmas, and errors, where glacier and all but steep rock changed by as much."""
    rng = np.random.default_rng(seed)
    _, root = prior_of(OF)
    state = root @ rng.normal(size=len(root))
    stable, glacier, cells = (
        ground(seed + 90, 1500, steep=2.0),
        ground(seed + 95, 1500, steep=0.3),
        ground(99, 200),
    )
    lies = np.hypot(stable.east, stable.north) < np.tan(np.radians(40)) if risen_m > 0 else 0.0
    seen = together(
        stable.patches(stable.matrix() @ state + rng.normal(0, 0.003, 1500) + risen_m * lies, 0.003),
        glacier.patches(glacier.matrix() @ state + rng.normal(0, 0.003, 1500) + risen_m, 0.003, Kind.MOVING),
    )
    found = adjust(seen, STILL, known_before(OF), None)
    error_m = cells.matrix() @ state - found.effect(cells.felt())
    return error_m / sigmas(found, cells), error_m


def test_snow_too_thin_to_be_seen_on_rock_is_not_taken_for_a_rise_of_the_scanner():
    z, error_m = (np.array(one) for one in zip(*(thin_snow(seed, 0.006) for seed in range(6)), strict=True))
    assert np.abs(error_m.mean(axis=1)).max() < 0.003  # 6 mm if it were
    assert np.sqrt(np.mean(z**2)) < 1.3
    sigma_m, melting_m = (np.median(np.divide(*thin_snow(7, change)[::-1])) for change in (0.006, -0.006))
    assert melting_m < sigma_m  # where ground falls, rock stays what it is


def test_a_reference_that_is_wrong_itself_makes_the_prior_wider():
    p = len(OF.names)
    root = np.random.default_rng(80).normal(size=(p, p)) * 1e-5
    known = shared.Shared(OF.names, OF.units, np.zeros(p), root @ root.T, np.zeros(p))
    alone = known_before(OF)
    assert alone.against(None) is alone
    cells = ground(81, 50)
    design = cells.matrix()
    told_m2 = np.einsum("ij,jk,ik->i", design, alone.against(known).by_line() - alone.by_line(), design)
    assert told_m2 == pytest.approx(cells.felt().variance(known), rel=1e-6)
    elsewhere = replace(known, names=(*OF.names[:-1], "of a scanner that stood otherwise"))
    assert alone.against(elsewhere).by_line() == pytest.approx(2 * alone.by_line(), rel=1e-12)


def test_what_is_known_beforehand_is_the_motion_line_by_line():
    for of in (OF, ROUND):
        covariance, _ = prior_of(of)
        sigma = np.sqrt(np.diag(covariance))
        apart = np.abs(known_before(of).by_line() - covariance) / np.outer(sigma, sigma)
        assert np.diag(apart).max() < 1e-12
        assert np.median(apart) < 2e-4
        seam = 15 if of.closed else 0  # lines about the place where the head begins and ends
        lines = slice(9 + seam, 9 + of.line_count - seam)
        assert apart[lines, lines].max() < 0.01


RIDGE, GLACIER = ground(1, 40, within_deg=(0, 5)), ground(2, 900, steep=0.3)
BOXES = [GLACIER.line // 50 == part for part in range(4)] + [np.ones(900, bool)]


def changed(seed):
    """Change of the glacier by 20 mm and between knots 4° and 240 m apart."""
    knots = np.random.default_rng(seed).normal(0, 0.02, (13, 14))
    u, v = (GLACIER.line + 0.5) / 20, (GLACIER.stretch + 0.5) / 3
    i, j = u.astype(int), v.astype(int)
    u, v = u - i, v - j
    beside = (1 - u) * ((1 - v) * knots[i, j] + v * knots[i, j + 1])
    return beside + u * ((1 - v) * knots[i + 1, j] + v * knots[i + 1, j + 1]) + knots[-1, -1]


def of_glacier(seed, change_m):
    """What an adjustment leaves wrong of means over the glacier, and what is known of it."""
    rng = np.random.default_rng(seed)
    _, root = prior_of(OF)
    state = root @ rng.normal(size=len(root))
    still, moved = (one.matrix() @ state + rng.normal(0, 0.01, len(one.line)) for one in (RIDGE, GLACIER))
    seen = together(RIDGE.patches(still), GLACIER.patches(moved + change_m, kind=Kind.MOVING))
    found = adjust(seen, STILL, known_before(OF), None)
    error_m = GLACIER.matrix() @ state - found.effect(GLACIER.felt())
    return np.array([error_m[box].mean() for box in BOXES]), found.shared()


def spread(draws, change_of):
    """Spread of errors over sigma of differences of two scans: both apart, and with what they have alike."""
    felt = GLACIER.felt()
    effect = np.array([felt.total(box / box.sum()) for box in BOXES])
    apart, alike = [], []
    for draw in range(draws):
        (one_m, one), (other_m, other) = (
            of_glacier(2 * draw + n, change_m) for n, change_m in enumerate(change_of(draw))
        )
        variance_m2 = sum(
            np.array(
                [shared.aggregate_variance(box / box.sum(), np.zeros(900), felt, known) for box in BOXES]
            )
            for known in (one, other)
        )
        common_m2 = np.sum((effect @ common_errors(one, other)) * effect, axis=1)
        apart.append((one_m - other_m) / np.sqrt(variance_m2))
        alike.append((one_m - other_m) / np.sqrt(variance_m2 - 2 * common_m2))
    return np.std(apart), np.std(alike)


def test_the_same_change_in_two_scans_is_not_in_the_sigma_of_their_difference():
    apart, alike = spread(25, lambda seed: (changed(seed), 0.9 * changed(seed)))
    assert apart < 0.65
    assert 1.25 * apart < alike < 1.2


def test_opposite_change_in_two_scans_is_more_so():
    apart, alike = spread(25, lambda seed: (changed(seed), -changed(seed)))
    assert apart > 1.2
    assert 0.8 < alike < 1.2


def test_as_much_change_elsewhere_stays_in_it():
    apart, alike = spread(25, lambda seed: (changed(seed), changed(seed + 1000)))
    assert 0.8 < apart < 1.2
    assert 0.8 < alike < 1.2
