"""The rules of `[alarms]`, evaluated on journal, series and disk.

A process of its own evaluates them, with or without a running service: a dead service cannot report itself.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from statistics import median

import numpy as np

from station.config import Site
from station.errors import StationError, StoreError
from station.inbox.journal_reader import Entry, JournalReader, State
from station.inbox.listing import ScanListing
from station.inbox.lock import is_locked
from station.logs import logfmt
from station.monitoring.alarm_state import Alarm
from station.monitoring.area_curves import AreaCurve, read_curves
from station.monitoring.preconditions import require_disk_space
from station.monitoring.product_alarms import product_alarms
from station.readers.formats.conversion import scan_suffixes
from station.science.analysis.change_detection import ChangeDetections, detect_changes, threshold_sigmas
from station.science.geometry.robust_statistics import NORMAL_95
from station.science.gridding.significance import SIGNIFICANT_SIGMAS
from station.sections.results import AlarmsSection, ChangeAlarm, EventAlarm

log = logging.getLogger("station")

YEAR_S = 365.25 * 86400
DAY_S = 86400.0
CALIBRATION_SCANS = 24  # newest scans that test the calibration of sigma
MIN_CALIBRATION_SCANS = 8  # with fewer, the calibration is not tested
MIN_ARRIVED_SCANS = 4  # scans per day; with fewer, a share is meaningless
RESTART_ALLOWANCE_S = 600.0  # an update or a reboot may take this long
EDITING_ALLOWANCE_S = 600.0  # and the correction of a file that was edited


def evaluate_rules(
    site: Site, *, since_utc_s: float, assessed_until_utc_s: float | None, now_s: float
) -> list[Alarm]:
    """Return all alarms that are active now.

    `since_utc_s` is the time of the first evaluation, `assessed_until_utc_s` the newest epoch whose area
    changes were assessed. A rule that cannot be evaluated is an alarm itself.
    """
    rules = site.alarms or AlarmsSection()
    alarms: list[Alarm] = []

    def evaluate_rule(rule: str, evaluate: Callable[[], Iterator[Alarm]]) -> None:
        try:
            alarms.extend(evaluate())
        except (StationError, OSError) as error:
            alarms.append(Alarm(f"unknown {rule}", f"cannot check whether {rule}: {error}"))
        except Exception as bug:  # one broken rule must not silence the others
            log.exception(logfmt(rule=rule, reason="a bug: please report it"))
            alarms.append(Alarm(f"unknown {rule}", f"cannot check whether {rule}: a bug: {bug!r}"[:500]))

    evaluate_rule("the service works", lambda: _service(site, rules, since_utc_s, now_s))
    evaluate_rule("the disk has room", lambda: _disk(site, rules))
    evaluate_rule("the input files can be used", lambda: _inputs(site))
    if rules.moved and site.adjusts:
        evaluate_rule("the scanner was moved", lambda: _scanner_moved(site))
    if rules.change:
        change = rules.change
        evaluate_rule("areas have changed", lambda: _area_changes(site, change, assessed_until_utc_s))
    if rules.events:
        events = rules.events
        evaluate_rule("an event began", lambda: _events(site, events, assessed_until_utc_s))
    for rule in rules.product:
        watch = partial(product_alarms, site, rule, assessed_until_utc_s)
        evaluate_rule(f"{rule.quantity} of {rule.product} is beyond its level", watch)
    return alarms


def _service(site: Site, rules: AlarmsSection, since_utc_s: float, now_s: float) -> Iterator[Alarm]:
    if rules.stalled_h and not is_locked(site.station.data):
        yield Alarm("service", "the service is not running", min_duration_s=RESTART_ALLOWANCE_S)
    if not (site.station.data / "journal.sqlite").is_file():
        return
    span_s = max(DAY_S, rules.no_scan_h * 3600)
    with JournalReader(site.station.data / "journal.sqlite") as journal:
        recent = journal.changed_since(now_s - span_s)
        newest = journal.newest(CALIBRATION_SCANS)
    yield from _no_scan(rules, recent, since_utc_s, now_s)
    yield from _set_aside(rules, recent, now_s)
    yield from _sigma_calibration(rules, newest)
    yield from _stalled(site, rules, now_s)


def _no_scan(rules: AlarmsSection, recent: list[Entry], since_utc_s: float, now_s: float) -> Iterator[Alarm]:
    from_s = now_s - rules.no_scan_h * 3600
    entries = [entry for entry in recent if entry.changed_utc_s >= from_s]
    if not rules.no_scan_h or since_utc_s > from_s or any(entry.state is State.STORED for entry in entries):
        return
    reason = (
        f"{len(entries)} arrived, none could be stored: see station status"
        if entries
        else "nothing new in the inbox: check the scanner and the transfer"
    )
    yield Alarm("no scan", f"no scan stored for {rules.no_scan_h:g} h: {reason}")


def _stalled(site: Site, rules: AlarmsSection, now_s: float) -> Iterator[Alarm]:
    """Yield an alarm if scans wait unprocessed while no other scan is processed."""
    from_s = now_s - rules.stalled_h * 3600
    with JournalReader(site.station.data / "journal.sqlite") as journal:
        if not rules.stalled_h or journal.changed_since(from_s):
            return
        waiting = [entry for entry in journal.waiting() if entry.state is State.WAITING]
        journaled = journal.summaries()
    stuck = sum(entry.first_seen_utc_s < from_s and not entry.waiting_reason for entry in waiting)
    listing = ScanListing(site, site.scans.inbox, scan_suffixes(site.scans))
    for name, files in listing.scans.items():  # ctime is the arrival: mtime may be older
        arrived_s = min(listing.files[file].st_ctime for file in files)
        stuck += name not in journaled and arrived_s < from_s
    if stuck:
        text = f"{stuck} scans wait, but none was processed for {rules.stalled_h:g} h: the service stalls"
        yield Alarm("stalled", text)


def _set_aside(rules: AlarmsSection, recent: list[Entry], now_s: float) -> Iterator[Alarm]:
    arrived = [entry for entry in recent if entry.first_seen_utc_s >= now_s - DAY_S]
    rejected = [entry for entry in arrived if entry.state is State.SET_ASIDE]
    share = len(rejected) / len(arrived) if len(arrived) >= MIN_ARRIVED_SCANS else 0.0
    if rules.set_aside_share and share >= rules.set_aside_share:
        text = (
            f"{len(rejected)} of the last day's {len(arrived)} scans set aside, most recently:"
            f" {rejected[-1].reason}"
        )
        yield Alarm("set aside", text)


def _sigma_calibration(rules: AlarmsSection, newest: list[Entry]) -> Iterator[Alarm]:
    values = [entry.metrics.get("stable_z_std") for entry in newest if entry.verdict != "unusable"]
    z_std = [float(value) for value in values if value is not None]
    if rules.z_std and len(z_std) >= MIN_CALIBRATION_SCANS and (typical := median(z_std)) > rules.z_std:
        yield Alarm(
            "sigma",
            f"sigma is too small: stable ground scatters by {typical:.2g} times its sigma (median of the"
            f" newest {len(z_std)} scans): check stable ground, mount and logs",
            size=typical,
        )


def _disk(site: Site, rules: AlarmsSection) -> Iterator[Alarm]:
    free_gb = shutil.disk_usage(site.station.data).free / 1e9
    if free_gb < rules.disk_gb:
        yield Alarm("disk", f"{free_gb:.2f} GB free on the disk of the data folder: free some space")
    elif rules.disk_gb:
        try:
            require_disk_space(site)
        except StoreError as error:
            yield Alarm("disk", str(error))


def _inputs(site: Site) -> Iterator[Alarm]:
    """Yield an alarm if areas, flags, stable ground, products or the weather log cannot be used."""
    from station.processing.site_files import load_products  # noqa: PLC0415 - a second of imports
    from station.processing.usable_inputs import usable_site, weather_fault  # noqa: PLC0415

    usable = usable_site(site)
    faults = [*usable.input_faults, *filter(None, [weather_fault(site)]), *load_products(usable)[1]]
    if faults:  # an editor may have saved half a file
        yield Alarm("inputs", "; ".join(faults), min_duration_s=EDITING_ALLOWANCE_S)


def _scanner_moved(site: Site) -> Iterator[Alarm]:
    from station.monitoring.pose_stability import latest_step  # noqa: PLC0415 - imports netCDF4

    if (site.station.data / "series.nc").is_file() and (text := latest_step(site)):
        yield Alarm("moved", text)


def _area_changes(site: Site, rule: ChangeAlarm, assessed_until_utc_s: float | None) -> Iterator[Alarm]:
    """Yield an alarm per area for changes detected at unassessed epochs or at the newest one."""
    from_s = -np.inf if assessed_until_utc_s is None else assessed_until_utc_s - rule.within_h * 3600 - DAY_S
    curves = read_curves(site, from_s)
    unknown_areas = set(rule.areas) - {curve.name for curve in curves}
    if curves and unknown_areas:
        yield Alarm(
            "areas",
            f"alarms.change names areas that are not in areas.file: {', '.join(sorted(unknown_areas))}",
        )
    watched = [curve for curve in curves if not rule.areas or curve.name in rule.areas]
    verbs = ("fell", "rose") if site.grid.plane is None else ("moved in", "moved out")
    for curve in watched:
        detections = change_alarms(
            curve, rule, areas=len(watched), expected_every_s=site.scans.expected_every_s
        )
        is_new = detections.detected & (
            curve.time_s > (np.inf if assessed_until_utc_s is None else assessed_until_utc_s)
        )
        is_new[-1:] |= detections.detected[-1:]
        if is_new.any():
            yield _change_alarm(curve, detections, rule, int(np.flatnonzero(is_new)[-1]), verbs)


def _events(site: Site, rule: EventAlarm, assessed_until_utc_s: float | None) -> Iterator[Alarm]:
    """Yield an alarm per event that is active, or was confirmed by an epoch not assessed yet."""
    from station.archive.derived.event_table import read_events  # noqa: PLC0415 - imports netCDF4

    for event in read_events(site.station.data):
        confirmed_s = datetime.fromisoformat(event.confirmed).timestamp()
        is_new = assessed_until_utc_s is not None and confirmed_s > assessed_until_utc_s
        if event.kind not in rule.kinds or abs(event.volume_m3) < rule.least_m3:
            continue
        if is_new or event.state == "active":
            half_m3 = NORMAL_95 * event.volume_sigma_m3
            where = f"{event.east_m:.0f} {event.north_m:.0f}"
            if site.grid.plane is not None:
                where = f"{event.east_m:.0f} m along, {event.north_m:.0f} m up the face"
            text = (
                f"{event.kind} of {event.volume_m3:+z.0f} m³ (± {half_m3:.0f} m³ at 95 %) on"
                f" {event.area_m2:.0f} m² at {where},"
                f" {event.begin[:16].replace('T', ' ')} UTC"
            )
            yield Alarm(f"event {event.id}", text, size=abs(event.volume_m3))


def change_alarms(
    curve: AreaCurve, rule: ChangeAlarm, *, areas: int, expected_every_s: float
) -> ChangeDetections:
    """Return the epochs at which an area changed; `areas` areas are tested at every scan."""
    tests_per_year = areas * YEAR_S / expected_every_s
    return detect_changes(
        curve.time_s,
        curve.change_m,
        curve.sigma_m,
        within_s=rule.within_h * 3600 + 1,  # includes scans exactly `within_h` apart, to the second
        scans=rule.scans,
        min_change_m=rule.least_m,
        sigmas=threshold_sigmas(rule.false_alarms_per_year, tests_per_year),
    )


def _change_alarm(
    curve: AreaCurve, detections: ChangeDetections, rule: ChangeAlarm, index: int, verbs: tuple[str, str]
) -> Alarm:
    size_m, sigma_m = float(detections.change_m[index]), float(detections.sigma_m[index])
    when = f"{datetime.fromtimestamp(curve.time_s[index], UTC):%Y-%m-%d %H:%M}"
    text = (
        f"{curve.name} {verbs[int(size_m > 0)]} by {abs(size_m):.3g} m"
        f" (± {SIGNIFICANT_SIGMAS * sigma_m:.2g} m at 95 %) in the {rule.within_h:g} h before {when} UTC"
    )
    return Alarm(f"change in {curve.name}", text, size=abs(size_m))
