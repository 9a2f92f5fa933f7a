"""`station score`: what it computes, against arithmetic by hand, and the page of a small archive."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from support import tiny_station
from typer.testing import CliRunner

from station.cli import app
from station.operations.reports.score import _reasons, gain_by_scale
from station.quantities import Grid

GRID = Grid(west_m=0.0, north_m=40.0, cell_m=5.0, nx=8, ny=8)


def test_gain_is_that_of_the_cells_common_to_both():
    """Two cells of one block of 10 m and one of another: by hand."""
    own = {"a": (np.array([0, 1, 20]), np.array([0.01, 0.03, -0.02])), "b": (np.array([5]), np.array([9.0]))}
    other = {
        "a": (np.array([1, 20, 30]), np.array([0.06, -0.04, 7.0])),
        "c": (np.array([5]), np.array([9.0])),
    }
    table = {row["scale"]: row for row in gain_by_scale(own, other, GRID)}
    assert table["cell"]["values"] == 2
    assert table["cell"]["own_m"] == pytest.approx(0.025 / 0.67449, rel=1e-4)  # of a normal distribution
    assert table["cell"]["gain"] == pytest.approx(2.0)
    assert table["10 m"]["values"] == 2
    assert table["all"]["own_m"] == pytest.approx(0.005 / 0.67449, rel=1e-4)
    assert table["all"]["other_m"] == pytest.approx(0.01 / 0.67449, rel=1e-4)


def test_blocks_are_means():
    own = {"a": (np.array([0, 1]), np.array([0.03, -0.01]))}
    other = {"a": (np.array([0, 1]), np.array([0.05, 0.03]))}
    table = {row["scale"]: row for row in gain_by_scale(own, other, GRID)}
    assert table["10 m"]["own_m"] == pytest.approx(0.01 / 0.67449, rel=1e-4)
    assert table["10 m"]["gain"] == pytest.approx(4.0)


def test_reasons_are_counted_without_figures_and_folders():
    reasons = ["0.46% of the echoes", "2% of the echoes", "", "/srv/tls/a1.txt: log −3.2 s late"]
    assert _reasons([SimpleNamespace(reason=reason) for reason in reasons]) == {
        "…% of the echoes": 2, "a….txt: log … s late": 1,
    }  # fmt: skip


def listing(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.integration
def test_an_archive_is_scored_and_not_touched(tmp_path):
    archive, out = tiny_station.build(tmp_path / "archive", method="joint", hours=3), tmp_path / "out"
    (archive / "inbox").rmdir()
    (archive / tiny_station.PENDING).rename(archive / "inbox")
    before = listing(archive)
    result = CliRunner().invoke(app, ["score", str(archive), "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    assert listing(archive) == before
    score = json.loads((out / "score.json").read_text(encoding="utf-8"))
    assert sum(score["scans"].values()) == 3
    assert score["registration"] == "SOP and log"
    assert score["after_reference"] == 1
    assert {"cell", "all"} <= {row["scale"] for row in score["gain"]}  # unadjusted scans have it, too
    assert 0.1 < score["cpu_s_per_scan"] < 60
    page = (out / "score.html").read_text(encoding="utf-8")
    assert str(tmp_path) not in page
    assert "://" not in page  # it loads nothing
    assert "What the adjustment gains" in page


def test_an_archive_without_scans_says_where_they_are_expected(tmp_path):
    archive = tiny_station.build(tmp_path / "archive", hours=1)
    result = CliRunner().invoke(app, ["score", str(archive), "--out", str(tmp_path / "out")])
    assert "no scan in it" in str(result.exception)
    assert "scans.inbox" in str(result.exception)
