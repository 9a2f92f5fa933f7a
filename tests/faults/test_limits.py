"""Limits of the unit, as of `TasksMax=`: a machine without tasks to spare costs no scan."""

from __future__ import annotations

import os
from pathlib import Path

import harness
import pytest

pytestmark = pytest.mark.slow
CGROUPS = (Path("/sys/fs/cgroup/pids"), Path("/sys/fs/cgroup"))  # version 1, version 2


@pytest.fixture
def cgroup():
    """Yield a control group that can limit the number of tasks."""
    for parent in CGROUPS:
        folder = parent / f"station-test-{os.getpid()}"
        try:
            folder.mkdir()
        except OSError:
            continue
        if (folder / "pids.max").exists():
            yield folder
            for _ in range(200):  # the fork server ends shortly after the service
                if not (folder / "cgroup.procs").read_text():
                    break
                harness.pause()
            folder.rmdir()
            return
        folder.rmdir()
    pytest.skip("limiting the number of tasks requires root and the pids controller")


def test_task_limit_sets_no_scan_aside(make_station, undisturbed, cgroup):
    """Decoders without threads panic, and worker processes cannot be started."""
    station = make_station(cold=True)
    join = f'echo $$ > {cgroup}/cgroup.procs; exec "$@"'
    station.command_prefix = ["/bin/sh", "-c", join, "sh"]
    station.start()
    station.wait_until(station.is_finished)
    idle = int((cgroup / "pids.current").read_text())
    for hour, extra in enumerate((0, 1, 2, 3)):
        (cgroup / "pids.max").write_text(str(idle + extra))
        station.drop(hour)
        name = f"{harness.scan_name(hour)}.laz"
        station.wait_until(lambda: station.state(name) == "later" or "paused" in station.log())  # noqa: B023
        (cgroup / "pids.max").write_text("max")
    station.drop(4, 5)
    station.finish(*range(harness.SCANS))
    for hour, row in enumerate(station.rows().values()):
        assert row.state == "stored", (hour, row)
    with_reference = {row.reference for row in station.rows().values()}
    assert with_reference == {"1"}
    for path in sorted(undisturbed().data.glob("*.nc")):
        harness.assert_same_values(station.data / path.name, path)
