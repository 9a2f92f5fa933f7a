"""What people are told: once, again, and that it is over; by whatever target answers."""

from __future__ import annotations

import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from station.config import read_site
from station.errors import ConfigError, StoreError
from station.service import alarm_rules, alarms, health
from station.service.alarm_memory import Alarm, Memory, news, recall, remember
from station.service.alarm_rules import alarms_of
from station.service.journal import Journal
from station.service.lock import only_writer
from station.service.targets import send

HOUR_S, DAY_S = 3600.0, 86400.0
NOW_S = 1_795_000_000.0
NO_RULES = "no_scan_h = 0\nstalled_h = 0\ndisk_gb = 0\nset_aside_share = 0\nz_std = 0\nmoved = false\n"


class Told:
    """The memory of a station and what is told from it."""

    def __init__(self):
        self.memory = Memory(since_utc_s=0.0)

    def __call__(self, hour, *found):
        return news(self.memory, list(found), hour * HOUR_S, DAY_S)


def test_an_alarm_is_told_once_then_daily_then_over():
    told, full = Told(), Alarm("disk", "1 GB free")
    assert told(0, full) == ["alarm: 1 GB free"]
    assert [told(hour, full) for hour in range(1, 24)] == [[]] * 23
    assert told(24, full) == ["still: 1 GB free (since 1970-01-01 00:00 UTC)"]
    assert told(24.5) == []  # not over at once: it may be on the edge
    assert told(24.9, full) == []
    assert told(26) == ["over: 1 GB free (since 1970-01-01 00:00 UTC)"]
    assert told(27, full) == ["alarm: 1 GB free"]


def test_what_has_doubled_is_told_anew():
    told = Told()
    assert told(0, Alarm("change", "rose by 1 m", size=1.0)) == ["alarm: rose by 1 m"]
    assert told(1, Alarm("change", "rose by 1.9 m", size=1.9)) == []
    assert told(2, Alarm("change", "rose by 2 m", size=2.0))[0].startswith("more: rose by 2 m")


def test_a_short_restart_is_not_told():
    told, dead = Told(), Alarm("service", "not running", patience_s=600)
    assert told(0, dead) == []
    assert told(0.1) == []
    assert told(1.5) == []  # nothing was told, nothing is over
    assert told(2, dead) == []
    assert told(2.2, dead) == ["alarm: not running"]


def test_what_was_told_survives_a_restart_and_a_full_disk(tmp_path, monkeypatch):
    memory, path = Memory(since_utc_s=1.0, judged_utc_s=2.0, unsent={"a": ["alarm: ß"]}), tmp_path / "m.json"
    news(memory, [Alarm("disk", "1 GB free")], NOW_S, DAY_S)
    remember(path, memory)
    assert recall(path) == memory

    def full(_):
        raise StoreError("no space left on the device")

    memory.digest = "2026-11-20.txt"
    monkeypatch.setattr("station.archive.layout.written_whole", full)
    before = path.stat().st_ino, path.stat().st_size
    remember(path, memory)
    assert recall(path) == memory
    assert (path.stat().st_ino, path.stat().st_size) == before  # no new block was asked for
    with pytest.raises(StoreError, match="no space left"):
        remember(tmp_path / "new.json", memory)
    path.write_text("{")
    assert recall(path) is None


class Rows:
    """A journal with a clock that is set."""

    def __init__(self, site):
        self.now_s = NOW_S
        self.inbox = site.scans.inbox
        self.journal = Journal(site.station.data / "journal.sqlite", now_s=lambda: self.now_s)

    def add(self, hour, *, verdict="good", waits="", **figures):
        self.now_s, name = NOW_S + hour * HOUR_S, f"scan{hour}.laz"
        self.journal.seen([(name, 1, 1, waits)])
        if verdict == "set aside":
            self.journal.set_aside(name, "cut off")
        elif verdict:
            self.journal.stored(
                name, sha256=name, verdict=verdict, epoch=name, start_utc_s=self.now_s, revision=1,
                figures=figures,
            )  # fmt: skip


@pytest.fixture
def station_at(make_site):
    """Give a way to ask a station's rules at an hour, while its service runs."""

    def make(rules):
        site = make_site(more=f"[alarms]\n{rules}")
        rows = Rows(site)

        def ask(hour, *, since=-1000.0, running=True):
            moments = {"since_utc_s": NOW_S + since * HOUR_S, "judged_utc_s": None}
            if not running:
                return {one.key: one.text for one in alarms_of(site, now_s=NOW_S + hour * HOUR_S, **moments)}
            with only_writer(site.station.data):
                return {one.key: one.text for one in alarms_of(site, now_s=NOW_S + hour * HOUR_S, **moments)}

        made.append(rows)
        return rows, ask

    made = []
    yield make
    for rows in made:
        rows.journal.close()


def only(rule):
    key = rule.partition(" ")[0]
    return "\n".join([*(line for line in NO_RULES.splitlines() if not line.startswith(key)), rule])


def test_nothing_is_wrong_with_a_station_that_works(station_at):
    rows, ask = station_at("disk_gb = 0")
    for hour in range(30):
        rows.add(hour, stable_z_std=1.0)
    assert ask(29.5) == {}


def test_no_scan_for_so_long_says_whether_any_came(station_at):
    rows, ask = station_at(only("no_scan_h = 3"))
    rows.add(0)
    assert ask(2.9) == {}
    assert "nothing new in the inbox" in ask(3.1)["no scan"]
    assert ask(3.1, since=1.0) == {}  # alarms are looked after for two hours only
    rows.add(2, verdict="set aside")
    assert "1 came, none of which could be stored" in ask(3.1)["no scan"]


def test_a_dead_service_is_noticed_and_one_that_stalls(station_at):
    rows, ask = station_at(only("stalled_h = 1"))
    rows.add(0)
    assert ask(0.5) == {}
    assert ask(0.5, running=False) == {"service": "the service is not running"}
    rows.add(1, verdict="", waits="the inclination log")
    assert ask(3) == {}  # it waits for something
    rows.add(2, verdict="")
    assert ask(2.9) == {}
    assert "1 scans wait" in ask(3.1)["stalled"]
    rows.add(3)
    assert ask(3.1) == {}
    # One that never saw the inbox: its files are there by the true clock.
    inbox = rows.inbox
    (inbox / "later.laz").write_bytes(b"")
    came_hour = ((inbox / "later.laz").stat().st_ctime - NOW_S) / HOUR_S
    rows.add(came_hour + 0.1)
    assert ask(came_hour + 0.9) == {}
    assert "2 scans wait" in ask(came_hour + 1.2)["stalled"]  # that, and scan2


def test_the_share_set_aside(station_at):
    rows, ask = station_at(only("set_aside_share = 0.5"))
    for hour, verdict in enumerate(["set aside", "set aside", "good", "good", "good"]):
        assert ask(hour) == {} or hour == 4  # too few
        rows.add(hour, verdict=verdict)
    assert ask(5) == {}
    rows.add(5, verdict="set aside")
    assert ask(6) == {"set aside": "3 of the last day's 6 scans set aside, the last: cut off"}
    assert ask(40) == {}


def test_sigma_that_is_too_small(station_at):
    rows, ask = station_at(only("z_std = 1.5"))
    for hour in range(24):
        rows.add(hour, stable_z_std=1.1)
    assert ask(24) == {}
    rows.add(24, verdict="unusable", stable_z_std=30.0)
    for hour in range(25, 40):
        rows.add(hour, stable_z_std=1.8)
    assert "scatters by 1.8 times its sigma" in ask(40)["sigma"]


def test_the_disk_and_a_rule_that_cannot_be_asked(station_at, monkeypatch):
    _, ask = station_at(only("disk_gb = 2"))
    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", lambda _: SimpleNamespace(free=1.5e9))
    assert "1.50 GB free" in ask(0)["disk"]

    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", lambda _: SimpleNamespace(free=3e9))
    assert ask(0) == {}
    full = SimpleNamespace(f_bavail=10**6, f_frsize=4096, f_files=1000, f_favail=3)
    monkeypatch.setattr("station.service.health.os.statvfs", lambda _: full)
    assert "no inodes left" in ask(0)["disk"]

    def gone(_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", gone)
    assert "Input/output error" in ask(0)["unknown the disk has room"]


def test_a_dead_target_neither_stops_the_others_nor_loses_a_word(
    make_site, credentials, webhook, deaf_url, monkeypatch
):
    site = make_site(more=f'[alarms]\ntargets = ["good", "dead"]\n{only("stalled_h = 1")}')
    credentials(good=webhook.url, dead=deaf_url)
    monkeypatch.setattr(alarms, "send", lambda messages: send(messages, patience_s=3.0))
    began_s, told = time.monotonic(), []
    for minute in (0, 11, 16):
        status = alarms.look(site, tell=told.append, now_s=lambda at=minute: NOW_S + 60 * at)
    assert time.monotonic() - began_s < 18
    assert status == 1
    assert told == ["alarm: the service is not running"]
    assert webhook.came == [("[station test] 1 alarm", "alarm: the service is not running")]
    Journal(site.station.data / "journal.sqlite").close()
    assert "alarm    the service is not running" in health.describe(health.status(site)).splitlines()
    # It answers again; and hears what it has missed.
    credentials(dead=webhook.url)
    with only_writer(site.station.data):
        assert alarms.look(site, now_s=lambda: NOW_S + 3 * HOUR_S) == 0
    over, both = sorted(webhook.came[1:], key=lambda one: len(one[0]))
    assert over[0] == "[station test] 1 over"
    assert both[0] == "[station test] 1 alarm, 1 over"
    assert both[1].splitlines() == [webhook.came[0][1], over[1]]
    before = len(webhook.came)
    with only_writer(site.station.data):
        assert alarms.look(site, now_s=lambda: NOW_S + 4 * HOUR_S) == 0
    assert len(webhook.came) == before


def test_a_rule_with_a_bug_leaves_the_others(station_at, monkeypatch):
    _, ask = station_at(only("stalled_h = 1"))
    monkeypatch.setattr(alarm_rules, "in_use", lambda _: 1 / 0)
    monkeypatch.setattr(alarm_rules.shutil, "disk_usage", lambda _: SimpleNamespace(free=-1))
    told = ask(0)
    assert "ZeroDivisionError" in told["unknown the service works"]
    assert "disk" in told


def test_two_at_once_do_not_tell_twice(make_site, credentials, webhook):
    site = make_site(more=f'[alarms]\ntargets = ["hook"]\n{only("disk_gb = 1e9")}')
    credentials(hook=webhook.url)
    with alarms._alone(site.station.data) as is_alone:
        assert is_alone
        assert alarms.look(site) == 0
    assert webhook.came == []
    assert alarms.look(site) == 0
    assert len(webhook.came) == 1


def test_a_test_message_says_which_target_failed(make_site, credentials, webhook):
    site = make_site(more='[alarms]\ntargets = ["good", "odd", "dead"]\ndigest = "good"\n')
    credentials(good=webhook.url, odd="nosuch://", dead="json://127.0.0.1:9/")
    told = []
    assert alarms.test(site, told.append) == 1
    assert told == [
        "good: delivered", "odd: its URL is none that apprise knows", "dead: not delivered: see the log",
    ]  # fmt: skip
    assert [title for title, _ in webhook.came] == ["[station test] test"]
    good = make_site(more='[alarms]\ntargets = ["good"]\n')
    assert alarms.test(good, told.append) == 0


def test_a_target_that_never_answers_does_not_hold_the_process():
    """As apprise does: work in a pool of threads, which Python waits for when it ends."""
    hangs = (
        "import time; from concurrent.futures import ThreadPoolExecutor; from station.service import targets;"
        "ThreadPoolExecutor().submit(time.sleep, 60); print('told'); targets.leave(1)"
    )
    done = subprocess.run(
        [sys.executable, "-c", hangs], capture_output=True, text=True, check=False, timeout=40
    )
    assert (done.returncode, done.stdout) == (1, "told\n")


def test_secrets_are_not_told(make_site, credentials, capfd):
    site = make_site(more='[alarms]\ntargets = ["hook"]\n')
    credentials(hook="json://user:geheim@127.0.0.1:9/geheim")
    assert alarms.test(site, print) == 1
    assert "geheim" not in "".join(capfd.readouterr())


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("", r"has no \[alarms\]"),
        ("[alarms]\n", "names none"),
        ('[alarms]\ntargets = ["mail"]\n', "target mail: no URL"),
    ],
)
def test_what_lacks_for_a_test_is_said(make_site, credentials, more, says):
    credentials()
    with pytest.raises(ConfigError, match=says):
        alarms.test(make_site(more=more), print)


def test_the_site_file_holds_names_only(write_site):
    with pytest.raises(ConfigError, match=r"alarms\.targets"):
        read_site(write_site(more='[alarms]\ntargets = ["mailto://me:secret@example.org"]\n'))
    with pytest.raises(ConfigError, match="needs areas"):
        read_site(write_site(more="[alarms.change]\n"))


def test_the_digest_is_sent_once(make_site, credentials, webhook):
    site = make_site(more=f'[alarms]\ndigest = "satellite"\n{NO_RULES}')
    credentials(satellite=webhook.url)
    (site.station.data / "digest").mkdir()
    for day in (19, 20):
        (site.station.data / "digest" / f"2026-11-{day}.txt").write_text(f"day {day} ±\n", encoding="utf-8")
    for _ in range(2):
        assert alarms.look(site) == 0
    assert webhook.came == [("[station test] digest 2026-11-20", "day 20 ±")]


def test_change_is_judged_at_every_epoch_once_and_at_the_newest_always(make_site, tmp_path, write_series):
    """A step at hour 20 that all scans until hour 40 were processed after, between two looks."""
    (tmp_path / "areas.geojson").write_text("{}")
    rules = f'[areas]\nfile = "areas.geojson"\n[alarms]\n{NO_RULES}[alarms.change]\nareas = ["tongue"]\n'
    site = make_site(more=rules)
    hours = np.arange(40)
    change_m = np.where(hours < 20, 0.0, -0.5)[:, None] * [1.0, 1.0]
    write_series(3600.0 * hours, change_m, np.full((40, 2), 0.01), ["tongue", "rock"])

    def ask(judged_hour):
        judged_s = None if judged_hour is None else 3600.0 * judged_hour
        return alarms_of(site, since_utc_s=0.0, judged_utc_s=judged_s, now_s=NOW_S)

    (alarm,) = ask(15)
    text = "tongue fell by 0.5 m (± 0.028 m at 95 %) in the 6 h before 1970-01-02 00:00 UTC"
    assert (alarm.key, alarm.text, alarm.size) == ("change in tongue", text, 0.5)  # the last one to show it
    assert ask(25) == []
    assert ask(None) == []  # what is older than the alarms is no news
    write_series(3600.0 * hours[:23], change_m[:23], np.full((23, 2), 0.01), ["tongue", "rock"])
    assert [one.key for one in ask(22)] == [one.key for one in ask(None)] == ["change in tongue"]
    write_series(3600.0 * hours, change_m, np.full((40, 2), 0.01), ["snout", "rock"])
    assert [one.text for one in ask(25)] == ["alarms.change names areas that areas.file has not: tongue"]
