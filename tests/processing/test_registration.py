"""Registrations of the owner: their covariance, and what is warned of."""

from types import SimpleNamespace

import numpy as np
import pytest

from station.config import read_site
from station.errors import ConfigError
from station.processing.scans.registration import registration_difference
from station.processing.scans.scan_inputs import inputs_in_map_frame
from station.quantities import VarianceComponents

ORIGIN = '[map]\ncrs = "EPSG:32632"\norigin = { latitude_deg = 47.0, longitude_deg = 9.0, height_m = 5.0 }\n'
GIVEN = '[registration]\nuse = "{use}"\nsigma_m = 0.25\nsigma_deg = 0.001\n'


@pytest.fixture
def registered(write_site):
    def make(use="given", origin=ORIGIN):
        path = write_site(more=GIVEN.format(use=use))
        path.write_text(path.read_text().replace('[map]\ncrs = "EPSG:32632"\n', origin))
        return read_site(path)

    return make


def test_points_on_the_map_have_the_covariance_of_their_registration(registered):
    inputs = inputs_in_map_frame(registered(), 0.0)
    shared = inputs.log_only_shared(VarianceComponents())
    sigma = dict(zip(shared.names, np.sqrt(np.diag(shared.covariance)), strict=True))
    assert sigma["translation_up"] == pytest.approx(0.25)
    assert sigma["tilt_north"] == sigma["heading"] == pytest.approx(np.radians(0.001))
    assert inputs.is_given
    assert not inputs_in_map_frame(registered("start"), 0.0).is_given


def test_points_on_the_map_need_a_place_to_count_rotations_from(registered):
    with pytest.raises(ConfigError, match=r"registration needs map\.origin"):
        registered(origin='[map]\ncrs = "EPSG:32632"\n')


@pytest.mark.parametrize(
    ("use", "up_m", "is_reported"), [("given", 0.9, True), ("given", 0.7, False), ("start", 9.0, False)]
)
def test_a_given_registration_is_warned_of_beyond_three_sigma(registered, use, up_m, is_reported):
    """The own sigma is that of the registration: together 0.354 m, three times that is 1.06 m."""
    estimate = np.array([0, 0, 0, 0, 0, up_m * 1.25, 0, 0])
    adjustment = SimpleNamespace(estimate=estimate, covariance=np.eye(8) * 0.25**2)
    scalars, warnings = registration_difference(registered(use), SimpleNamespace(matrices=[]), adjustment)
    assert scalars["registration_translation"] == pytest.approx(up_m * 1.25)
    assert scalars["registration_rotation"] == 0.0
    assert bool(warnings) == is_reported
