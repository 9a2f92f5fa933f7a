"""Alarms: rules, repetition, state across restarts, and delivery to the targets."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from station.config import read_site
from station.errors import ConfigError, StoreError
from station.inbox.journal import Journal
from station.inbox.lock import exclusive_lock
from station.monitoring import alarm_rules, alarms, status
from station.monitoring.alarm_rules import evaluate_rules
from station.monitoring.alarm_state import Alarm, AlarmState, due_messages, load, save
from station.monitoring.notifiers import send
from station.sections.results import PlaneSection

HOUR_S, DAY_S = 3600.0, 86400.0
NOW_S = 1_795_000_000.0
NO_RULES = "no_scan_h = 0\nstalled_h = 0\ndisk_gb = 0\nset_aside_share = 0\nz_std = 0\nmoved = false\n"


class Evaluation:
    """Alarm state of a station; a call returns the messages that are due."""

    def __init__(self):
        self.state = AlarmState(since_utc_s=0.0)

    def __call__(self, hour, *raised):
        return due_messages(self.state, list(raised), hour * HOUR_S, DAY_S)


def test_alarm_is_sent_once_then_daily_then_cleared():
    messages, full = Evaluation(), Alarm("disk", "1 GB free")
    assert messages(0, full) == ["alarm: 1 GB free"]
    assert [messages(hour, full) for hour in range(1, 24)] == [[]] * 23
    assert messages(24, full) == ["still: 1 GB free (since 1970-01-01 00:00 UTC)"]
    assert messages(24.5) == []  # not cleared at once: it may be at its threshold
    assert messages(24.9, full) == []
    assert messages(26) == ["over: 1 GB free (since 1970-01-01 00:00 UTC)"]
    assert messages(27, full) == ["alarm: 1 GB free"]


def test_alarm_of_doubled_size_is_sent_again():
    messages = Evaluation()
    assert messages(0, Alarm("change", "rose by 1 m", size=1.0)) == ["alarm: rose by 1 m"]
    assert messages(1, Alarm("change", "rose by 1.9 m", size=1.9)) == []
    assert messages(2, Alarm("change", "rose by 2 m", size=2.0))[0].startswith("more: rose by 2 m")


def test_short_alarm_is_not_sent():
    messages, dead = Evaluation(), Alarm("service", "not running", min_duration_s=600)
    assert messages(0, dead) == []
    assert messages(0.1) == []
    assert messages(1.5) == []  # nothing was sent, nothing is cleared
    assert messages(2, dead) == []
    assert messages(2.2, dead) == ["alarm: not running"]


def test_alarm_state_survives_a_restart_and_a_full_disk(tmp_path, monkeypatch):
    state = AlarmState(since_utc_s=1.0, assessed_until_utc_s=2.0, unsent={"a": ["alarm: ß"]})
    path = tmp_path / "alarms.json"
    due_messages(state, [Alarm("disk", "1 GB free")], NOW_S, DAY_S)
    save(path, state)
    assert load(path) == state

    def full(_):
        raise StoreError("no space left on the device")

    state.sent_digest = "2026-11-20.txt"
    monkeypatch.setattr("station.archive.atomic_files.atomic_write", full)
    before = path.stat().st_ino, path.stat().st_size
    save(path, state)
    assert load(path) == state
    assert (path.stat().st_ino, path.stat().st_size) == before  # no new block was allocated
    with pytest.raises(StoreError, match="no space left"):
        save(tmp_path / "new.json", state)
    path.write_text("{")
    assert load(path) is None


class JournalRows:
    """A journal with an adjustable clock."""

    def __init__(self, site):
        self.now_s = NOW_S
        self.inbox = site.scans.inbox
        self.journal = Journal(site.station.data / "journal.sqlite", now_s=lambda: self.now_s)

    def add(self, hour, *, verdict="good", waiting_reason="", **figures):
        self.now_s, name = NOW_S + hour * HOUR_S, f"scan{hour}.laz"
        self.journal.record_seen([(name, 1, 1, waiting_reason)])
        if verdict == "set aside":
            self.journal.set_aside(name, "cut off")
        elif verdict:
            self.journal.record_stored(
                name, sha256=name, verdict=verdict, epoch=name, start_utc_s=self.now_s, revision=1,
                metrics=figures,
            )  # fmt: skip


@pytest.fixture
def station_at(make_site):
    """Return a function that creates a station's journal and a function: alarms by key at an hour."""

    def make(rules):
        site = make_site(more=f"[alarms]\n{rules}")
        rows = JournalRows(site)

        def active(hour, *, since=-1000.0, running=True):
            moments = {"since_utc_s": NOW_S + since * HOUR_S, "assessed_until_utc_s": None}
            if not running:
                raised = evaluate_rules(site, now_s=NOW_S + hour * HOUR_S, **moments)
            else:
                with exclusive_lock(site.station.data):
                    raised = evaluate_rules(site, now_s=NOW_S + hour * HOUR_S, **moments)
            return {alarm.key: alarm.text for alarm in raised}

        journals.append(rows)
        return rows, active

    journals = []
    yield make
    for rows in journals:
        rows.journal.close()


def only(rule):
    key = rule.partition(" ")[0]
    return "\n".join([*(line for line in NO_RULES.splitlines() if not line.startswith(key)), rule])


def test_working_station_raises_no_alarm(station_at):
    rows, active = station_at("disk_gb = 0")
    for hour in range(30):
        rows.add(hour, stable_z_std=1.0)
    assert active(29.5) == {}


def test_no_scan_alarm_counts_arrived_scans(station_at):
    rows, active = station_at(only("no_scan_h = 3"))
    rows.add(0)
    assert active(2.9) == {}
    assert "nothing new in the inbox" in active(3.1)["no scan"]
    assert active(3.1, since=1.0) == {}  # alarms have been evaluated for two hours only
    rows.add(2, verdict="set aside")
    assert "1 arrived, none could be stored" in active(3.1)["no scan"]


def test_dead_and_stalled_services_raise_alarms(station_at):
    rows, active = station_at(only("stalled_h = 1"))
    rows.add(0)
    assert active(0.5) == {}
    assert active(0.5, running=False) == {"service": "the service is not running"}
    rows.add(1, verdict="", waiting_reason="the inclination log")
    assert active(3) == {}  # it waits for something
    rows.add(2, verdict="")
    assert active(2.9) == {}
    assert "1 scans wait" in active(3.1)["stalled"]
    rows.add(3)
    assert active(3.1) == {}
    # A service that never polled the inbox: the file times are those of the real clock.
    inbox = rows.inbox
    (inbox / "later.laz").write_bytes(b"")
    arrival_hour = ((inbox / "later.laz").stat().st_ctime - NOW_S) / HOUR_S
    rows.add(arrival_hour + 0.1)
    assert active(arrival_hour + 0.9) == {}
    assert "2 scans wait" in active(arrival_hour + 1.2)["stalled"]  # that, and scan2


def test_share_of_rejected_scans_raises_an_alarm(station_at):
    rows, active = station_at(only("set_aside_share = 0.5"))
    for hour, verdict in enumerate(["set aside", "set aside", "good", "good", "good"]):
        assert active(hour) == {} or hour == 4  # too few
        rows.add(hour, verdict=verdict)
    assert active(5) == {}
    rows.add(5, verdict="set aside")
    assert active(6) == {"set aside": "3 of the last day's 6 scans set aside, most recently: cut off"}
    assert active(40) == {}


def test_underestimated_sigma_raises_an_alarm(station_at):
    rows, active = station_at(only("z_std = 1.5"))
    for hour in range(24):
        rows.add(hour, stable_z_std=1.1)
    assert active(24) == {}
    rows.add(24, verdict="unusable", stable_z_std=30.0)
    for hour in range(25, 40):
        rows.add(hour, stable_z_std=1.8)
    assert "scatters by 1.8 times its sigma" in active(40)["sigma"]


def test_disk_space_alarm_and_unreadable_disk(station_at, monkeypatch):
    _, active = station_at(only("disk_gb = 2"))
    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", lambda _: SimpleNamespace(free=1.5e9))
    assert "1.50 GB free" in active(0)["disk"]

    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", lambda _: SimpleNamespace(free=3e9))
    assert active(0) == {}
    full = SimpleNamespace(f_bavail=10**6, f_frsize=4096, f_files=1000, f_favail=3, f_flag=0)
    monkeypatch.setattr("station.monitoring.preconditions.os.statvfs", lambda _: full)
    assert "no inodes left" in active(0)["disk"]

    def fail(_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", fail)
    assert "Input/output error" in active(0)["unknown the disk has room"]


@pytest.mark.integration
def test_unresponsive_target_delays_no_other_and_misses_no_message(
    make_site, credentials, webhook, unresponsive_url, monkeypatch
):
    site = make_site(more=f'[alarms]\ntargets = ["good", "dead"]\n{only("stalled_h = 1")}')
    credentials(good=webhook.url, dead=unresponsive_url)
    monkeypatch.setattr(alarms, "send", lambda messages: send(messages, timeout_s=6.0))
    start_s, printed = time.monotonic(), []
    for minute in (0, 11, 16):
        exit_status = alarms.evaluate(site, report=printed.append, now_s=lambda at=minute: NOW_S + 60 * at)
    assert time.monotonic() - start_s < 30  # two waits of 6 s, not of the 20 s of the target
    assert exit_status == 1
    assert printed == ["alarm: the service is not running"]
    assert webhook.received == [("[station test] 1 alarm", "alarm: the service is not running")]
    Journal(site.station.data / "journal.sqlite").close()
    assert "alarm    the service is not running" in status.format_status(status.status(site)).splitlines()
    # It answers again and receives the messages it has missed.
    credentials(dead=webhook.url)
    with exclusive_lock(site.station.data):
        assert alarms.evaluate(site, now_s=lambda: NOW_S + 3 * HOUR_S) == 0
    over, both = sorted(webhook.received[1:], key=lambda message: len(message[0]))
    assert over[0] == "[station test] 1 over"
    assert both[0] == "[station test] 1 alarm, 1 over"
    assert both[1].splitlines() == [webhook.received[0][1], over[1]]
    count = len(webhook.received)
    with exclusive_lock(site.station.data):
        assert alarms.evaluate(site, now_s=lambda: NOW_S + 4 * HOUR_S) == 0
    assert len(webhook.received) == count


def test_bug_in_a_rule_does_not_affect_the_others(station_at, monkeypatch):
    _, active = station_at(only("stalled_h = 1"))
    monkeypatch.setattr(alarm_rules, "is_locked", lambda _: 1 / 0)
    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", lambda _: SimpleNamespace(free=-1))
    raised = active(0)
    assert "ZeroDivisionError" in raised["unknown the service works"]
    assert "disk" in raised


def test_concurrent_evaluations_send_once(make_site, credentials, webhook):
    site = make_site(more=f'[alarms]\ntargets = ["hook"]\n{only("disk_gb = 1e9")}')
    credentials(hook=webhook.url)
    with alarms._single_instance(site.station.data) as is_single:
        assert is_single
        assert alarms.evaluate(site) == 0
    assert webhook.received == []
    assert alarms.evaluate(site) == 0
    assert len(webhook.received) == 1


@pytest.mark.integration
def test_test_message_names_failed_targets(make_site, credentials, webhook):
    site = make_site(more='[alarms]\ntargets = ["good", "odd", "dead"]\ndigest = "good"\n')
    credentials(good=webhook.url, odd="nosuch://", dead="json://127.0.0.1:9/")
    printed = []
    assert alarms.test(site, printed.append) == 1
    assert printed == [
        "good: delivered", "odd: apprise does not support its URL", "dead: not delivered: see the log",
    ]  # fmt: skip
    assert [title for title, _ in webhook.received] == ["[station test] test"]
    good = make_site(more='[alarms]\ntargets = ["good"]\n')
    assert alarms.test(good, printed.append) == 0


def test_pending_delivery_does_not_block_the_exit():
    """Apprise delivers in a pool of threads, for which Python waits at exit."""
    code = (
        "import time; from concurrent.futures import ThreadPoolExecutor;"
        "from station.monitoring import notifiers;"
        "ThreadPoolExecutor().submit(time.sleep, 60); print('delivering'); notifiers.exit_now(1)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=40
    )
    assert (result.returncode, result.stdout) == (1, "delivering\n")


def test_secrets_are_not_printed(make_site, credentials, capfd):
    site = make_site(more='[alarms]\ntargets = ["hook"]\n')
    credentials(hook="json://user:geheim@127.0.0.1:9/geheim")
    assert alarms.test(site, print) == 1
    assert "geheim" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("url", ["mailto//user:geheim@example.org", "geheim", "slack://geheim%2Fx/a"])
def test_secrets_in_a_misspelt_url_are_not_printed(make_site, credentials, capfd, caplog, url):
    site = make_site(more='[alarms]\ntargets = ["hook"]\n')
    credentials(hook=url)
    assert alarms.test(site, print) == 1
    assert "geheim" not in "".join([*capfd.readouterr(), caplog.text])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("", r"has no \[alarms\]"),
        ("[alarms]\n", "targets is empty"),
        ('[alarms]\ntargets = ["mail"]\n', "target mail: no URL"),
    ],
)
def test_test_message_needs_configured_targets(make_site, credentials, more, message):
    credentials()
    with pytest.raises(ConfigError, match=message):
        alarms.test(make_site(more=more), print)


def test_site_file_rejects_target_urls(write_site):
    with pytest.raises(ConfigError, match=r"alarms\.targets"):
        read_site(write_site(more='[alarms]\ntargets = ["mailto://me:secret@example.org"]\n'))
    with pytest.raises(ConfigError, match="needs areas"):
        read_site(write_site(more="[alarms.change]\n"))


def test_digest_is_sent_once(make_site, credentials, webhook):
    site = make_site(more=f'[alarms]\ndigest = "satellite"\n{NO_RULES}')
    credentials(satellite=webhook.url)
    (site.station.data / "digest").mkdir()
    for day in (19, 20):
        (site.station.data / "digest" / f"2026-11-{day}.txt").write_text(f"day {day} ±\n", encoding="utf-8")
    for _ in range(2):
        assert alarms.evaluate(site) == 0
    assert webhook.received == [("[station test] digest 2026-11-20", "day 20 ±")]


def test_change_is_assessed_once_per_epoch_and_always_at_the_newest(make_site, tmp_path, write_series):
    """A step at hour 20; all scans until hour 40 are processed between two evaluations."""
    triangle = {"type": "Polygon", "coordinates": [[[0, 0], [500, 0], [0, 500], [0, 0]]]}
    (tmp_path / "areas.geojson").write_text(json.dumps(triangle))
    rules = f'[areas]\nfile = "areas.geojson"\n[alarms]\n{NO_RULES}[alarms.change]\nareas = ["tongue"]\n'
    site = make_site(more=rules)
    hours = np.arange(40)
    change_m = np.where(hours < 20, 0.0, -0.5)[:, None] * [1.0, 1.0]
    write_series(3600.0 * hours, change_m, np.full((40, 2), 0.01), ["tongue", "rock"])

    def active(assessed_hour):
        assessed_s = None if assessed_hour is None else 3600.0 * assessed_hour
        return evaluate_rules(site, since_utc_s=0.0, assessed_until_utc_s=assessed_s, now_s=NOW_S)

    (alarm,) = active(15)
    text = "tongue fell by 0.5 m (± 0.028 m at 95 %) in the 6 h before 1970-01-02 00:00 UTC"
    # The text names the last epoch that shows the step.
    assert (alarm.key, alarm.text, alarm.size) == ("change in tongue", text, 0.5)
    plane = PlaneSection(origin_m=(0.0, 0.0, 0.0), facing_deg=200.0)
    face = site.model_copy(update={"grid": site.grid.model_copy(update={"plane": plane})})
    (alarm,) = evaluate_rules(face, since_utc_s=0.0, assessed_until_utc_s=15 * 3600.0, now_s=NOW_S)
    assert alarm.text == text.replace("fell", "moved in")
    assert active(25) == []
    assert active(None) == []  # steps before the first evaluation raise no alarm
    write_series(3600.0 * hours[:23], change_m[:23], np.full((23, 2), 0.01), ["tongue", "rock"])
    for assessed_hour in (22, None):
        assert [alarm.key for alarm in active(assessed_hour)] == ["change in tongue"]
    write_series(3600.0 * hours, change_m, np.full((40, 2), 0.01), ["snout", "rock"])
    (alarm,) = active(25)
    assert alarm.text == "alarms.change names areas that are not in areas.file: tongue"
