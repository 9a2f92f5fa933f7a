"""What an attack on an earlier version found is found again in simulated worlds without its remedy."""

from __future__ import annotations

import json
import math

import pytest
import simulated_machine
import simulated_world
from simulated_world import SCANS_PER_BURST

from station.archive import tilt_offsets
from station.archive.series import manifest
from station.inbox import journal, lock
from station.processing import integrity, scan_tasks, usable_inputs
from station.processing.workers import isolation
from station.service import worker

pytestmark = pytest.mark.slow


def _set_aside_for_good(self, name, reason, judged_under):  # noqa: ARG001
    self.set_aside(name, reason)


def _read_unchecked(path):
    return json.loads(path.read_text())["content"] if path.is_file() else None


SEEDS = (2, 0, 1)  # of worlds; the first shows most findings
OPTIONAL_INPUTS = ("areas_broken",)  # of which no fault may stop the service
REMEDIES = {  # by number of the finding: faults that show it, and what takes the remedy out
    "B1 a fork server without its socket is kept for ever": (
        ("socket_deleted",),
        [
            (simulated_machine.Machine, "stop", lambda _: None),
            (isolation.TaskRunner, "seconds_without_worker", lambda _: 0.0),
        ],
    ),
    "B2 a damaged series.nc blocks all": (
        ("series_damaged",),
        [(manifest, "matches_fingerprint", lambda *_: True)],
    ),
    "B3 scans are set aside for faults of the machine": (
        ("no_memory",),
        [
            (journal.Journal, "record_failure", _set_aside_for_good),
            (journal.Journal, "judged_otherwise", lambda *_: []),
        ],
    ),
    "S1 touched scans change the reference": (
        ("scan_touched",),
        [(journal.Journal, "unsettled", lambda *_, **__: {})],
    ),
    "S2 waiting for a process that hangs feeds the watchdog": (
        ("child_hangs",),
        [
            (simulated_machine._Process, "cpu_ticks", lambda process: process._machine.monotonic_s()),
            (worker, "MAX_STORE_TASK_S", math.inf),
        ],
    ),
    "S3 a second series is begun in another folder": (
        ("other_disk_mounted",),
        [
            (lock.LockedFolder, "require_same", lambda _: None),
            (lock.LockedFolder, "is_remounted", lambda _: False),
        ],
    ),
    "S4 a damaged tilt offset stops all": (
        ("tilt_offset_damaged",),
        [(tilt_offsets, "read_checked_json", _read_unchecked)],
    ),
    "S5 damage of the files that people open is not reported": (
        ("series_damaged",),
        [
            (integrity, "_check_series", lambda *_, **__: []),
            (integrity, "_check_derived", lambda *_: []),
        ],
    ),
    "S6 two scans of one start": (
        ("other_scan_of_a_start",),
        [(scan_tasks, "_require_new_start", lambda *_: None)],
    ),
    "S7 broken areas stop all": (
        OPTIONAL_INPUTS,
        [(usable_inputs, "usable_site", lambda site, **_: site)],
    ),
}


@pytest.fixture(scope="module")
def short_undisturbed(template, tmp_path_factory):
    folder = tmp_path_factory.mktemp("world") / "undisturbed"
    world = simulated_world.make_world(folder, template, 0, 2 * SCANS_PER_BURST)
    world.run()
    return world


@pytest.mark.parametrize("finding", REMEDIES)
def test_what_an_attack_found_is_found_without_its_remedy(
    template, short_undisturbed, tmp_path, monkeypatch, finding
):
    kinds, patches = REMEDIES[finding]

    monkeypatch.setattr(simulated_world, "MAX_RECOVERY_S", simulated_world.DAY_S)
    for target, name, substitute in patches:
        monkeypatch.setattr(target, name, substitute)
    for seed in SEEDS:
        world = simulated_world.make_world(tmp_path / str(seed), template, seed, 2 * SCANS_PER_BURST)
        world.plan_faults(*kinds)
        try:
            world.run()
        except Exception:  # noqa: BLE001 - the loop itself dies of it
            return
        is_paused = any("service=paused" in line for line in world.log)
        if world.defects(short_undisturbed) or (kinds == OPTIONAL_INPUTS and is_paused):
            return
    pytest.fail("the remedy makes no difference")
