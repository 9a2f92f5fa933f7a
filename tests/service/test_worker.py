"""The worker: what decides about a scan, and that neither order nor a touched file changes a value."""

from __future__ import annotations

import errno
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.tiny_station import PENDING, assert_same_values, build, scan_name

from station.clock import Clock
from station.config import read_site
from station.errors import InconclusiveError, NotReadyError, ScanError, StationError
from station.inbox.journal import MAX_FAILURES, Journal
from station.inbox.journal_reader import State
from station.inbox.listing import ScanFile
from station.inbox.lock import exclusive_lock
from station.operations.retry import retry_scans
from station.processing.scan_tasks import StoredResult
from station.processing.scans.scan_files import scan_file
from station.processing.store_tasks import SeriesUpdate
from station.processing.workers import fork_server
from station.service.host import Host
from station.service.worker import Worker

NAME = f"{scan_name(1)}.laz"
MIDNIGHT_S = 1_752_537_600.0  # 2025-07-15
WEATHER = """[weather]
file = "weather.dat"
wait_s = 600
columns = { temperature_c = "T", humidity_pct = "RH", pressure_hpa = "P" }
"""

# ---- decisions, with tasks that only pretend


class PretendingWorker(Worker):
    """Stores every scan, unless the test gave it an error for the scan."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.errors = {}  # by scan
        self.references = []  # the scans of each version built
        self.histories = {}  # of the last attempt, by scan

    def run(self, task, *args):
        if task.__name__ == "process_new":
            return self.measure(*args)
        if task.__name__ == "build_reference_version":
            self.references.append([scan.name for scan in args[0]])
        results = {
            "update_between_scans": SeriesUpdate(0, is_behind=False),
            "delete_expired": (),
            "late_inputs": (),
            "_count_outdated": 0,
        }
        nothing = SimpleNamespace(warning="", fault="", input_faults=(), damaged=(), new_checksums={})
        return results.get(task.__name__, nothing)

    def measure(self, scan, history):
        self.histories[scan.name] = history
        if scan.name in self.errors:
            raise self.errors[scan.name]
        start_s = MIDNIGHT_S + 3600 * float(scan.name[7:9])
        return StoredResult(
            start_s, scan.name, f"epochs/{scan.name}.nc", 1, "good", "", history.reference, {}, "", ""
        )


@pytest.fixture
def pretend(write_site):
    """Return a function that returns site, journal and worker with these settings."""
    journals = []

    def make(more="", **options):
        site = read_site(write_site(more=more))
        journals.append(Journal(site.station.data / "journal.sqlite"))
        return site, journals[-1], PretendingWorker(site, journals[-1], in_service=True, **options)

    yield make
    for journal in journals:
        journal.close()


def scan(site, hour):
    path = site.scans.inbox / f"{scan_name(hour)}.laz"
    path.touch()
    return ScanFile(path.name, path, None, 0, 0)


@pytest.mark.parametrize("error", [InconclusiveError("took too long"), ScanError("700 m is beyond 600 m")])
def test_rejected_scan_is_judged_again_when_settings_limits_or_version_change(pretend, monkeypatch, error):
    site, journal, worker = pretend()
    worker.errors = {NAME: error}

    def reject():
        while journal.entry(NAME).state is not State.SET_ASIDE:
            worker.process(scan(site, 0))
            assert not worker.process(scan(site, 1))

    def state_with(more):
        nonlocal site, worker
        (site.path.parent / "areas.geojson").touch()
        site, _, worker = pretend(more=more)
        worker.errors = {NAME: error}
        worker.run_maintenance()
        return journal.entry(NAME).state

    worker.process(scan(site, 1))
    reject()
    assert state_with('[areas]\nfile = "areas.geojson"') is State.SET_ASIDE  # has no say in it
    assert state_with("[service]\nmemory_gb = 3") is State.WAITING
    reject()
    assert state_with("[service]\nmemory_gb = 3\n[scanner]\nrange_max_m = 700") is State.WAITING
    reject()
    monkeypatch.setattr("station.config.__version__", "9.9")
    assert state_with("[service]\nmemory_gb = 3\n[scanner]\nrange_max_m = 700") is State.WAITING
    worker.errors = {}
    assert worker.process(scan(site, 1))


def test_inconclusive_failure_is_repeated_ever_more_rarely_then_rejected_for_now(pretend):
    site, journal, worker = pretend()
    worker.errors = {NAME: InconclusiveError("took longer than 1800 s")}
    for failure in range(1, MAX_FAILURES):
        worker.process(scan(site, 1))
        entry = journal.entry(NAME)
        assert (entry.state, entry.attempts) == (State.LATER, failure)
    worker.process(scan(site, 0))  # the machine works
    worker.process(scan(site, 1))
    entry = journal.entry(NAME)
    assert entry.state is State.SET_ASIDE
    assert entry.reason == "rejected for now, after 12 attempts: took longer than 1800 s"


def test_scan_rejected_for_now_gets_one_attempt_a_week(pretend, monkeypatch):
    site, journal, worker = pretend()
    worker.errors = {NAME: InconclusiveError("needs more than 2 GB")}
    for _ in range(MAX_FAILURES):
        worker.process(scan(site, 0))
        worker.process(scan(site, 1))
    worker.run_maintenance()
    assert journal.entry(NAME).state is State.SET_ASIDE  # only just now
    true_s = time.time()
    for week in (1, 2):
        monkeypatch.setattr(journal, "_now_s", lambda week=week: true_s + 8 * week * 86_400)
        worker.run_maintenance()
        assert journal.entry(NAME).state is State.LATER
        if week == 1:
            worker.process(scan(site, 0))
            worker.process(scan(site, 1))
            assert journal.entry(NAME).state is State.SET_ASIDE  # at once
    worker.errors = {}
    assert worker.process(scan(site, 1))


@pytest.mark.parametrize(("age_s", "waits"), [(599.0, True), (601.0, False)])
def test_only_a_scan_that_has_just_arrived_waits_for_its_weather(pretend, age_s, waits):
    host = Host(clock=Clock(now_s=lambda: MIDNIGHT_S + age_s))
    site, _, worker = pretend(WEATHER, host=host)
    arrived = replace(scan(site, 1), mtime_ns=int(MIDNIGHT_S * 1e9))
    worker.process(arrived)
    assert worker.histories[arrived.name].wait_for_weather == waits
    assert worker.histories[arrived.name].now_s == MIDNIGHT_S + age_s


def test_failure_that_is_surely_not_the_scans_is_never_given_up(pretend):
    site, journal, worker = pretend()
    worker.errors = {NAME: NotReadyError("permission denied")}
    for _ in range(3 * MAX_FAILURES):
        worker.process(scan(site, 1))
    assert journal.entry(NAME).state is State.LATER


def test_scans_are_retried_beside_the_running_service(pretend):
    site, journal, worker = pretend()
    worker.errors = {NAME: ScanError("cut off"), f"{scan_name(2)}.laz": NotReadyError("no log")}
    for hour in (0, 1, 2):
        worker.process(scan(site, hour))
    with exclusive_lock(site.station.data):
        with pytest.raises(StationError, match=r"unknown.laz: no such scan.*\n.*is stored: see"):
            retry_scans(site, ["unknown.laz", f"{scan_name(0)}.laz"])
        assert retry_scans(site, [NAME]) == [f"{NAME}: queued", "1 scans, tried again within a minute"]
        assert journal.entry(NAME).state is State.WAITING
        assert retry_scans(site, [])[0] == f"{scan_name(2)}.laz: queued"
    (site.scans.inbox / NAME).unlink()
    worker.errors = {}
    journal.set_aside(NAME, "cut off")
    worker.process(scan(site, 2))
    assert retry_scans(site, []) == ["nothing to retry: no scan in the inbox was set aside or failed"]
    with pytest.raises(StationError, match="is not in the inbox"):
        retry_scans(site, [NAME])


def test_reference_waits_for_earlier_scans(pretend):
    site, journal, worker = pretend("[reference]\nscans = 2")
    for hour in (0, 1, 2, 3):
        journal.record_seen([(f"{scan_name(hour)}.laz", 0, 0, "")])
    worker.errors = {f"{scan_name(1)}.laz": InconclusiveError("killed")}
    for hour in (0, 1, 2, 3):
        worker.process(scan(site, hour))
    assert worker.references == []
    worker.errors = {}
    worker.process(scan(site, 1))
    assert worker.references == [[f"{scan_name(0)}.laz", f"{scan_name(1)}.laz"]]


def test_reference_does_not_wait_without_end(pretend):
    site, _, worker = pretend("[reference]\nscans = 2")
    worker.errors = {f"{scan_name(1)}.laz": NotReadyError("permission denied")}
    for hour in (0, 1, 2, *[1] * (MAX_FAILURES - 2)):
        worker.process(scan(site, hour))
    assert worker.references == []
    worker.process(scan(site, 1))
    assert worker.references == [[f"{scan_name(0)}.laz", f"{scan_name(2)}.laz"]]


def test_an_inbox_that_cannot_be_searched_pauses_the_reference_and_is_no_bug(pretend, monkeypatch):
    site, _, worker = pretend("[reference]\nscans = 2")
    scans = [scan(site, hour) for hour in (0, 1)]
    worker.process(scans[0])
    usual = Path.stat

    def denied(path, **options):
        if path.parent == site.scans.inbox:
            raise PermissionError(errno.EACCES, "Permission denied")
        return usual(path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "stat", denied)
        with pytest.raises(NotReadyError, match=r"250715_000000\.laz: cannot be read: Permission denied"):
            worker.process(scans[1])
    assert worker.references == []
    worker._reference.build_if_due()
    assert worker.references == [[scan.name for scan in scans]]


# ---- values, with real tasks

integration = pytest.mark.integration


class Station:
    """A station in a folder and its worker; a test says which scan the worker gets next."""

    def __init__(self, folder):
        self.folder = folder
        self.site = read_site(folder / "site.toml")
        self.site.station.data.mkdir()
        self.journal = Journal(self.site.station.data / "journal.sqlite")
        self.worker = Worker(self.site, self.journal, in_service=True)

    def edit(self, old, new):
        """Change the site file, as an operator does, and reload it."""
        path = self.folder / "site.toml"
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))
        self.site = read_site(path)
        self.worker = Worker(self.site, self.journal, in_service=True)
        self.worker.run_maintenance()

    def path(self, hour):
        return self.site.scans.inbox / f"{scan_name(hour)}.laz"

    def drop(self, *hours):
        """Put scans into the inbox and record them, as polling the inbox does."""
        for hour in hours:
            for path in (self.folder / PENDING).glob(f"{scan_name(hour)}*"):
                shutil.copy(path, self.site.scans.inbox)
            self.see(self.path(hour))

    def see(self, path):
        file = scan_file(self.site, path)
        self.journal.record_seen([(file.name, file.size, file.mtime_ns, "")])

    def process(self, *hours):
        for hour in hours:
            self.worker.process(scan_file(self.site, self.path(hour)))

    def process_ahead(self, hour):
        self.worker.process(scan_file(self.site, self.path(hour)), ahead=True)

    def finish(self):
        """Process all that waits, the earliest first."""
        while waiting := self.journal.waiting():
            self.worker.process(scan_file(self.site, self.site.scans.inbox / waiting[0].name))

    def row(self, hour):
        return self.journal.entry(f"{scan_name(hour)}.laz")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Return the folder of a station to which no scan has arrived; its reference needs two."""
    fork_server.ensure_running((*fork_server.PRELOAD, "pytest"))  # workers load the main module, pytest
    folder = build(tmp_path_factory.mktemp("tiny") / "station", hours=4, method="joint")
    path = folder / "site.toml"
    path.write_text(path.read_text() + "[products]\npage = false\n")
    return folder


@pytest.fixture
def make_station(simulated, tmp_path):
    stations = []

    def make():
        stations.append(Station(shutil.copytree(simulated, tmp_path / f"station{len(stations)}")))
        return stations[-1]

    yield make
    for station in stations:
        station.journal.close()


def assert_same_store(station, expected):
    names = {path.name for path in expected.site.station.data.glob("*.nc")}
    assert {path.name for path in station.site.station.data.glob("*.nc")} == names
    for name in names:
        assert_same_values(station.site.station.data / name, expected.site.station.data / name)


@integration
def test_touched_scan_changes_no_value_although_the_reference_falls_due(make_station):
    undisturbed, station = make_station(), make_station()
    for hour in range(3):
        undisturbed.drop(hour)
        undisturbed.finish()
    station.drop(0)
    station.process(0)
    os.utime(station.path(0))
    station.see(station.path(0))
    station.drop(1, 2)
    station.process(1, 2)
    assert station.row(2).reference is None
    station.process(0)
    station.finish()
    assert {station.row(hour).reference for hour in range(3)} == {"1"}
    assert_same_store(station, undisturbed)


@pytest.fixture(scope="module")
def eleven_scans(tmp_path_factory):
    """Return the folder of a station, on which two references become due, and another that processed it."""
    fork_server.ensure_running((*fork_server.PRELOAD, "pytest"))
    folder = build(tmp_path_factory.mktemp("eleven") / "simulated", hours=11, method="joint")
    text = (folder / "site.toml").read_text()
    (line,) = [line for line in text.splitlines() if line.startswith("scan =")]  # the first scan defines it
    (folder / "site.toml").write_text(text.replace(line, "") + "[products]\npage = false\n")
    undisturbed = Station(shutil.copytree(folder, folder.with_name("undisturbed")))
    undisturbed.drop(*range(11))
    undisturbed.finish()
    assert {undisturbed.row(hour).reference for hour in range(11)} == {"1", "2"}
    yield folder, undisturbed
    undisturbed.journal.close()


@integration
@pytest.mark.parametrize("is_interrupted", [False, True])
def test_live_scan_measured_ahead_changes_no_value(eleven_scans, tmp_path, monkeypatch, is_interrupted):
    """Once before the first reference, once before its update; then power fails before the journal knows."""
    folder, undisturbed = eleven_scans
    station = Station(shutil.copytree(folder, tmp_path / "station"))
    station.drop(*range(11))
    station.process_ahead(9)
    assert "waits for" in station.row(9).waiting_reason  # for the first scan under its SOP
    station.process(0)
    station.process_ahead(9)
    assert (station.row(9).epoch is None, station.row(9).reference) == (False, None)
    station.process(1, 0, 1, 2)
    assert station.row(2).reference == "1"
    if is_interrupted:
        monkeypatch.setattr(station.journal, "record_stored", lambda *_, **__: (_ for _ in ()).throw(OSError))
        with pytest.raises(OSError):  # noqa: PT011 - it is the one above
            station.process_ahead(10)
        monkeypatch.undo()
        assert station.row(10).epoch is None
        station.worker = Worker(station.site, station.journal, in_service=True)
        station.worker.recover()
    else:
        station.process_ahead(10)
    assert (station.row(10).state, station.row(10).reference, station.row(10).ahead) == ("waiting", "1", True)
    station.finish()
    assert [row.ahead for row in map(station.row, range(11))] == [False] * 11
    assert station.row(10).reference == "2"
    assert_same_store(station, undisturbed)
    station.journal.close()


@integration
def test_first_scan_of_an_sop_defines_its_tilt_offset_although_it_is_processed_later(make_station):
    station = make_station()
    text = (station.folder / "site.toml").read_text()
    (line,) = [line for line in text.splitlines() if line.startswith("scan =")]
    station.edit(line, "")
    station.drop(0, 1)
    station.process(1)
    assert station.row(1).state is State.LATER
    assert f"waits for {scan_name(0)}.laz: the first scan under an SOP" in station.row(1).waiting_reason
    station.process(0, 1)
    station.finish()
    assert station.row(1).state is State.STORED


@integration
def test_second_scan_of_one_start_is_refused_by_name(make_station):
    station = make_station()
    station.drop(0)
    station.process(0)
    station.drop(1)
    other = station.path(0).with_name("250715_000000.LAZ")
    shutil.copy(station.path(1), other)
    station.see(other)
    station.worker.process(scan_file(station.site, other))
    row = station.journal.entry(other.name)
    assert row.state is State.SET_ASIDE
    assert f"begins at 2025-07-15 00:00:00 UTC, as {scan_name(0)}.laz does, which is stored" in row.reason
    assert station.row(0).state is State.STORED
    assert len(list(station.site.station.data.rglob("epochs/*/*/*/*.nc"))) == 1


@integration
def test_scan_refused_by_a_wrong_setting_is_stored_once_that_is_corrected(make_station):
    station = make_station()
    station.edit("range_max_m = ", "range_max_m = 300 # ")
    station.drop(0)
    station.process(0)
    assert station.row(0).state is State.SET_ASIDE
    station.edit("range_max_m = 300 # ", "range_max_m = ")
    station.finish()
    assert station.row(0).state is State.STORED


@integration
def test_broken_optional_inputs_change_no_value(make_station):
    """Areas, flags and stable ground break, and the weather log becomes a pipe, while the service runs."""
    undisturbed, station = make_station(), make_station()
    for each in (undisturbed, station):
        (each.folder / "flags.csv").write_text("from,to,reason\n")
        each.edit("[products]", '[flags]\nfile = "flags.csv"\n[products]')
    for hour in range(3):
        undisturbed.drop(hour)
        undisturbed.finish()
        if hour == 2:
            for name in ("areas.geojson", "flags.csv", "stable.geojson"):
                (station.folder / name).write_text("{")
        station.drop(hour)
        station.finish()
    assert_same_store(station, undisturbed)
    assert len(station.worker._reported_faults) == 3
    (station.folder / "weather.dat").unlink()
    os.mkfifo(station.folder / "weather.dat")
    station.drop(3)
    os.utime(station.path(3), (1.7e9, 1.7e9))  # it arrived long ago: weather is not waited for
    station.finish()
    assert (station.row(3).state, station.row(3).verdict) == (State.STORED, "degraded")
    assert "weather unusable: weather.dat cannot be read: it is a pipe" in station.row(3).reason
