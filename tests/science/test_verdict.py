"""Verdicts: what hides the view, what makes an epoch unusable."""

from dataclasses import replace

import numpy as np
import pytest

from station.quantities import MEASURED, Grid, Measurement, Reference, Scanner
from station.science import verdict
from station.science.outlook import look

GRID = Grid(-100.0, 3000.0, 10.0, 300, 300)  # north-east of the scanner, from its south-west corner on
HERE = (0.0, 0.0, 100.0)
X, Y = np.meshgrid(GRID.x_m, GRID.y_m)
AWAY = np.hypot(X, Y)
AZIMUTH = np.degrees(np.arctan2(X, Y))
SCANNER = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)
NOWHERE = np.zeros(GRID.shape, bool)


def reference(seen=0.9):
    flat = Reference.given(GRID, "1", np.zeros(GRID.shape))
    return replace(flat, seen=np.full(GRID.shape, seen, np.float32))


def view(seen, known):
    outlook = look(known, NOWHERE, SCANNER, HERE)
    return verdict.view(seen.astype(np.int32).ravel()[outlook.cells["cell"]], outlook)


def told(seen):
    return verdict.hidden(view(seen, reference()))


def chance(share, seed=1):
    return np.random.default_rng(seed).uniform(size=GRID.shape) < share


def test_the_usual_view_hides_nothing():
    found = view(chance(0.9), reference())
    assert found.share == pytest.approx(1.0, abs=0.01)
    assert verdict.hidden(found) == []
    assert told(chance(0.9) & chance(0.9, 2)) == []  # a tenth fewer is weather


def test_fog_is_told_with_how_far_one_sees():
    (reason,) = told(chance(0.9) & (AWAY < 1400))
    usual, left = 0.9 * AWAY.size, 0.9 * np.count_nonzero(AWAY < 1400)
    assert f"sees {left / usual:.0%} of what scans usually see" in reason
    assert "nothing beyond 1400 m" in reason


def test_thin_fog_leaves_less_the_farther_one_looks():
    (reason,) = told(chance(0.9) & (np.random.default_rng(3).uniform(size=GRID.shape) < np.exp(-AWAY / 3000)))
    assert "fog" in reason
    assert "beyond" not in reason
    assert "sweep" not in reason


def test_a_sweep_cut_short_is_told_by_its_azimuths():
    (reason,) = told(chance(0.9) & ~((AZIMUTH > 60) & (AZIMUTH < 85)))
    assert reason == "partial sweep: nothing seen at azimuth 60-85 degree"
    (reason,) = told(chance(0.9) & (AZIMUTH > 10) & ~((AZIMUTH > 40) & (AZIMUTH < 50)))
    assert reason == "partial sweep: nothing seen at azimuth 40-50, 340-10 degree"


def test_fog_hides_sectors_that_begin_far_away_without_a_partial_sweep():
    """Nothing nearer than 2 km in a sector, and fog at 1 km: no sweep is to blame."""
    far_only = (AZIMUTH > 20) & (AZIMUTH < 40) & (AWAY < 2000)
    known = replace(reference(), seen=np.where(far_only, 0, 0.9).astype(np.float32))
    found = view(chance(0.9) & ~far_only & (AWAY < 1000), known)
    (reason,) = verdict.hidden(found)
    assert "nothing beyond 1000 m" in reason
    clear = view(chance(0.9) & ~((AZIMUTH > 20) & (AZIMUTH < 40)), known)
    assert verdict.hidden(clear) == ["partial sweep: nothing seen at azimuth 20-40 degree"]


def test_fog_and_a_partial_sweep_together():
    sweep, fog = told(chance(0.9) & (AWAY < 1400) & (AZIMUTH < 60))
    assert "partial sweep" in sweep
    assert "nothing beyond 1400 m" in fog


def test_a_part_of_a_vast_grid_tells_the_same(monkeypatch):
    seen = chance(0.9) & (AWAY < 1400)
    whole = view(seen, reference())
    monkeypatch.setattr("station.science.outlook.COUNTED_MOST", GRID.nx * GRID.ny // 3)
    part = view(seen, reference())
    assert part.share == pytest.approx(whole.share, rel=0.02)
    assert part.usual.sum() == pytest.approx(whole.usual.sum(), rel=0.02)


def test_cells_that_later_scans_saw_but_the_surface_lacks_do_not_count():
    known = reference()
    known.elevation_m[AWAY > 2000] = np.nan
    found = view(chance(0.9) & (AWAY < 2000), known)
    assert found.usual.sum() == pytest.approx(0.9 * np.count_nonzero(AWAY <= 2000))
    assert verdict.hidden(found) == []


def measured(change_m, sigma_m, seen, outlook):
    """What a scan says of the cells of an outlook, or, without one, of all."""
    cell = np.arange(GRID.nx * GRID.ny) if outlook is None else outlook.cells["cell"]
    number = np.full(GRID.shape, -1, np.int32)
    number.ravel()[cell] = np.arange(len(cell))
    cells = np.zeros(len(cell), MEASURED)
    cells["uncertainty_m"] = sigma_m
    count, there_m = seen.ravel()[cell].astype(np.int32), np.where(seen, change_m, np.nan).ravel()[cell]
    return Measurement(GRID, number, count, cells, there_m, np.zeros(len(cell), np.uint8), {})


def of_scans():
    """A reference from scans, not from outside."""
    from station.quantities import Shared

    none = Shared((), (), np.empty(0), np.empty((0, 0)), np.empty(0))
    return replace(reference(), shared=none)


STABLE = (AWAY < 500) & (X > 0)


def judged(change_m=0.0, sigma_m=0.1, seen=None, lacking=(), z=None, stable=STABLE, known=None):
    noise = np.random.default_rng(5).normal(0, 0.1, GRID.shape)
    outlook = look(of_scans() if known is None else known, stable, SCANNER, HERE)
    told = measured(noise + change_m, sigma_m, chance(0.9) if seen is None else seen, outlook)
    return verdict.judge("", lacking, told, outlook, None, z)


def test_good_degraded_and_unusable():
    assert judged() == ("good", "")
    assert judged(lacking=["weather missing"]) == ("degraded", "weather missing")
    assert judged(seen=chance(0.9) & (AWAY < 1400))[0] == "degraded"
    word, reason = judged(seen=chance(0.9) & (AWAY < 250), lacking=["weather missing"])
    assert word == "unusable"
    assert reason.endswith("weather missing")  # the gravest first
    assert "fog" in reason


def test_what_sigma_holds_is_not_unusable():
    """Stable ground a metre off: with a sigma of 0.5 m that may be, with 0.1 m it may not."""
    assert judged(1.0, sigma_m=0.5)[0] == "good"
    word, reason = judged(np.where(X > 100, 1.0, -1.0))
    assert word == "unusable"
    assert "stable ground is 1 m off, 15 sigma" in reason
    assert judged(1.0, known=reference())[0] == "good"  # an outside surface: nobody knows how good
    assert judged(1.0, stable=NOWHERE)[0] == "good"
    assert judged(1.0, z=1.0)[0] == "good"  # told by what no fit has seen


def test_ground_no_fit_has_seen_may_scatter_by_three_sigma():
    assert judged(z=2.9)[0] == "good"
    word, reason = judged(z=3.1)
    assert word == "degraded"
    assert "scatters by 3.1 sigma" in reason


def test_without_a_reference_only_what_was_lacking_counts():
    told = measured(0.0, 0.1, AWAY < 100, None)
    assert verdict.judge("", (), told, None, None, None) == ("good", "")
    assert verdict.judge("", ("a",), told, None, None, None) == ("degraded", "a")
    flagged = verdict.judge("spring cleaning", ("a",), told, None, None, None)
    assert flagged == ("unusable", "flagged: spring cleaning; a")


def test_a_reference_that_does_not_know_the_usual_view_misses_nothing():
    known = Reference.given(GRID, "1", np.zeros(GRID.shape))
    assert judged(seen=AWAY < 100, known=known) == ("good", "")
