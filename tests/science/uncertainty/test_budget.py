"""Error budget of a scan by its five terms, and the published budget of one point."""

import math
from dataclasses import replace

import numpy as np
import pytest

from station.papers.voordendag import BOX_5
from station.quantities import Grid, Scanner, SharedParameters
from station.science.geometry.observation import Observation
from station.science.uncertainty import budget, parameters
from station.science.uncertainty.jacobian import height_jacobian

POSITION_M = (0.0, 0.0, 0.0)
GRID = Grid(west_m=2000.0, north_m=2000.0, cell_m=10.0, nx=100, ny=100)
PARAMS = parameters.parameter_layout(GRID, POSITION_M)
VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)


def observed_cell():
    """Return a cell 3421 m away at the height of the scanner: 65° incidence, slope of 25° facing it."""
    slope = math.tan(math.radians(25.0))
    return Observation.from_points((np.array([2420.0]), np.array([2418.0]), np.array([0.0])), POSITION_M,
                   *(np.array([slope * math.sqrt(0.5)]),) * 2)  # fmt: skip


def terms(prefix=None, sigma=0.0, count=4.0, sampling_m2=0.0):
    posterior = SharedParameters(
        PARAMS.names, PARAMS.units, *(np.zeros((len(PARAMS.names),) * n) for n in (1, 2, 1))
    )
    if prefix is not None:
        selected = np.array([name.startswith(prefix) for name in PARAMS.names])
        posterior = replace(posterior, covariance=sigma**2 * np.diag(selected.astype(float)))
    observation = observed_cell()
    jacobian = height_jacobian(
        PARAMS, observation.offset_m, observation.east_gradient, observation.north_gradient
    )
    budget_m = budget.error_budget(
        observation, np.array([count]), np.array([sampling_m2]), jacobian, posterior, VZ6000
    )
    return {term: float(values[0]) for term, values in budget_m.items()}, observation, jacobian


@pytest.mark.parametrize(
    ("term", "parameter", "sigma"),
    [
        ("sigma_registration", "translation_up", 0.02), ("sigma_registration", "heading", 1e-4),
        ("sigma_instrument", "tilt_east", 1e-4), ("sigma_instrument", "range_bias", 0.05),
        ("sigma_atmosphere", "range_scale", 10.0), ("sigma_atmosphere", "refraction", 0.1),
    ],
)  # fmt: skip
def test_each_shared_parameter_belongs_to_one_term_only(term, parameter, sigma):
    without, _, _ = terms()
    actual, _, jacobian = terms(parameter, sigma)
    others = set(budget.TERMS) - {term}
    assert {name: actual[name] for name in others} == {name: without[name] for name in others}
    names = [name for name, _ in parameters.GLOBAL]
    if parameter in names and parameter != "refraction":
        effect = abs(jacobian.pose[names.index(parameter), 0]) * sigma
        assert actual[term] ** 2 - without[term] ** 2 == pytest.approx(effect**2, rel=1e-6)
    assert actual[term] > without[term]


def test_prefixes_assign_every_parameter_to_one_term():
    for name in PARAMS.names:
        assert sum(name.startswith(prefixes) for prefixes in budget.SHARED.values()) == 1, name


def test_raster_term_is_the_sampling_error_and_geometry_averages_out():
    actual, observation, _ = terms(sampling_m2=0.04)
    assert actual["sigma_raster"] == pytest.approx(0.2)
    single, _, _ = terms(count=1.0)
    assert actual["sigma_geometry"] == pytest.approx(single["sigma_geometry"] / 2)
    assert observation.range_m[0] == pytest.approx(BOX_5[0], abs=0.5)


def test_published_budget_of_a_point_by_term():
    """Voordendag et al. (2023), Eq. 5, 12 and 18 at 3421 m, 65°, slope 25°; Eq. 2 of nine points."""
    observation = observed_cell()
    actual = budget.terms_voordendag(observation, np.array([9.0]), VZ6000, 0.02)
    assert set(actual) == set(budget.TERMS)
    assert np.degrees(np.arccos(observation.cos_incidence)) == pytest.approx([BOX_5[1]], abs=0.01)
    assert actual["sigma_instrument"] == pytest.approx([0.4777], abs=2e-4)
    assert actual["sigma_geometry"] == pytest.approx([0.137], abs=1e-3)
    assert actual["sigma_atmosphere"] == pytest.approx([0.01])
    assert actual["sigma_registration"] == pytest.approx([0.02])
    point_m = math.sqrt(0.4777**2 + 0.137**2 + 0.01**2)
    assert actual["sigma_raster"] == pytest.approx([point_m / 3], abs=1e-3)
