"""What is wrong or has changed right now: the rules of `[alarms]`, asked of journal, series and disk.

Asked by a process of its own, beside the service or without one: a dead service cannot tell that it is.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from statistics import median

import numpy as np

from station.config import Site
from station.errors import StationError, StoreError
from station.readers.scan import suffixes
from station.science.onset import Onsets, onsets, threshold_sigmas
from station.sections import AlarmsSection, ChangeAlarm
from station.service.alarm_memory import Alarm
from station.service.area_series import Curve, read_curves
from station.service.health import need_room
from station.service.inbox import is_scan, list_folder, quoted
from station.service.journal import Entry, Journal, State
from station.service.lock import in_use
from station.service.logs import logfmt

log = logging.getLogger("station")

YEAR_S = 365.25 * 86400
DAY_S = 86400.0
NEWEST = 24  # scans that tell how honest sigma has been
FEWEST = 8  # of them, below which nothing is said
FEWEST_ARRIVED = 4  # scans of a day, below which a share of them means nothing
RESTART_S = 600.0  # an update or a reboot may take so long
TOLD_SIGMAS = 1.959964  # people are told 95 %


def alarms_of(site: Site, *, since_utc_s: float, judged_utc_s: float | None, now_s: float) -> list[Alarm]:
    """Return all that is to be told now.

    `since_utc_s` is when someone first asked, `judged_utc_s` up to which epoch areas were judged before.
    A rule that cannot be asked is an alarm itself.
    """
    rules = site.alarms or AlarmsSection()
    found: list[Alarm] = []

    def ask(rule: str, answer: Callable[[], Iterator[Alarm]]) -> None:
        try:
            found.extend(answer())
        except (StationError, OSError) as error:
            found.append(Alarm(f"unknown {rule}", f"whether {rule} cannot be told: {error}"))
        except Exception as bug:  # one broken rule must not silence the others
            log.exception(logfmt(rule=rule, reason="a bug: please report it"))
            found.append(Alarm(f"unknown {rule}", f"whether {rule} cannot be told: a bug: {bug!r}"[:500]))

    ask("the service works", lambda: _service(site, rules, since_utc_s, now_s))
    ask("the disk has room", lambda: _disk(site, rules))
    if rules.moved and site.adjusts:
        ask("the scanner was moved", lambda: _moved(site))
    if rules.change:
        change = rules.change
        ask("areas have changed", lambda: _changes(site, change, judged_utc_s))
    return found


def _service(site: Site, rules: AlarmsSection, since_utc_s: float, now_s: float) -> Iterator[Alarm]:
    if rules.stalled_h and not in_use(site.station.data):
        yield Alarm("service", "the service is not running", patience_s=RESTART_S)
    if not (site.station.data / "journal.sqlite").is_file():
        return
    span_s = max(DAY_S, rules.no_scan_h * 3600)
    with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
        recent = journal.changed_since(now_s - span_s)
        newest = journal.newest(NEWEST)
    yield from _silence(rules, recent, since_utc_s, now_s)
    yield from _set_aside(rules, recent, now_s)
    yield from _honesty(rules, newest)
    yield from _stall(site, rules, now_s)


def _silence(rules: AlarmsSection, recent: list[Entry], since_utc_s: float, now_s: float) -> Iterator[Alarm]:
    from_s = now_s - rules.no_scan_h * 3600
    rows = [row for row in recent if row.changed_utc_s >= from_s]
    if not rules.no_scan_h or since_utc_s > from_s or any(row.state is State.STORED for row in rows):
        return
    why = (
        f"{len(rows)} came, none of which could be stored: station status tells why"
        if rows
        else "nothing new in the inbox: look at the scanner and the transfer"
    )
    yield Alarm("no scan", f"no scan stored for {rules.no_scan_h:g} h: {why}")


def _stall(site: Site, rules: AlarmsSection, now_s: float) -> Iterator[Alarm]:
    """Tell of scans that nobody has touched while nothing else was done either."""
    from_s = now_s - rules.stalled_h * 3600
    with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
        if not rules.stalled_h or journal.changed_since(from_s):
            return
        waiting = [row for row in journal.waiting() if row.state is State.WAITING]
        known = journal.glimpses()
    stuck = sum(row.seen_utc_s < from_s and not row.waits_for for row in waiting)
    for name, file in list_folder(site.scans.inbox).items():  # since when it is there: its mtime may be older
        stuck += is_scan(name, suffixes()) and quoted(name) not in known and file.st_ctime < from_s
    if stuck:
        text = f"{stuck} scans wait, but none was touched for {rules.stalled_h:g} h: the service stalls"
        yield Alarm("stalled", text)


def _set_aside(rules: AlarmsSection, recent: list[Entry], now_s: float) -> Iterator[Alarm]:
    arrived = [row for row in recent if row.seen_utc_s >= now_s - DAY_S]
    refused = [row for row in arrived if row.state is State.SET_ASIDE]
    share = len(refused) / len(arrived) if len(arrived) >= FEWEST_ARRIVED else 0.0
    if rules.set_aside_share and share >= rules.set_aside_share:
        text = (
            f"{len(refused)} of the last day's {len(arrived)} scans set aside, the last: {refused[-1].reason}"
        )
        yield Alarm("set aside", text)


def _honesty(rules: AlarmsSection, newest: list[Entry]) -> Iterator[Alarm]:
    found = [row.figures.get("stable_z_std") for row in newest if row.verdict != "unusable"]
    z_std = [float(value) for value in found if value is not None]
    if rules.z_std and len(z_std) >= FEWEST and (usual := median(z_std)) > rules.z_std:
        yield Alarm(
            "sigma",
            f"sigma is too small: stable ground scatters by {usual:.2g} times its sigma (median of the newest"
            f" {len(z_std)} scans): look at stable ground, mount and logs",
            size=usual,
        )


def _disk(site: Site, rules: AlarmsSection) -> Iterator[Alarm]:
    free_gb = shutil.disk_usage(site.station.data).free / 1e9
    if free_gb < rules.disk_gb:
        yield Alarm("disk", f"{free_gb:.2f} GB free where the data folder is: make room")
    elif rules.disk_gb:
        try:
            need_room(site)
        except StoreError as error:
            yield Alarm("disk", str(error))


def _moved(site: Site) -> Iterator[Alarm]:
    from station.service.moved import moved  # noqa: PLC0415 - netCDF4 for a station that is not adjusted

    if (site.station.data / "series.nc").is_file() and (text := moved(site)):
        yield Alarm("moved", text)


def _changes(site: Site, rule: ChangeAlarm, judged_utc_s: float | None) -> Iterator[Alarm]:
    """Tell of changes found at epochs that were not judged yet, and at the newest one."""
    from_s = -np.inf if judged_utc_s is None else judged_utc_s - rule.within_h * 3600 - DAY_S
    curves = read_curves(site, from_s)
    unknown = set(rule.areas) - {curve.name for curve in curves}
    if curves and unknown:
        yield Alarm(
            "areas", f"alarms.change names areas that areas.file has not: {', '.join(sorted(unknown))}"
        )
    watched = [curve for curve in curves if not rule.areas or curve.name in rule.areas]
    for curve in watched:
        told = judge(curve, rule, areas=len(watched), expected_every_s=site.scans.expected_every_s)
        news = told.found & (curve.time_s > (np.inf if judged_utc_s is None else judged_utc_s))
        news[-1:] |= told.found[-1:]
        if news.any():
            yield _change(curve, told, rule, int(np.flatnonzero(news)[-1]))


def judge(curve: Curve, rule: ChangeAlarm, *, areas: int, expected_every_s: float) -> Onsets:
    """Tell at which epochs an area changed, one of several that are tested at every scan."""
    tests_per_year = areas * YEAR_S / expected_every_s
    return onsets(
        curve.time_s,
        curve.change_m,
        curve.sigma_m,
        within_s=rule.within_h * 3600 + 1,  # two scans that far apart to the second are within it
        scans=rule.scans,
        least_m=rule.least_m,
        sigmas=threshold_sigmas(rule.false_alarms_per_year, tests_per_year),
    )


def _change(curve: Curve, told: Onsets, rule: ChangeAlarm, index: int) -> Alarm:
    size_m, sigma_m = float(told.change_m[index]), float(told.sigma_m[index])
    when = f"{datetime.fromtimestamp(curve.time_s[index], UTC):%Y-%m-%d %H:%M}"
    text = (
        f"{curve.name} {'rose' if size_m > 0 else 'fell'} by {abs(size_m):.3g} m"
        f" (± {TOLD_SIGMAS * sigma_m:.2g} m at 95 %) in the {rule.within_h:g} h before {when} UTC"
    )
    return Alarm(f"change in {curve.name}", text, size=abs(size_m))
