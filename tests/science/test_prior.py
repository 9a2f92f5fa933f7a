"""What is known before a scan: when lines are passed, covariances, habits learned from simulated scans."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Habits, HeadTrack, Tilt
from station.science import prior, shared
from station.science.inclination import LEVEL, Cycle, Lean

HABITS = Habits()
OF = shared.Basis(math.radians(20), 30, closed=False)
SPEED_RAD_S = math.radians(0.13)


def mount(heading_deg, leaning_deg, towards_deg=35.0):
    """Scanner's frame to the map's: turned by a heading, then leaning about a level axis."""
    about = leaning_deg * np.array(
        [math.cos(math.radians(towards_deg)), math.sin(math.radians(towards_deg)), 0]
    )
    return (
        Rotation.from_rotvec(about, degrees=True) * Rotation.from_euler("z", heading_deg, degrees=True)
    ).as_matrix()


def looking(to_local, head_rad, elevation_rad=0.0):
    """Where on the map the head looks (3, n): its azimuth counter-clockwise from the scanner's x."""
    level = np.cos(elevation_rad)
    return to_local @ np.stack(
        [level * np.cos(head_rad), level * np.sin(head_rad), np.sin(elevation_rad) + 0 * head_rad]
    )


def basis_about(to_local, head_rad):
    """A sector that holds what the head passes."""
    whole = shared.Basis(0.0, 360, closed=True, axis=tuple(to_local[:, 2]))
    middle = whole.knots_before(tuple(looking(to_local, np.array([np.mean(head_rad)]))))[0]
    wide = math.degrees(np.ptp(head_rad)) / 2
    first = math.floor((middle - wide) / 5) * 5 - 5
    return shared.Basis(
        math.radians(first), 5 * math.ceil((2 * wide + 15) / 5), closed=False, axis=whole.axis
    )


@pytest.mark.parametrize("leaning_deg", [0.0, 5.0])
@pytest.mark.parametrize(
    ("first_deg", "last_deg"), [(20.0, 140.0), (-250.0, -130.0), (140.0, 20.0), (300.0, 420.0)]
)
@pytest.mark.parametrize("heading_deg", [0.0, 70.0, 190.0])
def test_lines_are_passed_when_the_head_looks_there(leaning_deg, first_deg, last_deg, heading_deg):
    to_local = mount(heading_deg, leaning_deg)
    head_rad = np.radians(np.linspace(first_deg, last_deg, 200))
    time_s = 50 + 900 * np.linspace(0, 1, 200) ** 1.1  # it does not turn quite evenly
    of = basis_about(to_local, head_rad)
    lines = prior.lines_of(of, to_local, HeadTrack(time_s, head_rad))
    for elevation_deg in (-20.0, 0.0, 30.0):
        seen = looking(to_local, head_rad, math.radians(elevation_deg))
        line = shared.LINES_A_KNOT * of.knots_before(tuple(seen)) - 0.5
        told_s = np.interp(line, np.arange(of.line_count), lines.time_s)
        assert told_s[1:-1] == pytest.approx(time_s[1:-1], abs=0.3)
    beside = looking(to_local, lines.azimuth_rad)
    assert of.knots_before(tuple(beside)) * 5 == pytest.approx(np.arange(of.line_count) + 0.5)


def test_lines_all_round():
    to_local = mount(40.0, 3.0)
    head_rad = np.linspace(math.radians(-200), math.radians(160), 500)
    of = shared.Basis(0.0, 360, closed=True, axis=tuple(to_local[:, 2]))
    lines = prior.lines_of(of, to_local, HeadTrack(np.linspace(0, 2400, 500), head_rad))
    line = (5 * of.knots_before(tuple(looking(to_local, head_rad)))).astype(int)
    half_s = 0.1 / 0.15
    assert lines.time_s[line][1:-1] == pytest.approx(np.linspace(0, 2400, 500)[1:-1], abs=half_s + 0.01)


def test_beyond_the_scan_the_head_goes_on():
    head_rad = np.radians(np.linspace(80, 50, 100))
    lines = prior.lines_of(OF, np.eye(3), HeadTrack(np.linspace(0, 200, 100), head_rad))
    assert lines.time_s == pytest.approx((np.radians(80) - lines.azimuth_rad) / np.radians(30 / 200))


def test_without_a_track_the_head_turns_at_its_usual_speed():
    lines = prior.lines_of(OF, np.eye(3), None)
    assert np.diff(lines.time_s) == pytest.approx(np.full(OF.line_count - 1, 0.2 / 0.13))
    assert lines.azimuth_rad == pytest.approx(math.pi / 2 - OF.line_azimuth_rad)


def lean_of(time_s, roll_rad, pitch_rad, noise_rad=1e-4):
    told = Tilt(time_s, roll_rad, pitch_rad)
    return Lean(told, told, 0.0, 0.0, noise_rad, noise_rad / 5, 20.0, 0.02, 0.0, 2.5, 1.0)


def risen(head_rad, roll_rad, pitch_rad):
    """How far the line of sight rises in the scanner's own frame when it leans, by rotation matrices."""
    sight = np.stack([np.cos(head_rad), np.sin(head_rad), np.zeros_like(head_rad)], axis=-1)
    about = np.stack([roll_rad, pitch_rad, np.zeros_like(head_rad)], axis=-1)
    return np.arcsin(Rotation.from_rotvec(about).apply(sight)[:, 2])


@pytest.mark.parametrize("leaning_deg", [0.0, 5.0])
@pytest.mark.parametrize("turning", [1, -1])
def test_the_log_tells_how_far_each_line_of_sight_rises(leaning_deg, turning):
    to_local = mount(70.0, leaning_deg)
    head_rad = turning * np.radians(np.linspace(20, 80, 100))
    track = HeadTrack(np.linspace(100, 560, 100), head_rad)
    of = basis_about(to_local, head_rad)
    lines = prior.lines_of(of, to_local, track)
    time_s = np.arange(80.0, 580.0)
    roll_rad, pitch_rad = 1e-4 + 4e-7 * time_s, -2e-4 + 3e-5 * np.sin(time_s / 150)
    log = prior.line_log(of, lines, lean_of(time_s, roll_rad, pitch_rad), LEVEL, to_local)
    there = log.weight > 0
    wanted = risen(
        lines.azimuth_rad,
        *(np.interp(lines.time_s, time_s, axis) for axis in (roll_rad, pitch_rad)),
    )
    assert np.abs(wanted[there]).max() > 1e-4
    assert log.lean_rad[there] == pytest.approx(wanted[there], abs=0.012 * np.abs(wanted).max())
    count = log.weight * 1e-8
    assert count == pytest.approx(np.rint(count), abs=1e-6)  # samples on each line, each of variance 1e-8
    beyond_s = (lines.time_s < 79) | (lines.time_s > 580)
    assert not log.weight[beyond_s].any()
    inside = (lines.time_s > 82) & (lines.time_s < 577)
    assert count[inside].sum() == pytest.approx(np.ptp(lines.time_s[inside]), abs=4)


def test_faults_of_the_log_are_a_bias_and_waves():
    lines = prior.lines_of(OF, np.eye(3), None)
    time_s = np.arange(0.0, 230.0)
    zero = Cycle((0.0, 2e-4, 1e-4), (0.0, -1e-4, 3e-4))
    log = prior.line_log(OF, lines, lean_of(time_s, 0 * time_s, 0 * time_s), zero, np.eye(3))
    bias = [risen(lines.azimuth_rad, *np.outer(one, np.ones(OF.line_count))) for one in 1e-6 * np.eye(2)]
    wanted = math.radians(0.0015) * np.array(bias).T / 1e-6
    assert log.faults[:, :2] == pytest.approx(wanted, rel=1e-6)
    two = 2 * OF.line_azimuth_rad
    assert log.faults[:, 2:5] / math.radians(0.002) == pytest.approx(
        np.stack([np.ones_like(two), np.cos(two), np.sin(two)], axis=-1)
    )
    assert np.array_equal(log.faults[:, 5:], prior.cycle_changes(lines, zero))


@pytest.mark.parametrize("largest", [1.0, 0.5])
def test_changes_of_the_cycle_against_its_wave_made_a_fifth_larger(largest):
    """A wave beyond 0.05° is the mount's lean: only 0.05° of it may change."""
    rng = np.random.default_rng(3)
    lines = prior.lines_of(shared.Basis(0.0, 360, closed=True), np.eye(3), None)
    roll, pitch = rng.normal(size=(2, 3))
    size = math.radians(0.05) / largest
    for wave in (roll, pitch):
        wave[1:] *= size / math.hypot(*wave[1:])
    told, across = (
        prior.cycle_changes(lines, Cycle(tuple(roll), tuple(pitch)), beside) for beside in (0.0, math.pi / 2)
    )
    grown = [np.array([wave[0], *(1 + 0.2 * largest) * wave[1:]]) for wave in (roll, pitch)]
    before = Cycle(tuple(roll), tuple(pitch)).at(lines.azimuth_rad)
    for column, after in enumerate(
        (Cycle(tuple(grown[0]), tuple(pitch)), Cycle(tuple(roll), tuple(grown[1])))
    ):
        moved = [a - b for a, b in zip(after.at(lines.azimuth_rad), before, strict=True)]
        wanted = moved[0] * np.sin(lines.azimuth_rad) - moved[1] * np.cos(lines.azimuth_rad)
        assert told[:, column] == pytest.approx(wanted, abs=1e-12)
        about = moved[0] * np.cos(lines.azimuth_rad) + moved[1] * np.sin(lines.azimuth_rad)
        assert across[:, column] == pytest.approx(about, abs=1e-12)


def test_motion_is_a_covariance_of_three_memories():
    lines = prior.lines_of(OF, np.eye(3), None)
    told = prior.motion(HABITS, lines)
    slow, fast, white = np.radians([0.0018, 0.0010, 0.0008]) ** 2
    assert np.diag(told) == pytest.approx(slow + fast + white)
    assert np.linalg.eigvalsh(told).min() > 0.9 * white
    assert np.array_equal(told, told.T)
    apart_s = 0.2 / 0.13 * np.array([1, 10, 100])
    assert told[0, [1, 10, 100]] == pytest.approx(slow * np.exp(-apart_s / 300) + fast * np.exp(-apart_s / 3))


@pytest.mark.parametrize("of", [OF, shared.Basis(0.0, 360, closed=True)], ids=["sector", "all round"])
def test_bending_is_alike_within_fifteen_degrees_also_across_north(of):
    told = prior.bending(HABITS, of)
    assert np.diag(told) == pytest.approx(0.02**2)
    assert told[0, 3] == pytest.approx(0.02**2 / math.e)
    assert np.linalg.eigvalsh(told).min() > 0
    if of.closed:
        assert told[0, -3] == pytest.approx(0.02**2 / math.e)


def test_a_scale_without_weather_is_less_known():
    known, unknown = (prior.globals_sigma(HABITS, weather_known=told) for told in (True, False))
    assert known[7] == 0.8
    assert unknown[7] == pytest.approx(math.hypot(5 * 0.737, 5 * 0.29), rel=0.05)  # 5 K and 5 hPa
    assert np.array_equal(np.delete(known, 7), np.delete(unknown, 7))


def scans_of(habits, count, seed=0):
    """States (u,) drawn from some habits, each known all but exactly."""
    rng = np.random.default_rng(seed)
    lines = prior.lines_of(OF, np.eye(3), None)
    sigma = prior.globals_sigma(habits, weather_known=True)
    covariance = prior.by_line(
        OF, sigma, prior.motion(habits, lines), prior.bending(habits, OF), prior.across(habits, OF, lines)
    )
    root = np.linalg.cholesky(covariance)
    return [(lines, root @ rng.normal(size=len(root)), 1e-6 * covariance) for _ in range(count)]


def test_a_station_twice_as_restless_is_learned_to_be():
    restless = Habits(**{name: 2 * value for name, value in vars(HABITS).items()})
    told = prior.learned(HABITS, OF, scans_of(restless, 40))
    for name in prior.MOTIONS:
        assert getattr(told, name) / getattr(HABITS, name) == pytest.approx(2, rel=0.25)
    ratio = np.array([getattr(told, name) / value for name, value in vars(HABITS).items()])
    assert ratio == pytest.approx(2, rel=0.35)  # the others show once or thrice a scan: 40 to 120 draws
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.87, rel=0.08)  # eight scans' worth of the start


def test_a_station_as_it_was_taken_to_be_stays_so():
    told = prior.learned(HABITS, OF, scans_of(HABITS, 40))
    for name, value in vars(HABITS).items():
        assert getattr(told, name) == pytest.approx(value, rel=0.25)


@pytest.mark.parametrize("count", [0, 1])
def test_one_scan_teaches_nothing(count):
    assert prior.learned(HABITS, OF, scans_of(replace(HABITS, tilt_rad=1.0), count)) == HABITS


def test_what_a_scan_leaves_unknown_counts_as_shown():
    """Scans without any observation have estimates of nought and all of the prior as covariance."""
    lines = prior.lines_of(OF, np.eye(3), None)
    sigma = prior.globals_sigma(HABITS, weather_known=True)
    covariance = prior.by_line(
        OF, sigma, prior.motion(HABITS, lines), prior.bending(HABITS, OF), prior.across(HABITS, OF, lines)
    )
    blind = [(lines, np.zeros(len(covariance)), covariance)] * 80
    for name, value in vars(prior.learned(HABITS, OF, blind)).items():
        assert value == pytest.approx(getattr(HABITS, name), rel=0.01)


@pytest.mark.parametrize("name", ["fast_motion_rad", "line_motion_rad"])
def test_motions_are_told_apart(name):
    restless = replace(HABITS, **{name: 2 * getattr(HABITS, name)})
    told = prior.learned(HABITS, OF, scans_of(restless, 40))
    for one in prior.MOTIONS:
        wanted = 1.87 if one == name else 1.0
        assert getattr(told, one) / getattr(HABITS, one) == pytest.approx(wanted, rel=0.2)


def test_what_stays_unknown_without_adjustment_is_a_covariance_and_a_log_makes_it_smaller():
    lines = prior.lines_of(OF, np.eye(3), None)
    time_s = np.arange(0.0, 240.0)
    zero = Cycle((0.0, 3e-4, 0.0), (0.0, 0.0, 3e-4))
    lean = lean_of(time_s, 0 * time_s, 0 * time_s, noise_rad=math.radians(0.008))
    lean = replace(lean, filtered_noise_rad=math.radians(0.008) / math.sqrt(20))
    rng = np.random.default_rng(5)
    azimuth, away_m = rng.uniform(np.radians(20), np.radians(50), 300), rng.uniform(500, 3000, 300)
    offset_m = away_m * np.sin(azimuth), away_m * np.cos(azimuth), rng.uniform(-300, 300, 300)
    felt = shared.sensitivities(OF, offset_m, *rng.uniform(-0.3, 0.3, (2, 300)))
    with_log, without = (
        prior.covariance_without_adjustment(OF, lines, told, zero, HABITS, weather_known=True)
        for told in (lean, None)
    )
    for unknown in (with_log, without):
        sigma = np.sqrt(np.diag(unknown.covariance))
        assert np.linalg.eigvalsh(unknown.covariance / np.outer(sigma, sigma)).min() > -1e-9
        assert unknown.covariance == pytest.approx(unknown.covariance.T, rel=1e-9)
        assert (unknown.noise_variance >= 0).all()
        assert not unknown.estimate.any()
        assert len(unknown.names) == len(unknown.estimate) == len(unknown.noise_variance)
    assert (felt.variance(with_log) < felt.variance(without)).all()
    assert felt.variance(with_log).mean() < 0.5 * felt.variance(without).mean()


def test_the_lean_across_is_as_slow_as_the_mount():
    """Between knots 5° apart 5 / 0.13 seconds go by; the slow motion is forgotten over 300 s."""
    lines = prior.lines_of(OF, np.eye(3), None)
    told = prior.across(HABITS, OF, lines)
    assert told.shape == (OF.refraction_count,) * 2
    assert np.diag(told) == pytest.approx(HABITS.slow_motion_rad**2)
    within = told[1:-2, 2:-1].diagonal() / HABITS.slow_motion_rad**2
    assert within == pytest.approx(math.exp(-5 / 0.13 / 300), rel=1e-6)
