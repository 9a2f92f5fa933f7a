"""What lies in an inbox that the station does not read, and the lines of the site file that let it in."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from station.config import Site
from station.inbox.listing import is_scan
from station.operations.site_plausibility import LevelAndMessage
from station.readers.formats.conversion import scan_suffixes
from station.readers.scan import TEXT_SUFFIXES, suffixes
from station.scan_names import scan_stem, start_in_name

MAX_FILES = 20_000  # that are looked at
MAX_DEPTH = 4  # folders below the inbox
MANUAL = "docs/how-to/your-own-files.md"
# Usual patterns of names; those with a `*` match more and come last.
PATTERNS = (
    "%y%m%d_%H%M%S", "%Y%m%d_%H%M%S", "%Y%m%dT%H%M%SZ", "%Y%m%d%H%M%S", "%Y-%m-%d_%H-%M-%S",
    "%Y-%m-%dT%H-%M-%S", "%Y_%m_%d_%H_%M_%S", "%Y%m%d_%H%M", "%Y-%m-%d_%H-%M",
)  # fmt: skip
CONVERTED = {
    ".rxp": 'suffix = ".rxp" and convert = ["pdal", "translate", "{in}", "{out}", …]',
    ".zfs": 'suffix = ".zfs" and convert = [COMMAND, "{in}", "{out}"]',
    ".fls": 'suffix = ".fls" and convert = [COMMAND, "{in}", "{out}"]',
    ".ptx": 'suffix = ".ptx" and convert = [COMMAND, "{in}", "{out}"]',
    ".lvx": 'suffix = ".lvx" and convert = [COMMAND, "{in}", "{out}"]',
}


def inbox_findings(site: Site) -> Iterator[LevelAndMessage]:
    """Yield what of the inbox is not read, and the lines that would let it in."""
    files = list(files_below(site.scans.inbox))
    known = scan_suffixes(site.scans)
    scans = [path for path in files if is_scan(path.name, known) and path.parent == site.scans.inbox]
    yield from _other_formats(
        site, [path for path in files if not is_scan(path.name, known)], has_scans=bool(scans)
    )
    deeper = [path for path in files if is_scan(path.name, known) and path.parent != site.scans.inbox]
    if deeper:
        example = deeper[0].relative_to(site.scans.inbox)
        message = f"{len(deeper)} scans lie in folders below it, such as {example}: only the inbox itself is"
        yield "warning", f"{message} watched; move or hard-link them, see {MANUAL}"
    yield from _names(site, scans or deeper)
    if site.scans.convert is not None and shutil.which(site.scans.convert[0]) is None:
        yield "fault", f"scans.convert: {site.scans.convert[0]} is not found, or may not be run"


def files_below(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder and those below it, by their names; hidden ones are left out."""
    count = 0
    for parent, folders, names in os.walk(folder):
        depth = len(Path(parent).relative_to(folder).parts)
        folders[:] = sorted(name for name in folders if not name.startswith(".")) if depth < MAX_DEPTH else []
        for name in sorted(names):
            if name.startswith("."):
                continue
            count += 1
            if count > MAX_FILES:
                return
            yield Path(parent) / name


def _other_formats(site: Site, others: list[Path], *, has_scans: bool) -> Iterator[LevelAndMessage]:
    """Yield the files of formats that could be read, by their suffix."""
    log_suffix = site.inclination.suffix if site.inclination else ""
    counts = Counter(
        path.suffix.lower() for path in others if not (log_suffix and path.name.endswith(log_suffix))
    )
    for suffix, count in counts.most_common():
        advice = CONVERTED.get(suffix, "")
        if suffix in suffixes() or (suffix in TEXT_SUFFIXES and not has_scans and count > 1):
            advice = f'suffix = "{suffix}"'
        if advice:
            yield "warning", f"{count} {suffix} files are not read: [scans] {advice}, see {MANUAL}"


def _names(site: Site, scans: list[Path]) -> Iterator[LevelAndMessage]:
    """Yield a warning if names of scans do not match `scans.name`, with a pattern that they match."""
    names = [path.name for path in scans if start_in_name(path.name, site.scans.pattern) is None]
    if not names:
        return
    message = (
        f'{len(names)} of {len(scans)} names, such as {names[0]}, do not match name = "{site.scans.name}"'
    )
    candidates = (*PATTERNS, *(f"*{pattern}" for pattern in PATTERNS), *(f"*{p}*" for p in PATTERNS))
    fitting = (p for p in candidates if all(start_in_name(name, p) is not None for name in names))
    pattern = next(fitting, None)
    advice = f'name = "{pattern}" would' if pattern else f"the start of {scan_stem(names[0])} must be in it"
    yield "warning", f"{message}: {advice}"
