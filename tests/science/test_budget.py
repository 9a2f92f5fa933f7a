"""The five sources of a scan's budget, each alone, and the published budget of one point."""

import math
from dataclasses import replace

import numpy as np
import pytest

from station.papers.figures import BOX_5
from station.quantities import Grid, Scanner, Shared
from station.science import budget, shared
from station.science.view import View

POSITION_M = (0.0, 0.0, 0.0)
GRID = Grid(west_m=2000.0, north_m=2000.0, cell_m=10.0, nx=100, ny=100)
OF = shared.basis(GRID, POSITION_M)
VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)


def seen():
    """A cell 3421 m away at 65° incidence on a slope of 25° that faces the scanner, seen level."""
    slope = math.tan(math.radians(25.0))
    return View.of((np.array([2420.0]), np.array([2418.0]), np.array([0.0])), POSITION_M,
                   *(np.array([slope * math.sqrt(0.5)]),) * 2)  # fmt: skip


def terms(name=None, sigma=0.0, count=4.0, sampling_m2=0.0):
    unknown = Shared(OF.names, OF.units, *(np.zeros((len(OF.names),) * n) for n in (1, 2, 1)))
    if name is not None:
        at = np.array([one.startswith(name) for one in OF.names])
        unknown = replace(unknown, covariance=sigma**2 * np.diag(at.astype(float)))
    view = seen()
    felt = shared.sensitivities(OF, view.offset_m, view.east_gradient, view.north_gradient)
    told = budget.terms(view, np.array([count]), np.array([sampling_m2]), felt, unknown, VZ6000)
    return {term: float(values[0]) for term, values in told.items()}, view, felt


@pytest.mark.parametrize(
    ("source", "parameter", "sigma"),
    [
        ("sigma_registration", "translation_up", 0.02), ("sigma_registration", "heading", 1e-4),
        ("sigma_instrument", "tilt_east", 1e-4), ("sigma_instrument", "range_bias", 0.05),
        ("sigma_atmosphere", "range_scale", 10.0), ("sigma_atmosphere", "refraction", 0.1),
    ],
)  # fmt: skip
def test_each_shared_parameter_is_in_its_source_alone(source, parameter, sigma):
    quiet, _, _ = terms()
    told, _, felt = terms(parameter, sigma)
    others = set(budget.TERMS) - {source}
    assert {name: told[name] for name in others} == {name: quiet[name] for name in others}
    names = [name for name, _ in shared.GLOBAL]
    if parameter in names and parameter != "refraction":
        alone = abs(felt.globals_[names.index(parameter), 0]) * sigma
        assert told[source] ** 2 - quiet[source] ** 2 == pytest.approx(alone**2, rel=1e-6)
    assert told[source] > quiet[source]


def test_every_shared_parameter_is_in_one_source():
    for name in OF.names:
        assert sum(name.startswith(begins) for begins in budget.SHARED.values()) == 1, name


def test_raster_is_what_points_of_a_slope_miss_of_it():
    told, view, _ = terms(sampling_m2=0.04)
    assert told["sigma_raster"] == pytest.approx(0.2)
    single, _, _ = terms(count=1.0)
    assert told["sigma_geometry"] == pytest.approx(single["sigma_geometry"] / 2)
    assert view.range_m[0] == pytest.approx(BOX_5[0], abs=0.5)


def test_published_budget_of_a_point_by_its_sources():
    """Voordendag et al. (2023), Eq. 5, 12 and 18 at 3421 m, 65°, slope 25°; Eq. 2 of nine points."""
    view = seen()
    told = budget.terms_voordendag(view, np.array([9.0]), VZ6000, 0.02)
    assert set(told) == set(budget.TERMS)
    assert np.degrees(np.arccos(view.cos_incidence)) == pytest.approx([BOX_5[1]], abs=0.01)
    assert told["sigma_instrument"] == pytest.approx([0.4777], abs=2e-4)
    assert told["sigma_geometry"] == pytest.approx([0.137], abs=1e-3)
    assert told["sigma_atmosphere"] == pytest.approx([0.01])
    assert told["sigma_registration"] == pytest.approx([0.02])
    point_m = math.sqrt(0.4777**2 + 0.137**2 + 0.01**2)
    assert told["sigma_raster"] == pytest.approx([point_m / 3], abs=1e-3)
