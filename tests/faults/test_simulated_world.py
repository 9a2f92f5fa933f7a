"""Years of faults in a simulated world: good scans are stored once, with the values of an undisturbed one."""

from __future__ import annotations

import pytest
import simulated_world
from support.effort import SHARE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def undisturbed(template, tmp_path_factory):
    world = simulated_world.make_world(tmp_path_factory.mktemp("world") / "undisturbed", template, 0)
    world.run()
    assert len(world.rows()) == simulated_world.SCANS_PER_YEAR
    assert (world.starts, world.faults) == (1, 0)
    return world


@pytest.mark.parametrize("seed", range(10 // SHARE))
def test_a_year_of_faults_changes_no_value(template, undisturbed, tmp_path, seed):
    """Replay: `python tests/faults/simulated_world.py --seed SEED --years 1 --log`."""
    world = simulated_world.make_world(tmp_path / "world", template, seed)
    world.plan_faults()
    world.run()
    assert world.faults == 2 * (simulated_world.SCANS_PER_YEAR - 1)
    assert world.deaths > 0
    assert world.defects(undisturbed) == []
