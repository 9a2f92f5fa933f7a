"""Status of a station for `station status`: counts, waiting scans, the last stored scan, faults."""

from __future__ import annotations

import math
import shutil
import time
from typing import TYPE_CHECKING, Any

from station.errors import NotReadyError, StationError, StoreError
from station.inbox.journal_reader import Entry, JournalReader, State
from station.inbox.listing import ScanListing, safe_name
from station.inbox.lock import is_locked, pause_reason
from station.monitoring.alarm_state import active
from station.monitoring.preconditions import clock_problem, format_utc, require_disk_space
from station.readers.formats.conversion import scan_suffixes

if TYPE_CHECKING:
    from pathlib import Path

    from station.config import Site

MAX_LISTED = 50  # scans of a kind, in the text
RENEWALS = {  # in the background, by name
    "mirror": "the mirror is",
    "levels": "the files of levels are",
    "derived": "the files of areas, products, events and blocks are",
}
Status = dict[str, Any]  # printed by `station status --json`


def status(site: Site) -> Status:
    """Return the status: counts, waiting and rejected scans with reasons, quality of the last scan, faults.

    Works with or without a running service. Raises StoreError if the journal cannot be read.
    """
    from station.processing.site_files import load_products  # noqa: PLC0415 - a second of imports
    from station.processing.usable_inputs import usable_site  # noqa: PLC0415

    site, data = usable_site(site), site.station.data
    with JournalReader(data / "journal.sqlite") as journal:
        waiting = journal.waiting()
        queue = _queue_status(site, journal, waiting)
        counts = journal.counts()
        last = journal.last_stored()
    queued = [entry.epoch for entry in waiting if entry.epoch]
    return {
        "station": site.station.id,
        "name": site.station.name,
        "service": _service_state(data),
        "counts": counts,
        "waiting": queue["waiting"],
        "set_aside": queue["set_aside"],
        "last": _last_scan(last) if last else None,
        "moved": _last_pose_step(site),
        "alarms": active(data),
        "stale": _count_outdated(site, queued),
        "series": str(data / "series.nc") if (data / "series.nc").exists() else None,
        "disk_free_gb": round(shutil.disk_usage(data).free / 1e9, 2) if data.is_dir() else None,
        "faults": [*queue["faults"], *filter(None, [_log_clock_problem(site)]), *load_products(site)[1]],
    }


def queue_status(site: Site) -> Status:
    """Return the part of `status` that needs no series: waiting scans, scans set aside, faults.

    `input_faults` of the site are among the faults.
    """
    with JournalReader(site.station.data / "journal.sqlite") as journal:
        return _queue_status(site, journal, journal.waiting())


def _queue_status(site: Site, journal: JournalReader, entries: list[Entry]) -> Status:
    waiting = [_waiting_scan(entry) for entry in entries]
    set_aside = [
        {"scan": entry.name, "reason": entry.reason, "since": format_utc(entry.changed_utc_s)}
        for entry in journal.rows(State.SET_ASIDE)
    ]
    inbox_problem = ""
    try:
        listing = ScanListing(site, site.scans.inbox, scan_suffixes(site.scans))
        names = {*listing.scans, *(safe_name(name) for name in listing.rejected)}
    except NotReadyError as error:
        names, inbox_problem = set(), str(error)
    running = is_locked(site.station.data)
    new_scans_wait_for = "the service to read it" if running else "the service, which is not running"
    waiting += [
        {"scan": name, "state": "new", "for": new_scans_wait_for, "next_try": None}
        for name in journal.unrecorded(names)
    ]
    from station.processing.usable_inputs import weather_fault  # noqa: PLC0415 - as in `status`

    faults = (
        inbox_problem,
        _disk_space_problem(site),
        clock_problem(site.station.data, time.time()),
        *site.input_faults,
        weather_fault(site),
        *(_renewal_fault(site, name) for name in wanted_renewals(site)),
        *_publish_faults(site),
        pause_reason(site.station.data),
    )
    return {
        "waiting": waiting,
        "set_aside": set_aside,
        "faults": [*dict.fromkeys(fault for fault in faults if fault)],
    }


def wanted_renewals(site: Site) -> list[str]:
    """Return the names in RENEWALS of what the service renews at a site."""
    is_wanted = {"mirror": site.mirror is not None, "levels": site.products.levels, "derived": True}
    return [name for name in RENEWALS if is_wanted[name]]


def fault_file(site: Site, name: str) -> Path:
    """Return the file that says why the service could not renew the files of RENEWALS with this name."""
    return site.station.data / f".{name}_fault"


def _renewal_fault(site: Site, name: str) -> str:
    """Return why the service could not renew some files; '' if it could."""
    try:
        fault = fault_file(site, name).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""
    return fault and f"{RENEWALS[name]} not up to date: {fault}"


def publish_folder(site: Site) -> Path:
    """Return the folder of `station publish`; its file `faults` has a line for all that failed last time."""
    return site.station.data / "publish"


def _publish_faults(site: Site) -> list[str]:
    try:
        text = (publish_folder(site) / "faults").read_text(encoding="utf-8") if site.publish else ""
    except (OSError, ValueError):
        return []
    return [f"not published: {line}" for line in text.splitlines()]


def _service_state(data: Path) -> str:
    if not is_locked(data):
        return "not running"
    return "paused" if pause_reason(data) else "running"


def format_status(report: Status) -> str:
    """Return a status as text, one fact per line."""
    counts, waiting = report["counts"], len(report["waiting"])
    lines = [
        f"{report['name'] or report['station']}: service {report['service']}",
        f"scans    {counts['stored']} stored, {len(report['set_aside'])} set aside, {waiting} waiting",
    ]
    if last := report["last"]:
        metrics = " ".join(f"{key}={value}" for key, value in last["figures"].items() if value is not None)
        reason = f" ({last['reason']})" if last["reason"] else ""
        lines.append(f"last     {last['scan']} of {last['start']}: {last['verdict']}{reason} {metrics}")
    if outdated := report["stale"]:
        lines.append(
            f"stale    {outdated} epochs with an outdated SOP, setting, flag or reference:"
            " run station reprocess"
        )
    free_gb = report["disk_free_gb"]
    lines.append(f"disk     {f'{free_gb:.2f} GB free' if free_gb is not None else 'no data folder yet'}")
    lines.append(f"series   {report['series'] or 'none yet'}")
    lines += [f"moved    {report['moved']}"] if report["moved"] else []
    lines += [f"alarm    {text}" for text in report["alarms"].values()]
    lines += [f"fault    {fault}" for fault in report["faults"]]
    for scan in report["waiting"][:MAX_LISTED]:
        next_try = f", next try {scan['next_try']}" if scan["next_try"] else ""
        lines.append(f"waits    {scan['scan']}: {scan['for'] or 'its turn'}{next_try}")
    if (left_out := waiting - MAX_LISTED) > 0:
        lines.append(f"waits    and {left_out} more: station status --json")
    lines += [f"aside    {scan['scan']}: {scan['reason']}" for scan in report["set_aside"][-MAX_LISTED:]]
    if (left_out := len(report["set_aside"]) - MAX_LISTED) > 0:
        lines.append(f"aside    and {left_out} more: station status --json")
    return "\n".join(lines)


def _waiting_scan(entry: Entry) -> dict[str, str | None]:
    next_try = format_utc(entry.next_try_utc_s) if entry.next_try_utc_s is not None else None
    return {
        "scan": entry.name,
        "state": entry.state.value,
        "for": entry.waiting_reason or ("its turn" if not entry.ahead else "its turn, to be measured again"),
        "next_try": next_try,
    }


def _last_scan(entry: Entry) -> Status:
    metrics = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value  # JSON knows no NaN
        for key, value in entry.metrics.items()
    }
    return {
        "scan": entry.name,
        "start": format_utc(entry.start_utc_s) if entry.start_utc_s is not None else None,
        "stored": format_utc(entry.changed_utc_s),
        "verdict": entry.verdict,
        "reason": entry.reason,
        "epoch": entry.epoch,
        "reference": entry.reference,
        "figures": metrics,
    }


def _last_pose_step(site: Site) -> str:
    if not (site.station.data / "series.nc").is_file():
        return ""
    from station.monitoring.pose_stability import latest_step  # noqa: PLC0415 - a second of imports

    try:
        return latest_step(site)
    except (StoreError, ValueError) as error:
        return str(error)


def _log_clock_problem(site: Site) -> str:
    if not (site.adjusts and (site.station.data / "series.nc").is_file()):
        return ""
    from station.monitoring.log_clock import log_clock_offset  # noqa: PLC0415 - as above

    try:
        return log_clock_offset(site)
    except (StoreError, ValueError) as error:  # of a text, if series.nc is damaged
        return str(error)


def _count_outdated(site: Site, queued: list[str]) -> int | None:
    """Return the number of epochs whose settings are outdated; None if it cannot be determined now."""
    if not (site.station.data / "series.nc").is_file():
        return 0
    from station.processing.staleness import count_outdated  # noqa: PLC0415 - a second of imports

    try:
        return count_outdated(site, queued)
    except (StationError, ValueError):
        return None


def _disk_space_problem(site: Site) -> str:
    try:
        require_disk_space(site)
    except StoreError as error:
        return str(error)
    return ""
