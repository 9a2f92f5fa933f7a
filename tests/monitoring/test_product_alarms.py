"""Alarms on products: beyond a level by more than the interval, in several scans in a row."""

import numpy as np
import pytest
from support.products import write_melt

from station.config import read_site
from station.errors import ConfigError
from station.monitoring.product_alarms import product_alarms
from station.sections.results import ProductAlarm

PRODUCT = """
[[product]]
name = "Ice melt"
kind = "melt"
at = [5, 5]
density_kg_m3 = 900
"""


@pytest.fixture
def alarms(write_site):
    """Return a function that writes melt with σ of 0.1 m and returns the alarms above 1 m."""
    site = read_site(write_site(more=PRODUCT))

    def alarms(values, *, verdicts=None, assessed_until=None, **rule):
        write_melt(site, 3600.0 * np.arange(len(values)), values, verdicts)
        settings = {"product": "Ice melt", "quantity": "melt", **({"above": 1.0} | rule)}
        return list(product_alarms(site, ProductAlarm.model_validate(settings), assessed_until))

    return alarms


def test_two_scans_beyond_level_and_interval_raise_an_alarm(alarms):
    (alarm,) = alarms([0.2, 1.3, 1.4])
    assert alarm.text == (
        "Ice melt, stake: melt is 1.4 m (± 0.2 m at 95 %), above 1 m, at 1970-01-01 02:00 UTC"
    )
    assert alarm.key == "product ice_melt stake melt"


@pytest.mark.parametrize("values", [[0.2, 0.3, 1.4], [0.2, 1.15, 1.15], [1.3, 1.3, 0.2], [1.3, np.nan]])
def test_one_scan_or_less_than_the_interval_or_the_past_raises_none(alarms, values):
    assert not alarms(values)


def test_scans_not_assessed_yet_and_those_that_may_not_be_used(alarms):
    assert len(alarms([1.3, 1.3, 0.2], assessed_until=0.0)) == 1
    assert not alarms([1.3, 1.3, 0.2], assessed_until=3600.0)
    assert len(alarms([1.3, 0.0, 1.3], verdicts=[0, 2, 0])) == 1
    assert len(alarms([1.3], scans=1)) == 1
    assert len(alarms([-1.3, -1.3], above=None, below=-1.0)) == 1


def test_a_quantity_that_the_product_lacks_is_named(alarms):
    with pytest.raises(ConfigError, match="Ice melt has no depth; it has melt"):
        alarms([1.0], quantity="depth")
