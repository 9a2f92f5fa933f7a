"""What follows the series in the background: its faults are reported and stop nothing."""

import time
from concurrent.futures import Executor, Future
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from support.epochs import make_epoch

import station
from station.archive.derived.level_files import level_files
from station.archive.epochs import write_epoch
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.config import read_site
from station.inbox.journal import Journal
from station.monitoring.status import queue_status
from station.processing import store_tasks
from station.processing.site_files import series_for
from station.processing.store_tasks import renew_levels
from station.quantities import Reference
from station.service.host import Host
from station.service.mirror import update_mirror
from station.service.renewal import Renewal, renew_low_priority
from station.service.worker import Worker

MORE = """
[mirror]
folder = "served"
"""


def store(site, *hours):
    series = series_for(site)
    write_reference(series, Reference.from_elevation(series.grid, "1", np.full(series.grid.shape, 2800.0)))
    for hour in hours:
        write_epoch(series, make_epoch(hour, grid=series.grid))
    build_series(series)


@pytest.fixture
def site(write_site):
    site = read_site(write_site(more=MORE))
    store(site, 1, 26)
    Journal(site.station.data / "journal.sqlite").close()
    return site.model_copy(
        update={
            "service": site.service.model_copy(update={"memory_gb": 2.0}),  # what a small task needs
            "products": site.products.model_copy(update={"levels": True}),
        }
    )


class AtOnce(Executor):
    """Runs a task when it is submitted."""

    def submit(self, function):
        future = Future()
        future.set_result(function())
        return future


class Tasks:
    """Finish with the faults that they are given."""

    def __init__(self, *faults):
        self.faults, self.started = list(faults), 0

    def run(self, *_, **__):
        self.started += 1
        return self.faults.pop(0)


@pytest.mark.parametrize(
    ("name", "subject"),
    [
        ("mirror", "the mirror is"),
        ("levels", "the files of levels are"),
        ("derived", "the files of areas, products, events and blocks are"),
    ],
)
def test_a_fault_is_logged_once_and_shown_until_it_is_gone(site, caplog, name, subject):
    caplog.set_level("INFO")
    tasks = Tasks("disk full", "disk full", "")
    renewal = Renewal(site, name, update_mirror, replace(Host(), tasks=tasks, make_executor=AtOnce))
    for _ in range(3):
        renewal.proceed()
    assert tasks.started == 1  # nothing was stored since
    renewal.require()
    renewal.proceed()
    renewal.proceed()
    assert tasks.started == 2
    assert caplog.text.count(f"{name}=failed") == 1
    assert f"{subject} not up to date: disk full" in queue_status(site)["faults"]
    renewal.require()
    renewal.proceed()
    renewal.proceed()
    assert f"{name}=renewed" in caplog.text
    assert not [fault for fault in queue_status(site)["faults"] if subject in fault]
    renewal.close()


def test_nothing_is_renewed_that_is_not_wanted(write_site):
    plain = read_site(write_site())
    with Journal(plain.station.data / "journal.sqlite") as journal:
        worker = Worker(plain, journal)
        store(plain, 1, 26)
        worker.proceed_with_renewals()
        worker.finish_levels(verify=True)
        worker.close()
    assert not (plain.station.data / "levels").exists()


def test_a_damaged_epoch_is_a_fault_of_the_levels_and_no_error(site):
    assert renew_levels(site, lambda: None) == ""
    series = series_for(site)
    (path,) = level_files(series)
    path.unlink()
    epoch = next((series.folder / "epochs").glob("**/*T01*.nc"))
    epoch.write_bytes(epoch.read_bytes()[:2000])
    assert "cannot be read" in renew_levels(site, lambda: None)


class InProcess:
    """Runs tasks in this process, at its own priority."""

    def run(self, function, site, task, *args, **_):
        if function is renew_low_priority:
            return task(site, lambda: None)
        return function(site, task, *args, lambda: None)


def test_files_that_lack_many_epochs_are_completed_while_no_scan_waits(write_site, monkeypatch):
    monkeypatch.setattr(store_tasks, "MAX_COMPUTED", 3)
    site = read_site(write_site())
    store(site, *range(1, 7))
    boxes = site.station.data / "boxes.nc"
    host = replace(Host(), tasks=InProcess(), make_executor=AtOnce)
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal, in_service=True, host=host)
        worker.recover()
        assert len(station.open(site.station.data).time) == 6
        assert not boxes.exists()
        worker.proceed_with_renewals()
        assert len(xr.open_dataset(boxes).time) == 6
        write_epoch(series_for(site), make_epoch(7, grid=site.grid_cells))
        worker.recover()  # one epoch more does not have to wait
        worker.close()
    with xr.open_dataset(boxes) as written:
        completed = written.load()
    update_from_nothing(site)
    xr.testing.assert_equal(completed, xr.open_dataset(boxes))


def update_from_nothing(site):
    for name in ("boxes.nc", "daily.nc", "events.geojson", ".boxes.json"):
        (site.station.data / name).unlink(missing_ok=True)
    store_tasks.update_series(site, lambda: None)


@pytest.mark.integration
def test_both_are_renewed_in_processes_of_their_own(site):
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal)
        worker.proceed_with_renewals()
        deadline_s = time.monotonic() + 60
        while not (level_files(series_for(site)) and list(site.mirror.folder.glob("*.json"))):
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        worker.close()


@pytest.mark.integration
def test_reprocessing_replaces_damaged_levels(site):
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal)
        worker.finish_levels(verify=False)
        (path,) = level_files(series_for(site))
        intact = path.read_bytes()
        path.write_bytes(intact[:-100] + b"\xff" * 100)
        worker.finish_levels(verify=True)
        (path,) = level_files(series_for(site))
        assert len(path.read_bytes()) == len(intact)
        assert path.read_bytes()[-100:] != b"\xff" * 100
        worker.close()
