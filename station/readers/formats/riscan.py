"""RiSCAN PRO projects (.rsp, XML): SOPs, POP, scanner, and the atmosphere that the scanner assumed."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree as ET

from station.errors import ConfigError
from station.quantities import Air, Floats
from station.readers.regular_file import read_text
from station.readers.sop import checked_matrix
from station.readers.weather import VALID_RANGES
from station.scan_names import start_in_name

PROJECT_FILE = "project.rsp"
SCAN_NAME = re.compile(r"(\d{6}_\d{6})(?:\D.*)?")  # of scans, by their start


@dataclass(frozen=True)
class ScanPosition:
    """A scan position of a project."""

    name: str
    sop: Floats  # (4, 4)
    instrument: str  # "" if unknown
    air: Air | None
    first_scan: str  # its name, "" if no scan is left
    start_utc: datetime | None  # of that scan, by its name
    extent_m: float  # of its scans from the scanner, 0 if unknown
    files: str = ""  # pattern of its scans, if each epoch has scans from several positions


@dataclass(frozen=True)
class Project:
    """What a project tells about a station."""

    name: str
    pop: Floats | None  # (4, 4); None if the project has no place on the Earth
    positions: tuple[ScanPosition, ...]


def read_project(path: Path) -> Project:
    """Read a project file, or the one in a project folder; raise ConfigError if it is none."""
    if path.is_dir():
        path = path / PROJECT_FILE
    try:
        root = ET.fromstring(read_text(path))  # noqa: S314 - expat limits expansion
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (ET.ParseError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a RiSCAN project: {error}") from error
    positions = tuple(_position(node, path) for node in root.iter("scanposition") if _is_kept(node))
    if root.tag != "project" or not positions:
        raise ConfigError(f"{path}: not a RiSCAN project with scan positions")
    pop = _matrix(root.find("pop"), path)
    is_placed = pop is not None and math.hypot(*pop[:3, 3].tolist()) > 1e6  # an identity until it is placed
    return Project(root.get("name", path.stem), pop if is_placed else None, positions)


def _is_kept(node: ET.Element) -> bool:
    """Return False for what the user has deleted."""
    return "deleted" not in node.get("states", "")


def _position(node: ET.Element, path: Path) -> ScanPosition:
    name = node.get("name", "")
    sop = _matrix(node.find("sop"), path)
    if sop is None:
        raise ConfigError(f"{path}: scan position {name} has no SOP")
    single = node.find("singlescans")
    scans = [scan for scan in (single.iter("scan") if single is not None else ()) if _is_kept(scan)]
    matches = [match for scan in scans if (match := SCAN_NAME.fullmatch(scan.get("name", "")))]
    first = min((match[1] for match in matches), default="")
    extents = [_number(scan.findtext("geometryinfo/maxpolar")) for scan in scans]
    instruments = [node.findtext("ppm_instrument"), *(scan.findtext("instrument") for scan in scans)]
    return ScanPosition(
        name=name,
        sop=sop,
        instrument=next((text.strip() for text in instruments if text and text.strip()), ""),
        air=_air(node),
        first_scan=first,
        start_utc=start_in_name(first, "%y%m%d_%H%M%S"),
        extent_m=max(filter(math.isfinite, extents), default=0.0),
    )


def _matrix(node: ET.Element | None, path: Path) -> Floats | None:
    text = None if node is None else node.findtext("matrix")
    return None if not text else checked_matrix(" ".join(text.split()), path)


def _number(text: str | None) -> float:
    """Return the first number of a text, NaN without one."""
    try:
        return float((text or "").split()[0])
    except (ValueError, IndexError):
        return math.nan


def _air(node: ET.Element) -> Air | None:
    """Return the atmosphere that was set; the vapour pressure becomes humidity by the Magnus formula.

    Source: WMO-No. 8 (2021), annex 4.B.
    """
    keys = "ppm_air_temperature", "ppm_air_pressure", "ppm_moisture_pressure"
    temperature_c, pressure_hpa, vapour_hpa = (_number(node.findtext(key)) for key in keys)
    limited = zip((temperature_c, pressure_hpa), VALID_RANGES[:2], strict=True)
    if not (vapour_hpa >= 0 and all(low <= value <= high for value, (low, high) in limited)):  # also NaN
        return None
    saturation_hpa = 6.112 * math.exp(17.62 * temperature_c / (243.12 + temperature_c))
    return Air(temperature_c, pressure_hpa, min(100.0 * vapour_hpa / saturation_hpa, 100.0))
