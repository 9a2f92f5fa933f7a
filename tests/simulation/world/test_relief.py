"""Relief of rock: where it is, its scales, and that rays still meet the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from station.errors import ConfigError
from station.simulation.instrument.ray_casting import cast_rays
from station.simulation.station import Station, small


@pytest.fixture(scope="module")
def stations():
    """Return a small station without relief and one with relief of 10 m at full size."""
    return Station(small()), Station(replace(small(), rough_rock_m=10.0))


@pytest.fixture(scope="module")
def relief_m(stations):
    smooth, rough = (station.valley.ground.node for station in stations)
    return rough - smooth


def test_relief_is_on_rock_alone_and_absent_at_the_scanner(stations, relief_m):
    ground, ice = stations[0].valley.ground, stations[0].valley.ice.node
    north, east = np.indices(relief_m.shape) * ground.step_m
    distance_m = np.hypot(east + ground.west_m, north + ground.south_m)
    assert np.abs(relief_m[ice > 0.999]).max() < 1e-4
    assert np.abs(relief_m[distance_m < 10]).max() < 0.1
    assert relief_m[(ice < 0.01) & (distance_m > 200)].std() == pytest.approx(10 * 0.2, rel=0.1)


def test_relief_has_every_scale_and_ridges(stations, relief_m):
    """The structure function of a self-affine surface of Hurst exponent H grows with distance to the power H.

    Crests are jagged and gullies smoother: the values are skewed, unlike a normal field's.
    """
    rock = stations[0].valley.ice.node < 0.001
    growth = []
    for lag in (2, 4):
        pair = rock[:, lag:] & rock[:, :-lag]
        growth.append((relief_m[:, lag:] - relief_m[:, :-lag])[pair].std())
    assert 0.55 < np.log2(growth[1] / growth[0]) < 0.85
    centred = relief_m[rock] - relief_m[rock].mean()
    assert (centred**3).mean() / centred.std() ** 3 < -0.2


def test_steep_faces_follow(stations):
    slopes_deg = []
    for station in stations:
        down, across = np.gradient(station.valley.ground.node, 2.0)
        slope_deg = np.degrees(np.arctan(np.hypot(down, across)))
        slopes_deg.append(np.percentile(slope_deg[station.valley.ice.node < 0.01], 95))
    smooth_deg, rough_deg = slopes_deg
    assert smooth_deg < 50
    assert 52 < rough_deg < 70


def test_rays_meet_rough_ground_where_small_steps_along_them_do(stations):
    station = stations[1]
    ground, eye = station.valley.ground, np.array(station.scenario.mount_position_m)
    rng = np.random.default_rng(4)
    bearing = rng.uniform(np.radians(25), np.radians(165), 800)
    slope = np.tan(rng.uniform(np.radians(-29), np.radians(8), 800))
    hits = cast_rays(ground, eye, bearing, slope, 1100.0, np.zeros_like)
    along = np.arange(15.0, 1100.0, 0.2)
    expected_m = np.full(800, np.nan)
    for ray in range(800):
        up = ground.at(eye[0] + along * np.cos(bearing[ray]), eye[1] + along * np.sin(bearing[ray]))
        below = np.flatnonzero(up >= eye[2] + along * slope[ray])
        if len(below) and below[0] > 0:
            expected_m[ray] = along[below[0]]
    hit = np.isfinite(hits.along_m)
    np.testing.assert_allclose(hits.up_m[hit], ground.at(hits.east_m, hits.north_m)[hit], atol=1e-9)
    np.testing.assert_allclose(hits.up_m[hit], (eye[2] + slope * hits.along_m)[hit], atol=2e-5)
    assert hit.sum() > 500
    assert (np.isfinite(expected_m) == hit).mean() > 0.985
    both = np.isfinite(expected_m) & hit
    assert (np.abs(expected_m - hits.along_m)[both] < 0.5).mean() > 0.985


def test_same_seed_gives_the_same_relief(stations):
    repeated = Station(replace(small(), rough_rock_m=10.0)).valley.ground.node
    other = Station(replace(small(seed=2), rough_rock_m=10.0)).valley.ground.node
    np.testing.assert_array_equal(repeated, stations[1].valley.ground.node)
    assert np.corrcoef(
        (repeated - gaussian_filter(repeated, 4)).ravel(), (other - gaussian_filter(other, 4)).ravel()
    )[0, 1] == pytest.approx(0, abs=0.3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"airborne_share": 1.5}, "0 to 1"),
        ({"line_jitter_freedom": 2.0}, "above 2"),
        ({"wavelength_nm": 532}, "905, 1064, 1550"),
    ],
)
def test_impossible_magnitudes_raise_config_error(settings, message):
    with pytest.raises(ConfigError, match=message):
        replace(small(), **settings)
