"""Numbers of the papers: each is computed, each deviation explained, and `station papers` prints them all."""

import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from station.cli import app
from station.papers import hartzell, pages
from station.papers.errata import ERRATA, NOT_REPRODUCIBLE, PAPERS
from station.papers.hartzell import HARTZELL_NUMBERS
from station.papers.pages import PAPER_NUMBERS
from station.papers.voordendag import BOXES

MAX_UNEXPLAINED = 0.02  # deviation of a printed value that needs no note


@pytest.mark.parametrize("number", PAPER_NUMBERS, ids=lambda number: f"{number.paper}: {number.what}")
def test_computed_value_matches_the_expected_one(number):
    assert number.computed() == pytest.approx(number.expected, rel=0, abs=number.tolerance)


def test_tolerances_are_tight():
    """Two percent, and 15 % of simulated values, for numbers other than zero."""
    for number in PAPER_NUMBERS:
        if number.is_check and number.expected != 0.0:
            simulated = "Sobol" in number.what or number.equation == "Eq. 11"
            limit = 0.15 if simulated else 0.02
            assert number.tolerance <= limit * abs(number.expected), number.what


def test_printed_values_that_deviate_by_more_than_two_percent_have_a_note():
    for number in PAPER_NUMBERS:
        if number.printed is not None and number.is_check:
            deviation = abs(number.printed - number.expected)
            assert number.note or deviation <= MAX_UNEXPLAINED * abs(number.expected), number.what


def test_rows_that_cannot_disagree_are_counted_separately():
    checks = [pages.Check(number, number.expected) for number in PAPER_NUMBERS]
    comparable = sum(number.is_check for number in PAPER_NUMBERS)
    assert 0 < comparable < len(PAPER_NUMBERS)
    text = pages.format_table(checks)
    assert f"{comparable} of {comparable} numbers within tolerance" in text
    assert f"{len(PAPER_NUMBERS) - comparable} further rows (-) cannot disagree" in text
    assert max(map(len, text.splitlines())) < 130


def test_major_axes_of_the_boxes_agree_with_the_column_of_table_2():
    """18 of the 20 boxes of Voordendag et al. (2023) within 15 %: all but 4 and 20."""
    ratio = {box: printed / axis_m for box, (_, _, printed, axis_m) in BOXES.items()}
    assert len(ratio) == 20
    assert [box for box, value in ratio.items() if abs(value - 1) > 0.15] == [4, 20]
    assert np.mean([value for value in ratio.values() if abs(value - 1) < 0.15]) == pytest.approx(
        1, abs=0.035
    )


def test_simulated_registration_has_the_errors_of_the_paper():
    """Hartzell et al. (2015), section 2.2: rotations of 0.003-0.006°, shifts of 1-3 cm."""
    rotation_rad, shift_m = np.split(np.sqrt(np.diag(hartzell._registration().covariance)), 2)
    assert (np.degrees(rotation_rad) < 0.006).all()
    assert (shift_m > 0.005).all()
    assert (shift_m < 0.03).all()


def test_functions_named_in_errata_exist():
    modules = {module.__name__.rpartition(".")[2]: module for module in pages.science_modules()}
    assert len(modules) > 30
    for erratum in ERRATA:
        for module, name in re.findall(r"`(\w+)\.(\w+)`", erratum.built):
            assert hasattr(modules[module], name), erratum


@pytest.mark.integration
def test_pages_contain_every_number_erratum_and_function(tmp_path):
    result = CliRunner().invoke(app, ["papers", "--pages", str(tmp_path / "papers")])
    assert result.exit_code == 0, result.output
    for paper in PAPERS:
        text = (tmp_path / "papers" / f"{paper.key}.md").read_text(encoding="utf-8")
        for number in PAPER_NUMBERS:
            assert (f"| {number.what} |" in text) == (number.paper == paper.key)
        for erratum in ERRATA:
            assert (f"| {erratum.wrong} |" in text) == (erratum.paper == paper.key)
        assert NOT_REPRODUCIBLE[paper.key] in text
    functions = re.findall(
        r"^\| `(\w+)\.([\w.]+)` \|", text_of_functions(tmp_path, "voordendag2023"), re.MULTILINE
    )
    assert ("shot_noise", "sigma_instrument") in functions
    assert len(functions) > 10
    assert "geocentric_point" in text_of_functions(tmp_path, "leslar2014")


def text_of_functions(tmp_path, paper):
    text = (tmp_path / "papers" / f"{paper}.md").read_text(encoding="utf-8")
    return text.partition("## Functions for its equations")[2]


def test_a_wrong_number_fails_the_command(monkeypatch):
    wrong = replace(HARTZELL_NUMBERS[1], expected=0.1)
    monkeypatch.setattr(pages, "PAPER_NUMBERS", (wrong,))
    result = CliRunner().invoke(app, ["papers", "hartzell2015"])
    assert result.exit_code == 1
    assert result.output.splitlines()[2].startswith("NO Table 1")
    assert "**not reproduced**" in pages.format_page(PAPERS[0], pages.run_checks())
    unknown = CliRunner().invoke(app, ["papers", "hartzel"])
    assert unknown.exit_code == 2
    assert "hartzell2015" in unknown.output
