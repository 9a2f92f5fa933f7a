"""Findings on settings that are valid, but contradict each other, a data sheet or the rights of the user."""

from __future__ import annotations

import importlib.util
import math
import os
import pwd
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pyproj.crs import Datum  # type: ignore[attr-defined] # documented there, but not declared
from pyproj.exceptions import CRSError

from station.archive.derived.product_files import units_of
from station.config import Site
from station.quantities import Bools
from station.scanners import SCANNERS
from station.sections.product import product_key

SERVICE_USER = "station"  # of the systemd unit
MAX_SCANNER_OFFSET_M = 500.0  # from map.origin; a larger project frame is unusual
MAX_OVERRIDE_RATIO = 5.0  # of a value of the scanner and its data sheet
MAX_STABLE_SHARE = 0.1  # of the cells of an area
MAX_WEATHER_AHEAD_S = 600.0
MAX_TILT_DEVIATION_DEG = 0.5  # of log and SOP: far more than a sensor's error, less than a wrong SOP

LevelAndMessage = tuple[str, str]  # level (warning, fault), message


def alarm_findings(site: Site, area_names: set[str]) -> Iterator[LevelAndMessage]:
    """Yield what keeps alarms from being raised or sent."""
    if site.alarms is None:
        return
    unknown = sorted(set(site.alarms.change.areas) - area_names) if site.alarms.change else []
    for name in unknown:
        yield "fault", f"alarms.change.areas: no area {name!r}; there are {', '.join(sorted(area_names))}"
    kinds = {section.key: section.kind for section in site.product}
    for rule in site.alarms.product:
        units = units_of(kinds[product_key(rule.product)])
        if rule.quantity not in units:
            yield "fault", f"alarms.product: {rule.product} has no {rule.quantity}; it has {', '.join(units)}"
    targets = {*site.alarms.targets, *filter(None, [site.alarms.digest])}
    if targets and importlib.util.find_spec("apprise") is None:
        yield "fault", f"{', '.join(sorted(targets))}: sending needs pip install 'tls-station[alarms]'"


def overlap_findings(areas: dict[str, Bools], stable: Bools) -> Iterator[LevelAndMessage]:
    """Yield areas of interest that lie on the ground declared stable: their change is taken for an error.

    An area that lies on it altogether is a control, unless all areas do.
    """
    shares = {name: float((cells & stable).sum()) / max(1, int(cells.sum())) for name, cells in areas.items()}
    has_moving = any(share <= MAX_STABLE_SHARE for share in shares.values())
    for name, share in shares.items():
        if share > MAX_STABLE_SHARE and not (share == 1.0 and has_moving):
            yield "warning", f"{share:.0%} of the area {name} is declared stable: its change is adjusted away"


def position_findings(
    site: Site, name: str, position_m: tuple[float, float, float], origin_m: tuple[float, float, float] | None
) -> Iterator[LevelAndMessage]:
    """Yield a warning if an SOP places the scanner far from `map.origin`, the origin of its frame."""
    if site.map.origin is None or origin_m is None:
        return
    distance_m = math.dist(position_m, origin_m)
    if distance_m > MAX_SCANNER_OFFSET_M:
        yield (
            "warning",
            f"{name}: places the scanner {distance_m:,.0f} m from map.origin: is its translation in metres?",
        )


def plane_findings(site: Site, above_m: float) -> LevelAndMessage:
    """Return how the plane of the grid lies, above which the scanner stands by `above_m` along its normal."""
    plane = site.grid_cells.plane
    described = f"on a plane that faces {plane.facing_deg:g}° and dips {plane.dip_deg:g}°"
    if above_m <= 0:
        advice = "facing_deg is the azimuth from the face towards the scanner"
        return "fault", f"{described}: the scanner is {-above_m:,.1f} m behind it: {advice}"
    return "ok", f"{described}, {above_m:,.1f} m from the scanner; change is positive towards it"


def setting_findings(site: Site) -> Iterator[LevelAndMessage]:
    """Yield settings that other programs will not understand, or far from the data sheet of the scanner."""
    datum = site.map.vertical_datum
    if datum:
        try:
            known = Datum.from_name(datum).name
        except CRSError:
            known = ""
        if not known:
            yield "warning", f"map.vertical_datum = {datum!r}: no datum of EPSG, as other programs expect"
        elif known != datum:
            yield "warning", f"map.vertical_datum = {datum!r}: write its name in EPSG, {known!r}"
    for name, scanner in site.scanners.items():
        for key, typical in SCANNERS.get(scanner.model, {}).items():
            value = getattr(scanner, key)
            is_number = isinstance(typical, (int, float)) and isinstance(value, (int, float)) and typical > 0
            if is_number and not typical / MAX_OVERRIDE_RATIO <= value <= typical * MAX_OVERRIDE_RATIO:
                yield "warning", f"{name}.{key} = {value:g}, but a {scanner.model} has {typical:g}"


def tilt_findings(
    sop: str, expected_deg: tuple[float, float], log_deg: tuple[float, float]
) -> LevelAndMessage:
    """Return a comparison of roll and pitch in an SOP and in the log of a scan under it."""
    message = (
        f"roll {log_deg[0]:.2f}°, pitch {log_deg[1]:.2f}° in the newest log, {expected_deg[0]:.2f}°,"
        f" {expected_deg[1]:.2f}° in {sop}"
    )
    if math.dist(expected_deg, log_deg) <= MAX_TILT_DEVIATION_DEG:
        return "ok", message
    return "warning", f"{message}: another SOP, a moved mount, or a wrong log?"


def double_tilt_findings(
    sop: str, expected_deg: tuple[float, float], log_deg: tuple[float, float]
) -> Iterator[LevelAndMessage]:
    """Yield a warning if an SOP contains the tilt of the log, which an absolute mode applies once more."""
    is_tilted = math.hypot(*expected_deg) > MAX_TILT_DEVIATION_DEG
    if is_tilted and math.dist(expected_deg, log_deg) <= MAX_TILT_DEVIATION_DEG:
        tilt = f"roll {expected_deg[0]:.2f}°, pitch {expected_deg[1]:.2f}°"
        advice = 'inclination.mode = "absolute" applies it again: is it "relative"?'
        yield "warning", f"{sop} contains the tilt of the mount, {tilt}, and {advice}"


def weather_time_findings(last_utc_s: float) -> Iterator[LevelAndMessage]:
    """Yield a warning if the weather log ends in the future; one that ends too early degrades the scan."""
    ahead_s = last_utc_s - time.time()
    if ahead_s > MAX_WEATHER_AHEAD_S:
        yield "warning", f"ends {ahead_s / 3600:.1f} h in the future: wrong utc_offset_h, or a wrong clock?"


def rights_findings(site: Site, files: list[Path], user: str = SERVICE_USER) -> Iterator[LevelAndMessage]:
    """Yield what the user of the service may not do; root, who may do anything, takes its place."""
    if os.geteuid() != 0:
        return
    try:
        account = pwd.getpwnam(user)
    except KeyError:
        yield "warning", f"run as root, who may read anything: run it as the user of the service (not {user})"
        return
    with _effective_user(account):
        for file in files:
            if not os.access(file, os.R_OK, effective_ids=True):
                yield "fault", f"{file}: the user {user} may not read it"
        inbox, data = site.scans.inbox, site.station.data
        if not os.access(inbox, os.R_OK | os.X_OK, effective_ids=True):
            yield "fault", f"{inbox}: the user {user} may not read the inbox"
        existing = next((parent for parent in (data, *data.parents) if os.access(parent, os.F_OK)), data)
        if not os.access(existing, os.W_OK | os.X_OK, effective_ids=True):
            yield "fault", f"{existing}: the user {user} may not write there"


@contextmanager
def _effective_user(account: pwd.struct_passwd) -> Iterator[None]:
    """Act as another user; for root only."""
    gid, groups = os.getegid(), os.getgroups()
    os.setgroups(os.getgrouplist(account.pw_name, account.pw_gid))
    os.setegid(account.pw_gid)
    os.seteuid(account.pw_uid)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(gid)
        os.setgroups(groups)
