"""A change of mind redoes exactly what it affects; what nothing affects comes out bit by bit the same."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import station
from station.archive.reference import read_lineage
from station.config import read_site
from station.errors import ConfigError, NotReadyError
from station.service import reprocess as module
from station.service.check import check_store
from station.service.cluster import require_safe
from station.service.journal import Journal, State
from station.service.lock import only_writer
from station.service.once import process_scans
from station.service.places import arrival_of
from station.service.reprocess import reprocess
from station.service.stale import count_by_settings
from station.service.tasks import series_of
from station.service.worker import Worker
from station.simulation.station import simulate, tiny

SCANS = [f"250715_{hour:02d}0000" for hour in range(5)]
LAST = SCANS[-1]  # the only one the reference is not made of
OTHERWISE = {"epoch_file"}  # a redone epoch is another file, and nothing else


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Five hours, processed live: the reference of the first, a better one after four."""
    folder = tmp_path_factory.mktemp("made") / "station"
    simulate(folder, replace(tiny(hours=5), avalanche_m=0.0))
    site = read_site(folder / "site.toml")
    for scan in sorted(site.scans.inbox.glob("*.laz")):
        assert process_scans(site, [scan], lambda _: None) == 0
    return folder


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "station")


def site_of(folder, *changes, more=""):
    path = folder / "site.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text + more)
    return read_site(path)


def values(folder):
    with station.open(folder / "data") as series:
        return series.load()


def revisions(folder):
    return {
        str(scan): str(name).rpartition("Z")[2].removesuffix(".nc")
        for scan, name in zip(*(values(folder)[key].values for key in ("scan_id", "epoch_file")), strict=True)
    }


def redone(folder):
    """Scans whose epochs are other files than those of the live run."""
    return sorted(
        scan for scan, tail in revisions(folder).items() if tail != ("_r2" if scan == SCANS[0] else "")
    )


def same(one, other, but=OTHERWISE):
    return [name for name in other.variables if name not in but and not one[name].identical(other[name])]


def run(site, **how):
    said = []
    status = reprocess(site, (None, None), said.append, **how)
    return status, "\n".join(said)


def faults(folder):
    return [one["says"] for one in check_store(folder / "site.toml") if one["level"] == "fault"]


def damage(path):
    """Turn over a byte in the middle of a file's largest variable."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def epoch_of(folder, scan):
    (path,) = (folder / "data" / "epochs").rglob(f"*T{scan[7:]}Z*.nc") if scan != SCANS[0] else [None]
    return path


def test_nothing_changed_nothing_done(folder):
    site = site_of(folder)
    assert run(site) == (0, "0 epochs to be done again")
    assert redone(folder) == []
    assert count_by_settings(site) == 0
    assert faults(folder) == []


def test_damaged_and_missing_epochs_are_named_and_rebuilt_bit_by_bit(folder):
    before = values(folder)
    damage(epoch_of(folder, SCANS[1]))
    epoch_of(folder, SCANS[2]).write_bytes(b"no file of this kind")
    epoch_of(folder, SCANS[3]).unlink()
    said = "\n".join(faults(folder))
    for scan in SCANS[1:4]:
        assert scan[7:] + "Z.nc" in said
    assert "station reprocess" in said

    status, said = run(site_of(folder))
    assert status == 0, said
    assert "3 × epoch damaged or missing" in said
    assert redone(folder) == SCANS[1:4]
    assert same(values(folder), before) == []
    assert faults(folder) == []
    assert len(list((folder / "data").rglob("*.damaged"))) == 2


def test_a_damaged_month_is_rebuilt_from_its_scans(folder):
    before = values(folder)
    site = site_of(folder)
    data = site.station.data
    with Journal(data / "journal.sqlite") as journal:
        Worker(site, journal).join_closed()
        for kind in ("epochs", "days"):  # as the sweep does after two days
            gone = [str(path.relative_to(data)) for path in (data / kind).rglob("*.nc")]
            shutil.rmtree(data / kind)
            journal.forget_files(gone)
    assert faults(folder) == []
    assert same(values(folder), before) == []
    (month,) = (data / "months").rglob("*.nc")
    damage(month)
    assert month.name in faults(folder)[0]
    assert len(faults(folder)) == 1 + len(SCANS)
    status, said = run(site)
    assert (status, "5 × epoch damaged or missing" in said) == (0, True)
    assert same(values(folder), before) == []
    assert faults(folder) == []


@pytest.mark.slow
def test_a_damaged_reference_is_made_anew(folder):
    before = values(folder)
    site = site_of(folder)
    for version in ("1", "2"):
        damage(site.station.data / f"reference_{version}.nc")
    assert sum("reference_" in one for one in faults(folder)) == 2
    assert "instead of 1 2" in run(site)[1]
    after = values(folder)
    assert set(after.reference_version.values) == {"3"}
    assert faults(folder) == []
    first = [one.isel(time=slice(4)) for one in (after, before)]
    assert same(*first, OTHERWISE | {"reference_version"}) == []
    assert run(site)[1] == "0 epochs to be done again"


def test_the_service_goes_on_without_a_damaged_epoch_and_redoes_it(folder):
    before = values(folder)
    epoch_of(folder, SCANS[2]).write_bytes(b"no file of this kind")
    site = site_of(folder)
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal, patient=True)
        worker.recover()
        assert [row.name for row in journal.waiting()] == [f"{SCANS[2]}.laz"]
        assert list(values(folder).scan_id.values) == [*SCANS[:2], *SCANS[3:]]
        assert worker.take(arrival_of(site, site.scans.inbox / f"{SCANS[2]}.laz"))
    assert same(values(folder), before) == []


def test_a_flag_makes_its_epoch_unusable_and_lifting_it_good_again(folder):
    before = values(folder)
    flags = folder / "flags.csv"
    flags.write_text("from,to,reason\n2025-07-15T04:00:01,2025-07-15T04:00:02,rime on the window\n")
    site = site_of(folder, more='[flags]\nfile = "flags.csv"\n')
    assert count_by_settings(site) == 1
    assert run(site, dry_run=True) == (0, "1 epochs to be done again\n  1 × flag set or lifted")
    assert redone(folder) == []
    assert run(site)[0] == 0
    flagged = values(folder)
    assert redone(folder) == [LAST]
    assert flagged.verdict.values.tolist() == [0, 0, 0, 0, 2]
    assert str(flagged.verdict_reason.values[-1]) == "flagged: rime on the window"
    assert same(flagged, before, OTHERWISE | {"verdict", "verdict_reason", "flag"}) == []
    flags.write_text("from,to,reason\n")
    assert run(site)[0] == 0
    assert same(values(folder), before) == []


@pytest.mark.slow
def test_a_flag_on_a_scan_of_a_later_version_redoes_what_was_measured_from_that(folder):
    (folder / "flags.csv").write_text("from,to,reason\n2025-07-15T02:50:00,2025-07-15T03:10:00,crane\n")
    site = site_of(folder, more='[flags]\nfile = "flags.csv"\n')
    before = values(folder)
    assert before.reference_version.values.tolist() == ["1", "1", "1", "1", "2"]
    status, said = run(site)
    assert (status, "reference 3 made of 4 scans, instead of 2" in said) == (0, True)
    after = values(folder)
    assert after.reference_version.values.tolist() == ["1", "1", "1", "1", "3"]
    assert redone(folder) == SCANS[3:]
    assert {one["scan_id"] for one in read_lineage(series_of(site), "3").made_from} == {
        f'"{scan}"' for scan in (*SCANS[:3], LAST)
    }
    assert run(site)[1] == "0 epochs to be done again"


def test_a_corrected_sop_redoes_its_epochs_only(folder):
    before = values(folder)
    rows = (folder / "sop.dat").read_text().splitlines()
    place = next(at for at, row in enumerate(rows) if row.strip() and not row.startswith("#"))
    numbers = rows[place].split()
    rows[place] = " ".join([*numbers[:3], str(float(numbers[3]) + 0.02)])
    (folder / "sop_2.dat").write_text("\n".join(rows) + "\n")
    site = site_of(folder, ("[map]", '[[sop]]\nfrom = 2025-07-15T03:30:00Z\nfile = "sop_2.dat"\n\n[map]'))
    assert count_by_settings(site) == 1
    status, said = run(site)
    assert (status, said.splitlines()[1:]) == (0, ["  1 × other SOP"])
    after = values(folder)
    assert redone(folder) == [LAST]
    assert [str(one).partition("-")[0] for one in after.sop_id.values] == ["sop"] * 4 + ["sop_2"]
    assert after.scanner_east.values[-1] != before.scanner_east.values[-1]
    assert after.isel(time=slice(4)).identical(before.isel(time=slice(4)))


def test_the_zero_of_an_sop_is_that_of_its_first_scan_in_whatever_order_they_are_redone(folder, monkeypatch):
    shutil.copy(folder / "sop.dat", folder / "sop_2.dat")
    site = site_of(folder, ("[map]", '[[sop]]\nfrom = 2025-07-15T02:30:00Z\nfile = "sop_2.dat"\n\n[map]'))
    elsewhere = site.model_copy(update={"station": site.station.model_copy(update={"data": folder / "new"})})
    module._find_zero(elsewhere, arrival_of(site, site.scans.inbox / f"{SCANS[3]}.laz"), lambda: None)
    (wanted,) = (folder / "new" / "lean_zero").glob("sop_2-*.json")

    forward = module._Redoing._redo
    monkeypatch.setattr(module._Redoing, "_redo", lambda self, todo, hands: forward(self, todo[::-1], hands))
    monkeypatch.setattr(module._Redoing, "_with_reference", lambda _, found, __: found)
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda _: {0})
    status, said = run(site)
    assert (status, "2 × other SOP" in said) == (0, True)
    (found,) = (folder / "data" / "lean_zero").glob("sop_2-*.json")
    assert (found.name, found.read_text()) == (wanted.name, wanted.read_text())
    assert values(folder).lean_zero.values[3:].tolist() == [wanted.read_text()] * 2


@pytest.mark.slow
def test_another_setting_makes_the_reference_anew_and_everything_from_it(folder, tmp_path):
    other = ("min_points = 1", "min_points = 2")
    site = site_of(folder, other)
    assert count_by_settings(site) == 5
    with pytest.MonkeyPatch.context() as patch:  # a Ctrl-C after the first
        remember, redone_before = module.remember, []

        def stop_after(*args):
            remember(*args)
            if not redone_before:
                os.kill(os.getpid(), signal.SIGINT)
            redone_before.append(args)

        patch.setattr(module, "remember", stop_after)
        status, said = run(site)
    assert status == 75
    assert "reference 3 made of 1 scans" in said
    begun = redone(folder)
    assert 0 < len(begun) < 5
    status, said = run(site)
    assert status == 0
    assert said.startswith(f"{5 - len(begun)} epochs")
    assert run(site)[1] == "0 epochs to be done again"
    assert read_lineage(series_of(site), "3").base == "3"

    after = values(folder)
    fresh = shutil.copytree(folder, tmp_path / "fresh", ignore=shutil.ignore_patterns("data"))
    new = site_of(fresh, ("scans = 1 ", "scans = 1 "))
    process_scans(new, sorted(new.scans.inbox.glob("*.laz"))[:3], lambda _: None)
    live = values(fresh)
    first = after.isel(time=slice(3))
    assert same(first, live, OTHERWISE | {"reference_version"}) == []


@pytest.mark.slow
def test_kills_at_any_moment_of_reprocessing_change_no_value(folder, tmp_path):
    """Killed six times, then left alone: as if it had never been disturbed."""
    quiet = shutil.copytree(folder, tmp_path / "quiet")
    other = ("min_points = 1", "min_points = 2")
    assert run(site_of(quiet, other))[0] == 0
    site = site_of(folder, other)
    seed = int(np.random.default_rng().integers(1 << 30))
    rng = np.random.default_rng(seed)
    for _ in range(6):
        with subprocess.Popen(
            [sys.executable, "-m", "station.cli", "reprocess", site.path], stdout=subprocess.DEVNULL
        ) as going:
            with contextlib.suppress(subprocess.TimeoutExpired):
                going.wait(rng.uniform(1.0, 15.0))
            going.kill()
    assert run(site)[0] == 0, seed
    assert same(values(folder), values(quiet), OTHERWISE | {"reference_version"}) == [], seed
    assert set(values(folder).reference_version.values) <= {str(version) for version in range(3, 10)}, seed
    assert faults(folder) == [], seed


def test_a_log_and_weather_that_come_late(made, tmp_path):
    wanted = values(made)
    folder = shutil.copytree(made, tmp_path / "station")
    log = folder / "inbox" / f"{LAST}-incl.txt"
    weather = folder / "weather.dat"
    shutil.move(log, tmp_path / "log")
    rows = weather.read_text().splitlines(keepends=True)
    weather.write_text("".join(rows[:4] + [row for row in rows[4:] if row < '"2025-07-15 02:50']))
    site = site_of(
        folder,
        ("max_age_s = 3600", "max_age_s = 3600\nwait_s = 0"),
        ("wait_s = 900\nfilter", "wait_s = 0\nfilter"),
    )
    shutil.rmtree(folder / "data")
    shutil.copytree(made / "data", folder / "data")
    with Journal(site.station.data / "journal.sqlite") as journal:
        journal.again([f"{LAST}.laz"])
        worker = Worker(site, journal, patient=True)
        worker.take(arrival_of(site, site.scans.inbox / f"{LAST}.laz"))
        assert "inclination log missing" in journal.entry(f"{LAST}.laz").reason
        assert "weather missing" in journal.entry(f"{LAST}.laz").reason
        worker.sweep()
        assert journal.waiting() == []
        shutil.move(tmp_path / "log", log)
        weather.write_text("".join(rows))
        worker.sweep()
        assert [row.name for row in journal.waiting()] == [f"{LAST}.laz"]
        worker.take(arrival_of(site, site.scans.inbox / f"{LAST}.laz"))
        worker.sweep()
        assert journal.waiting() == []
    assert same(values(folder), wanted) == []


def test_a_touched_scan_is_not_measured_again_and_a_copy_is_put_aside(folder):
    site = site_of(folder)
    files = sorted((folder / "data" / "epochs").rglob("*"))
    path = site.scans.inbox / f"{LAST}.laz"
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal, patient=True)
        os.utime(path)
        arrival = arrival_of(site, path)
        journal.seen([(arrival.name, arrival.size, arrival.mtime_ns, "")])
        assert journal.entry(path.name).state is State.WAITING
        assert worker.take(arrival)
        assert journal.entry(path.name).state is State.STORED
        copy = path.with_name("250716_000000.laz")
        shutil.copy(path, copy)
        assert not worker.take(arrival_of(site, copy))
        assert journal.entry(copy.name).state is State.SET_ASIDE
        assert journal.entry(copy.name).reason == f"the same bytes as {path.name}, which is stored"
        assert not Worker(site, journal).take(arrival_of(site, copy))  # nor by `station process`
    assert sorted((folder / "data" / "epochs").rglob("*")) == files


def test_a_lost_journal_is_made_anew_from_the_epochs(folder):
    site = site_of(folder)
    path = site.station.data / "journal.sqlite"
    with Journal(path) as journal:
        before = {row.name: row for row in journal.rows()}
        sums = journal.files()
    zeros = {file.name: file.read_text() for file in (site.station.data / "lean_zero").iterdir()}
    path.unlink()
    shutil.rmtree(site.station.data / "lean_zero")
    files = sorted((folder / "data" / "epochs").rglob("*.nc"))
    with Journal(path) as journal:
        worker = Worker(site, journal, patient=True)
        worker.recover()
        for scan in SCANS:  # as the service would: it does not know them by size and time
            arrival = arrival_of(site, site.scans.inbox / f"{scan}.laz")
            journal.seen([(arrival.name, arrival.size, arrival.mtime_ns, "")])
            assert worker.take(arrival)
        assert journal.files() == sums
        assert zeros == {file.name: file.read_text() for file in (site.station.data / "lean_zero").iterdir()}
        lately = {"figures", "seen_utc_s", "changed_utc_s"}
        for row in journal.rows():
            for name in set(vars(row)) - lately:
                assert getattr(row, name) == getattr(before[row.name], name), (row.name, name)
        assert len(journal.rows()) == len(SCANS)
    assert sorted((folder / "data" / "epochs").rglob("*.nc")) == files
    assert run(site)[1] == "0 epochs to be done again"


def test_a_store_of_another_grid_is_left_alone(folder):
    site = site_of(folder, ("cell_m = 5.0", "cell_m = 10.0"))
    with pytest.raises(ConfigError, match=r"192 x 92 cells of 5 m .* new folder"):
        run(site)


def test_a_running_service_has_to_be_stopped_first(folder):
    site = site_of(folder)
    with only_writer(site.station.data), pytest.raises(NotReadyError, match="stop that one first"):
        run(site)


def test_a_scan_that_is_gone_is_named_and_its_epoch_stays(folder):
    before = values(folder)
    (folder / "inbox" / f"{LAST}.laz").unlink()
    (folder / "flags.csv").write_text("from,to,reason\n2025-07-15T03:30:00,2025-07-15T05:00:00,crane\n")
    status, said = run(site_of(folder, more='[flags]\nfile = "flags.csv"\n'))
    assert status == 3
    assert f"{LAST}.laz: the scan is gone" in said
    assert values(folder).identical(before)


def test_a_scan_is_redone_from_the_archive(folder):
    before = values(folder)
    more = '[flags]\nfile = "flags.csv"\n[retention]\nraw = "move"\nkeep_days = 0\narchive = "old"\n'
    (folder / "flags.csv").write_text("from,to,reason\n")
    site = site_of(folder, more=more)
    with Journal(site.station.data / "journal.sqlite") as journal:
        Worker(site, journal, patient=True).sweep()
    left = sorted(path.name for path in site.scans.inbox.glob("*.laz"))
    assert left == [f"{SCANS[0]}.laz", f"{LAST}.laz"]  # the scan of the SOP, and the newest
    damage(epoch_of(folder, SCANS[2]))
    assert run(site)[0] == 0
    assert redone(folder) == [SCANS[2]]
    assert same(values(folder), before) == []


def test_a_reference_whose_scans_are_gone_is_not_half_remade(folder):
    for path in (folder / "inbox").glob(f"{SCANS[0]}*"):
        path.unlink()
    before = values(folder)
    with pytest.raises(NotReadyError, match=f"gone: {SCANS[0]}.laz: put them back"):
        run(site_of(folder, ("min_points = 1", "min_points = 2")))
    assert values(folder).identical(before)


@pytest.mark.parametrize(
    ("address", "fine"),
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
def test_a_cluster_is_reached_over_loopback_or_tls_only(address, fine):
    if fine:
        require_safe(address)
    else:
        with pytest.raises(ConfigError, match="--scheduler"):
            require_safe(address)
