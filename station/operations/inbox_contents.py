"""What lies in an inbox that the station does not read, and the lines of the site file that let it in."""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from station.config import Site
from station.inbox.listing import is_scan
from station.operations.site_plausibility import LevelAndMessage
from station.readers.formats.conversion import scan_suffixes
from station.readers.scan import TEXT_SUFFIXES, suffixes
from station.scan_names import folder_depth, resolution_s, scan_stem, start_in_name

MAX_FILES = 20_000  # that are looked at
MAX_DEPTH = 4  # folders below the inbox
HOUR_S = 3600.0
MANUAL = "docs/how-to/your-own-files.md"
# Usual patterns of names; those with a `*` match more and come last.
PATTERNS = (
    "%y%m%d_%H%M%S", "%Y%m%d_%H%M%S", "%Y%m%dT%H%M%SZ", "%Y%m%d%H%M%S", "%Y-%m-%d_%H-%M-%S",
    "%Y-%m-%dT%H-%M-%S", "%Y_%m_%d_%H_%M_%S", "%Y%m%d_%H%M", "%Y-%m-%d_%H-%M",
    "%y%m%d %H%M%S", "%Y%m%d %H%M%S", "%Y-%m-%d %H-%M-%S", "%Y-%m-%d %H.%M.%S", "%Y-%m-%d %H-%M",
)  # fmt: skip
FOLDER_PATTERNS = ("%Y-%m-%d", "%Y%m%d", "%Y_%m_%d", "%y%m%d")
# Commands that convert formats which the station does not read, by their suffix.
CONVERTED = {
    ".rxp": (
        "pdal", "translate", "{in}", "{out}", "ferry", "--filters.ferry.dimensions=InternalTime=>GpsTime",
        "--readers.rxp.sync_to_pps=false", "--writers.las.minor_version=4", "--writers.las.dataformat_id=6",
        "--writers.las.extra_dims=Reflectance=float,Roll=float,Pitch=float",
        "--writers.las.scale_x=0.00025", "--writers.las.scale_y=0.00025", "--writers.las.scale_z=0.00025",
    ),
    **dict.fromkeys((".zfs", ".fls", ".ptx", ".lvx"), ("COMMAND", "{in}", "{out}")),
}  # fmt: skip


def inbox_findings(site: Site) -> Iterator[LevelAndMessage]:
    """Yield what of the inbox is not read, and the lines that would let it in."""
    files = list(files_below(site.scans.inbox))
    known = scan_suffixes(site.scans)
    depth, scans, others = folder_depth(site.scans.pattern), list[str](), list[str]()
    for path in files:
        name = path.relative_to(site.scans.inbox).as_posix()
        if is_scan(path.name, known):
            (scans if name.count("/") == depth else others).append(name)
    yield from _other_formats(
        site, [path for path in files if not is_scan(path.name, known)], has_scans=bool(scans)
    )
    if others:
        where = "in folders of scans.name only" if depth else "in the inbox itself, not below it"
        message = f"{len(others)} scans, such as {others[0]}, are not read: they are looked for {where}"
        pattern = fitting_pattern(others)
        yield "warning", f'{message}: name = "{pattern}" would, see {MANUAL}' if pattern else message
    yield from _names(site, scans)
    if site.scans.convert is not None and shutil.which(site.scans.convert[0]) is None:
        yield "fault", f"scans.convert: {site.scans.convert[0]} is not found, or may not be run"


def files_below(folder: Path) -> Iterator[Path]:
    """Yield the files of a folder and those below it, by their names; hidden ones and links are left out."""
    count = 0
    for parent, folders, names in os.walk(folder):
        depth = len(Path(parent).relative_to(folder).parts)
        folders[:] = sorted(name for name in folders if not name.startswith(".")) if depth < MAX_DEPTH else []
        for name in sorted(names):
            if name.startswith(".") or not _is_regular(Path(parent) / name):
                continue
            count += 1
            if count > MAX_FILES:
                return
            yield Path(parent) / name


def _is_regular(path: Path) -> bool:
    """Return True for a file that can be opened without waiting for another program."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:  # removed since it was listed
        return False


def _other_formats(site: Site, others: list[Path], *, has_scans: bool) -> Iterator[LevelAndMessage]:
    """Yield the files of formats that could be read, by their suffix."""
    sections = (site.inclination, site.registration)
    beside = tuple(section.suffix for section in sections if section and section.suffix)
    counts = Counter(path.suffix.lower() for path in others if not path.name.endswith(beside))
    for suffix, count in counts.most_common():
        command = json.dumps(CONVERTED.get(suffix, ())[:4])
        advice = f'suffix = "{suffix}" and convert = {command[:-1]}, …]' if suffix in CONVERTED else ""
        if suffix in suffixes() or (suffix in TEXT_SUFFIXES and not has_scans and count > 1):
            advice = f'suffix = "{suffix}"'
        if advice:
            yield "warning", f"{count} {suffix} files are not read: [scans] {advice}, see {MANUAL}"


def _names(site: Site, scans: list[str]) -> Iterator[LevelAndMessage]:
    """Yield a warning if names of scans do not match `scans.name`, with a pattern that they match.

    Another one if several files have the same start, but are no epoch.
    """
    same, epoch = epoch_advice(scans, site.scans.pattern)
    if same and site.epoch is None:
        message = f"{' and '.join(same)} have the same start: such files are one epoch"
        yield "warning", f'{message} with [epoch] name = "{epoch}", see {MANUAL}'
    names = [name for name in scans if start_in_name(name, site.scans.pattern) is None]
    if not names:
        return
    message = (
        f'{len(names)} of {len(scans)} names, such as {names[0]}, do not match name = "{site.scans.name}"'
    )
    pattern = fitting_pattern(names)
    advice = f'name = "{pattern}" would' if pattern else f"the start of {scan_stem(names[0])} must be in it"
    yield "warning", f"{message}: {advice}"


def epoch_advice(names: list[str], pattern: str) -> tuple[list[str], str]:
    """Return two scans with the same start, and the name of epochs that joins such; [], '' without."""
    starts = {name: start_in_name(name, pattern) for name in names}
    counts = Counter(start for start in starts.values() if start)
    same = [name for name, start in starts.items() if start and counts[start] > 1][:2]
    if not same:
        return [], ""
    return same, "%Y-%m-%d" if resolution_s(pattern) > HOUR_S else "%Y%m%d_%H%M%S"


def fitting_pattern(names: list[str]) -> str | None:
    """Return a pattern that all names match, at the depth of the first one; None if there is none."""
    depth = names[0].count("/")
    names = [name for name in names if name.count("/") == depth]
    files = (*PATTERNS, *(f"*{pattern}" for pattern in PATTERNS), *(f"*{pattern}*" for pattern in PATTERNS))
    candidates = [
        *("*/" * depth + pattern for pattern in files),
        *(
            "*/" * level + f"{mark}{date}{mark}" + "/*" * (depth - level)
            for mark in ("", "*")
            for date in FOLDER_PATTERNS
            for level in range(depth)
        ),
    ]
    fitting = (p for p in candidates if all(start_in_name(name, p) is not None for name in names))
    return next(fitting, None)
