"""The uncertainty budget by effect, against dense algebra."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.shared_parameters import SCANNER, random_shared

from station.operations.reports.uncertainty_budget import EFFECTS, budget_of, format_budget, write_budget
from station.quantities import Grid
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import parameter_layout

GRID = Grid(west_m=630_000.0, north_m=5_186_000.0, cell_m=50.0, nx=12, ny=8)


@pytest.fixture(scope="module")
def shares():
    """Return what the budget takes of an epoch: a tilted plane seen from the scanner, some cells unknown."""
    east, north, height, axis_east, axis_north = SCANNER.values()
    axis = axis_east, axis_north, np.sqrt(1 - axis_east**2 - axis_north**2)
    rng = np.random.default_rng(3)
    cells = rng.random(GRID.shape) > 0.2
    row, column = np.nonzero(cells)
    count = len(row)
    offset_m = GRID.x_m[column] - east, GRID.y_m[row] - north, rng.normal(-400.0, 40.0, count)
    params = parameter_layout(GRID, (east, north, height), axis)
    jacobian = height_jacobian(params, offset_m, *rng.normal(0.1, 0.1, (2, count)))
    return SimpleNamespace(
        cells=cells,
        jacobian=jacobian,
        shared=random_shared(5, GRID),
        random_m2=rng.uniform(1e-5, 1e-3, count),
    )


@pytest.fixture(scope="module")
def budget(shares):
    area = np.zeros(GRID.shape, bool)
    area[2:6, 3:9] = True
    return area, budget_of(shares, area) | {"station": "x", "epoch": "x.nc", "area": "slope"}


def test_combined_uncertainty_and_contributions_are_those_of_dense_algebra(shares, budget):
    area, result = budget
    inside = area[shares.cells]
    weights = inside / inside.sum()
    dense = shares.jacobian.to_sparse().toarray()
    assert result["cells"] == inside.sum()
    known = {row["effect"]: row for row in result["rows"]}
    for effect in EFFECTS[1:]:  # the tilt of the lines is not in J C Jᵀ
        index = [n for n, name in enumerate(shares.shared.names) if name.startswith(effect.prefixes)]
        gradient = weights @ dense[:, index]
        covariance = shares.shared.covariance[np.ix_(index, index)]
        expected_m = np.sqrt(gradient @ covariance @ gradient)
        assert known[effect.name]["contribution_m"] == pytest.approx(expected_m, rel=1e-6)
        assert known[effect.name]["uncertainty"] == pytest.approx(np.sqrt(np.trace(covariance) / len(index)))
    random = known["random: range, beam, roughness"]
    assert random["contribution_m"] == pytest.approx(np.sqrt(np.sum(weights**2 * shares.random_m2)))
    assert random["sensitivity"] == pytest.approx(1 / np.sqrt(inside.sum()), rel=0.3)  # of like cells


def test_every_parameter_belongs_to_one_effect(shares):
    for name in shares.shared.names:
        assert sum(name.startswith(effect.prefixes) for effect in EFFECTS) == 1, name


def test_shares_with_those_of_correlations_add_up(budget):
    _, result = budget
    total = sum(row["share"] for row in result["rows"]) + result["correlations_share"]
    assert total == pytest.approx(1.0)
    assert abs(result["correlations_share"]) > 1e-3


def test_page_and_text_name_the_effects_and_the_result(budget, tmp_path):
    _, result = budget
    write_budget(result, tmp_path / "budget.html")
    page = (tmp_path / "budget.html").read_text(encoding="utf-8")
    text = format_budget(result)
    for row in result["rows"]:
        assert row["effect"] in text
        assert row["effect"] in page
        assert f"{1000 * row['contribution_m']:.2f}" in page
    assert f"{result['sigma_m']:.5f}   100%" in text
    assert f"u = {result['sigma_m']:.4f} m" in page
    assert "<script" not in page
