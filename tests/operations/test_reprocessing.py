"""`station reprocess`: a change affects exactly its epochs, and every other value stays bit-identical."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from support.series import open_with_processing, without_dates

from station.archive.reference_files import read_reference_provenance
from station.config import read_site
from station.errors import ConfigError, NotReadyError
from station.inbox.journal import Journal
from station.inbox.journal_reader import State
from station.inbox.lock import exclusive_lock
from station.monitoring.status import status as station_status
from station.operations import reprocessing
from station.operations.batch import process_scans
from station.operations.reprocessing import Reprocessing, reprocess
from station.operations.site_check import store_findings
from station.processing.scans.scan_files import scan_file
from station.processing.site_files import series_for
from station.processing.staleness import count_outdated
from station.processing.workers.dask_executor import require_secure
from station.service.worker import Worker
from station.simulation.station import simulate, small

SCANS = [f"250715_{hour:02d}0000" for hour in range(5)]
LAST = SCANS[-1]  # the only one that is not part of the reference
FILE_NAMES = {"epoch_file"}  # the only variable that reprocessing may change

MELT = '[[product]]\nname = "melt"\nkind = "melt"\ndensity_kg_m3 = 900\n'

integration = pytest.mark.integration


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    """Return a station of five hourly scans: reference 1 from the first, reference 2 after four."""
    folder = tmp_path_factory.mktemp("processed") / "station"
    simulate(folder, replace(small(hours=5), avalanche_m=0.0))
    site = read_site(folder / "site.toml")
    for scan in sorted(site.scans.inbox.glob("*.laz")):
        assert process_scans(site, [scan], lambda _: None) == 0
    return folder


@pytest.fixture
def folder(processed, tmp_path):
    return shutil.copytree(processed, tmp_path / "station")


def edited_site(folder, *changes, more=""):
    path = folder / "site.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text + more)
    return read_site(path)


def read_series(folder):
    with open_with_processing(folder / "data") as series:
        return without_dates(series.load())


def revisions(folder):
    return {
        str(scan): str(name).rpartition("Z")[2].removesuffix(".nc")
        for scan, name in zip(
            *(read_series(folder)[key].values for key in ("scan_id", "epoch_file")), strict=True
        )
    }


def reprocessed(folder):
    """Return the scans whose epoch file is not that of the first run."""
    return sorted(
        scan for scan, tail in revisions(folder).items() if tail != ("_r2" if scan == SCANS[0] else "")
    )


def differences(actual, expected, ignored=FILE_NAMES):
    """Return the names of the variables that are not identical."""
    return [
        name
        for name in expected.variables
        if name not in ignored and not actual[name].identical(expected[name])
    ]


def run(site, **options):
    """Reprocess; return the exit status and the messages."""
    messages = []
    status = reprocess(site, (None, None), messages.append, **options)
    return status, "\n".join(messages)


def faults(folder):
    findings = store_findings(folder / "site.toml")
    return [finding["message"] for finding in findings if finding["level"] == "fault"]


def damage(path):
    """Flip a byte in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def epoch_path(folder, scan):
    """Return the epoch file of a scan with a single revision: any but the first."""
    (path,) = (folder / "data" / "epochs").rglob(f"*T{scan[7:]}Z*.nc")
    return path


@integration
def test_unchanged_station_has_nothing_to_reprocess(folder):
    site = edited_site(folder)
    assert run(site) == (0, "0 epochs to reprocess")
    assert reprocessed(folder) == []
    assert count_outdated(site) == 0
    assert faults(folder) == []


@integration
def test_damaged_and_missing_epochs_are_reported_and_rebuilt_bit_identically(folder):
    original = read_series(folder)
    damage(epoch_path(folder, SCANS[1]))
    epoch_path(folder, SCANS[2]).write_bytes(b"not an HDF5 file")
    epoch_path(folder, SCANS[3]).unlink()
    messages = "\n".join(faults(folder))
    for scan in SCANS[1:4]:
        assert scan[7:] + "Z.nc" in messages
    assert "station reprocess" in messages

    status, messages = run(edited_site(folder))
    assert status == 0, messages
    assert "3 × epoch damaged or missing" in messages
    assert reprocessed(folder) == SCANS[1:4]
    assert differences(read_series(folder), original) == []
    assert faults(folder) == []
    assert len(list((folder / "data").rglob("*.damaged"))) == 2


@integration
def test_damaged_compacted_month_is_rebuilt_from_its_scans(folder):
    original = read_series(folder)
    site = edited_site(folder)
    data = site.station.data
    with Journal(data / "journal.sqlite") as journal:
        Worker(site, journal).compact()
        for kind in ("epochs", "days"):  # as the maintenance does after two days
            deleted = [str(path.relative_to(data)) for path in (data / kind).rglob("*.nc")]
            shutil.rmtree(data / kind)
            journal.drop_checksums(deleted)
    assert faults(folder) == []
    assert differences(read_series(folder), original) == []
    (month,) = (data / "months").rglob("*.nc")
    damage(month)
    assert month.name in faults(folder)[0]
    assert len(faults(folder)) == 1 + len(SCANS)
    status, messages = run(site)
    assert (status, "5 × epoch damaged or missing" in messages) == (0, True)
    assert differences(read_series(folder), original) == []
    assert faults(folder) == []


@pytest.mark.slow
def test_damaged_reference_is_rebuilt(folder):
    original = read_series(folder)
    site = edited_site(folder)
    for version in ("1", "2"):
        damage(site.station.data / f"reference_{version}.nc")
    assert sum("reference_" in message for message in faults(folder)) == 2
    assert "replaces 1 2" in run(site)[1]
    after = read_series(folder)
    assert set(after.reference_version.values) == {"3"}
    assert faults(folder) == []
    first_four = [series.isel(time=slice(4)) for series in (after, original)]
    assert differences(*first_four, FILE_NAMES | {"reference_version"}) == []
    assert run(site)[1] == "0 epochs to reprocess"


@integration
def test_service_drops_a_damaged_epoch_and_reprocesses_its_scan(folder):
    original = read_series(folder)
    epoch_path(folder, SCANS[2]).write_bytes(b"not an HDF5 file")
    site = edited_site(folder)
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal, in_service=True)
        worker.recover()
        assert [row.name for row in journal.waiting()] == [f"{SCANS[2]}.laz"]
        assert list(read_series(folder).scan_id.values) == [*SCANS[:2], *SCANS[3:]]
        assert worker.process(scan_file(site, site.scans.inbox / f"{SCANS[2]}.laz"))
    assert differences(read_series(folder), original) == []


@integration
def test_service_restores_damaged_derived_files(folder):
    """A reference needs no second scan: nothing of what is damaged here is a source."""
    site, data = edited_site(folder, more=MELT), folder / "data"
    with Journal(data / "journal.sqlite") as journal:
        Worker(site, journal, in_service=True).recover()  # the store is a copy
    names = "series.nc", "areas.nc", "products/melt.nc"
    original = {name: without_dates(xr.open_dataset(data / name).load()) for name in names}
    (tilt_offset,) = (data / "sop_tilt_offset").iterdir()
    text = tilt_offset.read_text()
    derived = [*(data / name for name in names), tilt_offset]
    for content in (b"", b"garbage"):
        for path in derived:
            path.write_bytes(content)
        assert len(faults(folder)) == 4
        assert station_status(site)["counts"][State.STORED] == len(SCANS)
        with Journal(data / "journal.sqlite") as journal:
            worker = Worker(site, journal, in_service=True)
            worker.run_maintenance()
            assert process_scans(site, [site.scans.inbox / f"{LAST}.laz"], lambda _: None) == 0
        assert faults(folder) == []
        for name, expected in original.items():
            with xr.open_dataset(data / name) as actual:
                assert without_dates(actual.load()).identical(expected)
        assert tilt_offset.read_text() == text


@integration
def test_flag_makes_its_epoch_unusable_until_it_is_removed(folder):
    original = read_series(folder)
    flags = folder / "flags.csv"
    flags.write_text("from,to,reason\n2025-07-15T04:00:01,2025-07-15T04:00:02,rime on the window\n")
    site = edited_site(folder, more='[flags]\nfile = "flags.csv"\n')
    assert count_outdated(site) == 1
    assert run(site, dry_run=True) == (0, "1 epochs to reprocess\n  1 × flag set or removed")
    assert reprocessed(folder) == []
    assert run(site)[0] == 0
    flagged = read_series(folder)
    assert reprocessed(folder) == [LAST]
    assert flagged.verdict.values.tolist() == [0, 0, 0, 0, 2]
    assert str(flagged.verdict_reason.values[-1]) == "flagged: rime on the window"
    assert differences(flagged, original, FILE_NAMES | {"verdict", "verdict_reason", "flag"}) == []
    flags.write_text("from,to,reason\n")
    assert run(site)[0] == 0
    assert differences(read_series(folder), original) == []


@pytest.mark.slow
def test_flag_on_a_scan_of_a_later_reference_rebuilds_it_and_its_epochs(folder):
    (folder / "flags.csv").write_text("from,to,reason\n2025-07-15T02:50:00,2025-07-15T03:10:00,crane\n")
    site = edited_site(folder, more='[flags]\nfile = "flags.csv"\n')
    original = read_series(folder)
    assert original.reference_version.values.tolist() == ["1", "1", "1", "1", "2"]
    status, messages = run(site)
    assert (status, "reference 3 built from 4 scans, replaces 2" in messages) == (0, True)
    after = read_series(folder)
    assert after.reference_version.values.tolist() == ["1", "1", "1", "1", "3"]
    assert reprocessed(folder) == SCANS[3:]
    provenance = read_reference_provenance(series_for(site), "3").scan_provenance
    assert {scan["scan_id"] for scan in provenance} == {f'"{scan}"' for scan in (*SCANS[:3], LAST)}
    assert run(site)[1] == "0 epochs to reprocess"


@integration
def test_corrected_sop_affects_its_epochs_only(folder):
    original = read_series(folder)
    rows = (folder / "sop.dat").read_text().splitlines()
    first = next(index for index, row in enumerate(rows) if row.strip() and not row.startswith("#"))
    numbers = rows[first].split()
    rows[first] = " ".join([*numbers[:3], str(float(numbers[3]) + 0.02)])
    (folder / "sop_2.dat").write_text("\n".join(rows) + "\n")
    site = edited_site(folder, ("[map]", '[[sop]]\nfrom = 2025-07-15T03:30:00Z\nfile = "sop_2.dat"\n\n[map]'))
    assert count_outdated(site) == 1
    status, messages = run(site)
    assert (status, messages.splitlines()[1:]) == (0, ["  1 × other SOP"])
    after = read_series(folder)
    assert reprocessed(folder) == [LAST]
    assert [str(sop_id).partition("-")[0] for sop_id in after.sop_id.values] == ["sop"] * 4 + ["sop_2"]
    assert after.scanner_east.values[-1] != original.scanner_east.values[-1]
    assert after.isel(time=slice(4)).identical(original.isel(time=slice(4)))


@integration
def test_tilt_offset_of_an_sop_is_that_of_its_first_scan_in_any_order(folder, monkeypatch):
    shutil.copy(folder / "sop.dat", folder / "sop_2.dat")
    site = edited_site(folder, ("[map]", '[[sop]]\nfrom = 2025-07-15T02:30:00Z\nfile = "sop_2.dat"\n\n[map]'))
    new_station = site.station.model_copy(update={"data": folder / "new"})
    new_site = site.model_copy(update={"station": new_station})
    scan = scan_file(site, site.scans.inbox / f"{SCANS[3]}.laz")
    reprocessing._load_tilt_offset(new_site, scan, lambda: None)
    (expected,) = (folder / "new" / "sop_tilt_offset").glob("sop_2-*.json")

    run_tasks = Reprocessing._run_tasks

    def run_backwards(self, todo, executor):
        return run_tasks(self, todo[::-1], executor)

    monkeypatch.setattr(Reprocessing, "_run_tasks", run_backwards)
    monkeypatch.setattr(Reprocessing, "_rebuild_reference", lambda _, plan, __: plan)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    status, messages = run(site)
    assert (status, "2 × other SOP" in messages) == (0, True)
    (actual,) = (folder / "data" / "sop_tilt_offset").glob("sop_2-*.json")
    assert (actual.name, actual.read_text()) == (expected.name, expected.read_text())
    stored = [json.loads(text) for text in read_series(folder).sop_tilt_offset.values[3:].tolist()]
    assert stored == [json.loads(expected.read_text())["content"]] * 2


@pytest.mark.slow
def test_changed_setting_rebuilds_the_reference_and_all_epochs(folder, tmp_path):
    other = ("min_points = 1", "min_points = 2")
    site = edited_site(folder, other)
    assert count_outdated(site) == 5
    with pytest.MonkeyPatch.context() as patch:  # Ctrl-C after the first scan
        record_result, recorded = reprocessing.record_result, []

        def interrupt_after_first(*args):
            record_result(*args)
            if not recorded:
                os.kill(os.getpid(), signal.SIGINT)
            recorded.append(args)

        patch.setattr(reprocessing, "record_result", interrupt_after_first)
        status, messages = run(site)
    assert status == 75
    assert "reference 3 built from 1 scans" in messages
    finished = reprocessed(folder)
    assert 0 < len(finished) < 5
    status, messages = run(site)
    assert status == 0
    assert messages.startswith(f"{5 - len(finished)} epochs")
    assert run(site)[1] == "0 epochs to reprocess"
    assert read_reference_provenance(series_for(site), "3").base == "3"

    after = read_series(folder)
    new_folder = shutil.copytree(folder, tmp_path / "new", ignore=shutil.ignore_patterns("data"))
    new_site = edited_site(new_folder)
    process_scans(new_site, sorted(new_site.scans.inbox.glob("*.laz"))[:3], lambda _: None)
    first_three = after.isel(time=slice(3)), read_series(new_folder)
    assert differences(*first_three, FILE_NAMES | {"reference_version"}) == []


@pytest.mark.slow
def test_kills_during_reprocessing_change_no_value(folder, tmp_path):
    """Six kills at random times, then a complete run: the result is that of an undisturbed run."""
    undisturbed = shutil.copytree(folder, tmp_path / "undisturbed")
    other = ("min_points = 1", "min_points = 2")
    assert run(edited_site(undisturbed, other))[0] == 0
    site = edited_site(folder, other)
    seed = int(np.random.default_rng().integers(1 << 30))
    rng = np.random.default_rng(seed)
    for _ in range(6):
        with subprocess.Popen(
            [sys.executable, "-m", "station", "reprocess", site.path], stdout=subprocess.DEVNULL
        ) as process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(rng.uniform(1.0, 15.0))
            process.kill()
    assert run(site)[0] == 0, seed
    assert (
        differences(read_series(folder), read_series(undisturbed), FILE_NAMES | {"reference_version"}) == []
    ), seed
    assert set(read_series(folder).reference_version.values) <= {str(version) for version in range(3, 10)}, (
        seed
    )
    assert faults(folder) == [], seed


@integration
def test_late_log_and_weather_requeue_their_scan(processed, tmp_path):
    expected = read_series(processed)
    folder = shutil.copytree(processed, tmp_path / "station")
    log = folder / "inbox" / f"{LAST}-incl.txt"
    weather = folder / "weather.dat"
    shutil.move(log, tmp_path / "log")
    rows = weather.read_text().splitlines(keepends=True)
    weather.write_text("".join(rows[:4] + [row for row in rows[4:] if row < '"2025-07-15 02:50']))
    site = edited_site(
        folder,
        ("max_age_s = 3600", "max_age_s = 3600\nwait_s = 0"),
        ("wait_s = 900\nfilter", "wait_s = 0\nfilter"),
    )
    shutil.rmtree(folder / "data")
    shutil.copytree(processed / "data", folder / "data")
    with Journal(site.station.data / "journal.sqlite") as journal:
        journal.requeue([f"{LAST}.laz"])
        worker = Worker(site, journal, in_service=True)
        worker.process(scan_file(site, site.scans.inbox / f"{LAST}.laz"))
        assert "inclination log missing" in journal.entry(f"{LAST}.laz").reason
        assert "weather missing" in journal.entry(f"{LAST}.laz").reason
        worker.run_maintenance()
        assert journal.waiting() == []
        shutil.move(tmp_path / "log", log)
        weather.write_text("".join(rows))
        worker.run_maintenance()
        assert [row.name for row in journal.waiting()] == [f"{LAST}.laz"]
        worker.process(scan_file(site, site.scans.inbox / f"{LAST}.laz"))
        worker.run_maintenance()
        assert journal.waiting() == []
    assert differences(read_series(folder), expected) == []


@integration
def test_epoch_that_waits_to_be_processed_again_is_not_outdated(folder):
    site = edited_site(folder, ("min_points = 1", "min_points = 2"))
    with Journal(site.station.data / "journal.sqlite") as journal:
        assert station_status(site)["stale"] == 5
        journal.requeue([f"{LAST}.laz"])
        assert station_status(site)["stale"] == 4


@integration
def test_touched_scan_is_not_reprocessed_and_a_copy_is_set_aside(folder):
    site = edited_site(folder)
    files = sorted((folder / "data" / "epochs").rglob("*"))
    path = site.scans.inbox / f"{LAST}.laz"
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal, in_service=True)
        os.utime(path)
        scan = scan_file(site, path)
        journal.record_seen([(scan.name, scan.size, scan.mtime_ns, "")])
        assert journal.entry(path.name).state is State.WAITING
        assert worker.process(scan)
        assert journal.entry(path.name).state is State.STORED
        copy = path.with_name("250716_000000.laz")
        shutil.copy(path, copy)
        assert not worker.process(scan_file(site, copy))
        assert journal.entry(copy.name).state is State.SET_ASIDE
        assert journal.entry(copy.name).reason == f"the same bytes as {path.name}, which is stored"
        assert not Worker(site, journal).process(scan_file(site, copy))  # as in `station process`
    assert sorted((folder / "data" / "epochs").rglob("*")) == files


def read_tilt_offsets(site):
    return {file.name: file.read_text() for file in (site.station.data / "sop_tilt_offset").iterdir()}


@integration
def test_lost_journal_is_rebuilt_from_the_epochs(folder):
    site = edited_site(folder)
    path = site.station.data / "journal.sqlite"
    with Journal(path) as journal:
        original = {row.name: row for row in journal.rows()}
        checksums = journal.checksums()
    tilt_offsets = read_tilt_offsets(site)
    path.unlink()
    shutil.rmtree(site.station.data / "sop_tilt_offset")
    files = sorted((folder / "data" / "epochs").rglob("*.nc"))
    with Journal(path) as journal:
        worker = Worker(site, journal, in_service=True)
        worker.recover()
        for scan_id in SCANS:  # as the service does: rebuilt rows have no size and mtime
            scan = scan_file(site, site.scans.inbox / f"{scan_id}.laz")
            journal.record_seen([(scan.name, scan.size, scan.mtime_ns, "")])
            assert worker.process(scan)
        assert journal.checksums() == checksums
        assert read_tilt_offsets(site) == tilt_offsets
        not_restored = {"metrics", "first_seen_utc_s", "changed_utc_s"}
        for row in journal.rows():
            for name in set(vars(row)) - not_restored:
                assert getattr(row, name) == getattr(original[row.name], name), (row.name, name)
        assert len(journal.rows()) == len(SCANS)
    assert sorted((folder / "data" / "epochs").rglob("*.nc")) == files
    assert run(site)[1] == "0 epochs to reprocess"


@integration
@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:32633"])
def test_store_of_another_map_is_rejected(folder, crs):
    """ETRS89 differs from WGS84 by less than a metre, but other pairs do not."""
    site = edited_site(folder, ('crs = "EPSG:32632"', f'crs = "{crs}"'))
    with pytest.raises(ConfigError, match=r"map\.crs = .* differs from that of .* zone 32N: restore it"):
        run(site)


@integration
def test_store_of_another_grid_is_rejected(folder):
    site = edited_site(folder, ("cell_m = 5.0", "cell_m = 10.0"))
    with pytest.raises(ConfigError, match=r"192 x 92 cells of 5 m .* new folder"):
        run(site)


@integration
def test_running_service_prevents_reprocessing(folder):
    site = edited_site(folder)
    with exclusive_lock(site.station.data), pytest.raises(NotReadyError, match="stop that process first"):
        run(site)


@integration
def test_epoch_of_a_missing_scan_is_kept_and_reported(folder):
    original = read_series(folder)
    (folder / "inbox" / f"{LAST}.laz").unlink()
    (folder / "flags.csv").write_text("from,to,reason\n2025-07-15T03:30:00,2025-07-15T05:00:00,crane\n")
    status, messages = run(edited_site(folder, more='[flags]\nfile = "flags.csv"\n'))
    assert status == 3
    assert f"{LAST}.laz: the scan is missing" in messages
    assert read_series(folder).identical(original)


@integration
def test_scan_is_reprocessed_from_the_archive(folder):
    original = read_series(folder)
    more = '[flags]\nfile = "flags.csv"\n[retention]\nraw = "move"\nkeep_days = 0\narchive = "old"\n'
    (folder / "flags.csv").write_text("from,to,reason\n")
    site = edited_site(folder, more=more)
    with Journal(site.station.data / "journal.sqlite") as journal:
        Worker(site, journal, in_service=True).run_maintenance()
    in_inbox = sorted(path.name for path in site.scans.inbox.glob("*.laz"))
    assert in_inbox == [f"{SCANS[0]}.laz", f"{LAST}.laz"]  # the scan of the SOP, and the newest
    damage(epoch_path(folder, SCANS[2]))
    assert run(site)[0] == 0
    assert reprocessed(folder) == [SCANS[2]]
    assert differences(read_series(folder), original) == []


@integration
def test_reference_with_missing_scans_is_not_rebuilt(folder):
    for path in (folder / "inbox").glob(f"{SCANS[0]}*"):
        path.unlink()
    original = read_series(folder)
    with pytest.raises(NotReadyError, match=f"missing: {SCANS[0]}.laz: restore them"):
        run(edited_site(folder, ("min_points = 1", "min_points = 2")))
    assert read_series(folder).identical(original)


@pytest.mark.parametrize(
    ("address", "is_secure"),
    [
        ("tcp://127.0.0.1:8786", True),
        ("tcp://[::1]:8786", True),
        ("tcp://localhost:8786", True),
        ("tls://cluster.example.org:8786", True),
        ("tcp://192.0.2.7:8786", False),
        ("tcp://cluster.example.org:8786", False),
        ("127.0.0.1:8786", False),
        ("ws://127.0.0.1:8786", False),
    ],
)
def test_cluster_address_must_be_loopback_or_tls(address, is_secure):
    if is_secure:
        require_secure(address)
    else:
        with pytest.raises(ConfigError, match="--scheduler"):
            require_secure(address)
