"""Verdict of an epoch: obstructions of the view, misfit of stable ground, and their severity."""

from dataclasses import replace

import numpy as np
import pytest

from station.quantities import CELL_DTYPE, Grid, Measurement, Reference, Scanner, SharedParameters
from station.science.analysis import verdict
from station.science.gridding.viewing_geometry import compute_viewing_geometry

GRID = Grid(-100.0, 3000.0, 10.0, 300, 300)  # north-east of the scanner
POSITION_M = (0.0, 0.0, 100.0)
X, Y = np.meshgrid(GRID.x_m, GRID.y_m)
RANGE_M = np.hypot(X, Y)
AZIMUTH = np.degrees(np.arctan2(X, Y))
SCANNER = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)
NO_CELLS = np.zeros(GRID.shape, bool)


def reference(visible_share=0.9):
    flat = Reference.from_elevation(GRID, "1", np.zeros(GRID.shape))
    return replace(flat, visibility=np.full(GRID.shape, visible_share, np.float32))


def observe(observed, surface):
    viewing = compute_viewing_geometry(surface, NO_CELLS, SCANNER, POSITION_M)
    return verdict.visibility(observed.astype(np.int32).ravel()[viewing.cells["cell"]], viewing)


def obstruction_messages(observed):
    return verdict.obstructions(observe(observed, reference()))


def random_cells(share, seed=1):
    return np.random.default_rng(seed).uniform(size=GRID.shape) < share


def test_the_usual_view_has_no_obstructions():
    visible = observe(random_cells(0.9), reference())
    assert visible.share == pytest.approx(1.0, abs=0.01)
    assert verdict.obstructions(visible) == []
    assert obstruction_messages(random_cells(0.9) & random_cells(0.9, 2)) == []  # a loss of a tenth is usual


def test_fog_is_reported_with_the_visible_range():
    (reason,) = obstruction_messages(random_cells(0.9) & (RANGE_M < 1400))
    expected, remaining = 0.9 * RANGE_M.size, 0.9 * np.count_nonzero(RANGE_M < 1400)
    assert f"{remaining / expected:.0%} of the usually visible cells observed" in reason
    assert "none beyond 1400 m" in reason


def test_thin_fog_is_reported_without_a_visible_range():
    (reason,) = obstruction_messages(
        random_cells(0.9) & (np.random.default_rng(3).uniform(size=GRID.shape) < np.exp(-RANGE_M / 3000))
    )
    assert "fog" in reason
    assert "beyond" not in reason
    assert "sweep" not in reason


def test_a_partial_sweep_is_reported_with_its_azimuths():
    (reason,) = obstruction_messages(random_cells(0.9) & ~((AZIMUTH > 60) & (AZIMUTH < 85)))
    assert reason == "partial sweep: no points at azimuth 60-85 degrees"
    (reason,) = obstruction_messages(random_cells(0.9) & (AZIMUTH > 10) & ~((AZIMUTH > 40) & (AZIMUTH < 50)))
    assert reason == "partial sweep: no points at azimuth 40-50, 340-10 degrees"


def test_sectors_without_near_cells_are_no_partial_sweep_in_fog():
    """A sector with cells only beyond 2 km, and fog at 1 km."""
    far_only = (AZIMUTH > 20) & (AZIMUTH < 40) & (RANGE_M < 2000)
    surface = replace(reference(), visibility=np.where(far_only, 0, 0.9).astype(np.float32))
    (reason,) = verdict.obstructions(observe(random_cells(0.9) & ~far_only & (RANGE_M < 1000), surface))
    assert "none beyond 1000 m" in reason
    clear = observe(random_cells(0.9) & ~((AZIMUTH > 20) & (AZIMUTH < 40)), surface)
    assert verdict.obstructions(clear) == ["partial sweep: no points at azimuth 20-40 degrees"]


def test_near_ground_at_the_edge_of_the_view_may_be_hidden():
    """Two sectors with some 2 % of the cells of another within 400 m, behind a bank of snow."""
    edge = (AZIMUTH > 50) & (AZIMUTH < 60)
    surface = replace(reference(), visibility=np.where(edge & (RANGE_M > 400), 0, 0.9).astype(np.float32))
    assert verdict.obstructions(observe(random_cells(0.9) & ~edge, surface)) == []


def test_fog_and_a_partial_sweep_are_both_reported():
    sweep, fog = obstruction_messages(random_cells(0.9) & (RANGE_M < 1400) & (AZIMUTH < 60))
    assert "partial sweep" in sweep
    assert "none beyond 1400 m" in fog


def test_visibility_from_a_sample_of_cells_is_the_same(monkeypatch):
    observed = random_cells(0.9) & (RANGE_M < 1400)
    all_cells = observe(observed, reference())
    monkeypatch.setattr(
        "station.science.gridding.reference_cells.MAX_VISIBILITY_CELLS", GRID.nx * GRID.ny // 3
    )
    sampled = observe(observed, reference())
    assert sampled.share == pytest.approx(all_cells.share, rel=0.02)
    assert sampled.expected.sum() == pytest.approx(all_cells.expected.sum(), rel=0.02)


def test_cells_without_a_reference_elevation_are_not_expected():
    surface = reference()
    surface.elevation_m[RANGE_M > 2000] = np.nan
    visible = observe(random_cells(0.9) & (RANGE_M < 2000), surface)
    assert visible.expected.sum() == pytest.approx(0.9 * np.count_nonzero(RANGE_M <= 2000))
    assert verdict.obstructions(visible) == []


def measurement(change_m, sigma_m, observed, viewing):
    """Measurement of the cells of a viewing geometry, or of all cells without one."""
    cell = np.arange(GRID.nx * GRID.ny) if viewing is None else viewing.cells["cell"]
    cell_index = np.full(GRID.shape, -1, np.int32)
    cell_index.ravel()[cell] = np.arange(len(cell))
    cells = np.zeros(len(cell), CELL_DTYPE)
    cells["uncertainty_m"] = sigma_m
    count, observed_m = (
        observed.ravel()[cell].astype(np.int32),
        np.where(observed, change_m, np.nan).ravel()[cell],
    )
    return Measurement(GRID, cell_index, count, cells, observed_m, np.zeros(len(cell), np.uint8), {})


def reference_from_scans():
    """Reference surface built from scans, not from external data."""
    empty = SharedParameters((), (), np.empty(0), np.empty((0, 0)), np.empty(0))
    return replace(reference(), shared=empty)


STABLE = (RANGE_M < 500) & (X > 0)


def assess(
    change_m=0.0, sigma_m=0.1, observed=None, warnings=(), z_std=None, stable=STABLE, surface=None, air=0.0
):
    noise = np.random.default_rng(5).normal(0, 0.1, GRID.shape)
    viewing = compute_viewing_geometry(
        reference_from_scans() if surface is None else surface, stable, SCANNER, POSITION_M
    )
    result = measurement(
        noise + change_m, sigma_m, random_cells(0.9) if observed is None else observed, viewing
    )
    return verdict.assess("", warnings, result, viewing, None, z_std, airborne_echo_share=air)


def test_verdict_is_good_degraded_or_unusable():
    assert assess() == ("good", "")
    assert assess(warnings=["weather missing"]) == ("degraded", "weather missing")
    assert assess(observed=random_cells(0.9) & (RANGE_M < 1400))[0] == "degraded"
    grade, reason = assess(observed=random_cells(0.9) & (RANGE_M < 250), warnings=["weather missing"])
    assert grade == "unusable"
    assert reason.endswith("weather missing")  # the gravest reason comes first
    assert "fog" in reason


def test_a_misfit_within_sigma_is_not_unusable():
    """Stable ground off by a metre is within a sigma of 0.5 m, but not of 0.1 m."""
    assert assess(1.0, sigma_m=0.5)[0] == "good"
    grade, reason = assess(np.where(X > 100, 1.0, -1.0))
    assert grade == "unusable"
    assert "stable ground is off by 1 m, 15 sigma" in reason
    assert assess(1.0, surface=reference())[0] == "good"  # accuracy of an external surface is unknown
    assert assess(1.0, stable=NO_CELLS)[0] == "good"
    assert assess(1.0, z_std=1.0)[0] == "good"  # hold-out ground decides


def test_holdout_ground_may_scatter_by_three_sigma():
    assert assess(z_std=2.9)[0] == "good"
    grade, reason = assess(z_std=3.1)
    assert grade == "degraded"
    assert "scatters by 3.1 sigma" in reason


def test_unusually_many_echoes_of_the_air_are_reported():
    assert assess(air=0.001)[0] == "good"
    assert assess(air=0.0034) == (
        "degraded",
        "0.34% of the echoes are not from the ground: snow, rain or dust?",
    )
    result = measurement(0.0, 0.1, RANGE_M < 100, None)  # without a reference
    assert verdict.assess("", (), result, None, None, None, airborne_echo_share=0.0034)[0] == "good"


def test_missing_brightness_degrades_the_verdict():
    result = measurement(0.0, 0.1, RANGE_M < 100, None)
    no_brightness = "no brightness: snow on stable ground cannot be recognised"
    actual = verdict.assess("", ("a",), result, None, None, None, no_brightness=no_brightness)
    assert actual == ("degraded", f"a; {no_brightness}")
    first = verdict.assess("", (), result, None, None, None, no_brightness=no_brightness)
    assert first == ("good", no_brightness)  # else a station without brightness would never get a reference


def test_verdict_without_a_reference_depends_on_warnings_and_flags():
    result = measurement(0.0, 0.1, RANGE_M < 100, None)
    assert verdict.assess("", (), result, None, None, None) == ("good", "")
    assert verdict.assess("", ("a",), result, None, None, None) == ("degraded", "a")
    flagged = verdict.assess("spring cleaning", ("a",), result, None, None, None)
    assert flagged == ("unusable", "flagged: spring cleaning; a")


def test_a_reference_without_visibility_gives_no_obstructions():
    surface = Reference.from_elevation(GRID, "1", np.zeros(GRID.shape))
    assert assess(observed=RANGE_M < 100, surface=surface) == ("good", "")
