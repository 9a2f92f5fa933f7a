"""What the tables of the site file are made of: their base class, and the types of their values."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from ipaddress import ip_address
from typing import Annotated, Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field

from station.scan_names import start_in_name

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Arm = Annotated[float, Field(ge=-2, le=2)]
Place = Annotated[float, Field(ge=-1e8, le=1e8)]  # metres on a map; no map of the Earth is larger


def without_required(schema: dict[str, Any]) -> None:
    """Remove the required keys from a JSON Schema: those of a known instrument have values."""
    schema.pop("required", None)


def _in_utc(time: datetime) -> datetime:
    return time.astimezone(UTC)


def require_projected(crs: str) -> str:
    """Return a CRS; raise ValueError unless it is known, projected, and in metres."""
    from pyproj import CRS  # noqa: PLC0415 - a tenth of a second that not every command needs
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    advice = "name a projected CRS in metres, such as EPSG:32632, or omit it for a local map"
    try:
        parsed = CRS.from_user_input(crs)
    except CRSError as error:
        raise ValueError(f"unknown to PROJ: {advice}") from error
    horizontal = parsed.sub_crs_list[0] if parsed.is_compound else parsed
    if not horizontal.is_projected:
        in_degrees = ", in degrees" if horizontal.is_geographic else ""
        raise ValueError(f"is a {horizontal.type_name}{in_degrees}: {advice}")
    units = {axis.unit_name for axis in horizontal.axis_info if axis.unit_conversion_factor != 1.0}
    if units:
        raise ValueError(f"is in {' and '.join(sorted(units))}: {advice}")
    return crs


def require_time_pattern(pattern: str) -> str:
    """Return a pattern of scan names; raise ValueError unless times survive being written and read by it."""
    if any(folder in {"", ".", ".."} for folder in pattern.split("/")):
        raise ValueError("folders are those below the inbox, as in %Y-%m-%d/*")
    time = datetime(2025, 7, 15, 13, 14, 15, tzinfo=UTC)
    try:
        datetime.strptime(time.strftime(pattern), pattern)  # noqa: DTZ007 - the pattern may contain a zone
        if start_in_name(time.strftime(pattern), pattern) is None:
            raise ValueError("a name written by it does not match it")  # noqa: TRY301 - as those of strptime
    except (ValueError, re.error, OverflowError) as error:
        reason = str(error)
        if "redefinition" in reason:
            reason = "a field of the time stands twice: put * for one of them, as in */%y%m%d_%H%M%S"
        raise ValueError(f"not a pattern of times, such as %y%m%d_%H%M%S: {reason}") from error
    return pattern


def require_epoch_name(pattern: str) -> str:
    """Return a pattern of epoch names; raise ValueError unless it writes plain names that state a date."""
    if not re.fullmatch(r"[A-Za-z0-9%_-]+", pattern):
        raise ValueError("an epoch's name has letters, digits, _ and - only, as %Y-%m-%d or %Y%m%d_%H")
    start = start_in_name(datetime(2025, 7, 15, tzinfo=UTC).strftime(require_time_pattern(pattern)), pattern)
    if start is None or start.year != 2025:
        raise ValueError("an epoch's name must state the year, as %Y-%m-%d or %Y%m%d_%H")
    return pattern


def _require_zone(zone: str) -> str:
    try:
        ZoneInfo(zone)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError('no time zone: give its name, such as "Europe/Vienna", or "UTC"') from error
    return zone


def require_suffix(suffix: str) -> str:
    """Return a suffix with its dot; raise ValueError unless a file name can end with it."""
    dotted = f".{suffix.removeprefix('.')}"
    if not re.fullmatch(r"(\.[A-Za-z0-9]+){1,2}", dotted):
        raise ValueError('no end of a file name: give one such as ".rxp"')
    return dotted


def on_loopback(address: str) -> str:
    """Return an address and port; raise ValueError unless they are of this machine only."""
    host, _, port = address.rpartition(":")
    try:
        is_loopback = host == "localhost" or ip_address(host.strip("[]")).is_loopback
        is_port = 0 < int(port) < 65536
    except ValueError:
        is_loopback = is_port = False
    if not (is_loopback and is_port):
        raise ValueError('give a loopback address and a port: "127.0.0.1:9750"')
    return address


Zone = Annotated[str, AfterValidator(_require_zone)]
Utc = Annotated[AwareDatetime, AfterValidator(_in_utc)]


class Section(BaseModel):
    """A table of the site file: no unknown keys, immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
