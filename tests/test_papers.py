"""The numbers of the papers: the table that `station papers` prints is the one that is tested."""

import importlib
import re
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from station.cli import app
from station.papers import pages
from station.papers.errata import ERRATA, NOT_REPRODUCIBLE, PAPERS
from station.papers.figures import FIGURES, HARTZELL_FIGURES


@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: f"{figure.paper}: {figure.what}")
def test_figure(figure):
    assert figure.told() == pytest.approx(figure.right, abs=figure.tolerance)


def test_a_printed_number_is_right_or_its_error_is_told():
    for figure in FIGURES:
        if figure.printed is not None and abs(figure.printed - figure.right) > 0.15 * abs(figure.right):
            assert figure.error, figure.what


def test_what_errata_name_exists():
    for erratum in ERRATA:
        for module, name in re.findall(r"`(\w+)\.(\w+)`", erratum.built):
            assert hasattr(importlib.import_module(f"station.science.{module}"), name), erratum


def test_pages_hold_every_number_every_error_and_every_home(tmp_path):
    done = CliRunner().invoke(app, ["papers", "--pages", str(tmp_path / "papers")])
    assert done.exit_code == 0, done.output
    assert f"{len(FIGURES)} of {len(FIGURES)} right" in done.output
    for paper in PAPERS:
        text = (tmp_path / "papers" / f"{paper.key}.md").read_text(encoding="utf-8")
        for figure in FIGURES:
            assert (f"| {figure.what} |" in text) == (figure.paper == paper.key)
        for erratum in ERRATA:
            assert (f"| {erratum.wrong} |" in text) == (erratum.paper == paper.key)
        assert NOT_REPRODUCIBLE[paper.key] in text
    voordendag = (tmp_path / "papers" / "voordendag2023.md").read_text(encoding="utf-8")
    assert (
        "| `uncertainty.sigma_instrument` | Height uncertainty from the lean that stays unknown [m] | Eq. 5 |"
        in (voordendag)
    )


def test_a_wrong_number_is_seen_and_fails_the_command(monkeypatch):
    wrong = replace(HARTZELL_FIGURES[1], right=0.1)
    monkeypatch.setattr(pages, "FIGURES", (wrong,))
    done = CliRunner().invoke(app, ["papers", "hartzell2015"])
    assert done.exit_code == 1
    assert done.output.splitlines()[1].startswith("NO hartzell2015")
    assert "**not reproduced**" in pages.page(PAPERS[0], pages.results())
    other = CliRunner().invoke(app, ["papers", "hartzel"])
    assert other.exit_code == 2
    assert "hartzell2015" in other.output
