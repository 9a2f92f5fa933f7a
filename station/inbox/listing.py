"""What lies in an inbox or in an archive of raw scans: the scans, each of one file or of several."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

from station.config import Site
from station.errors import NotReadyError
from station.scan_names import SEPARATOR, composed, epoch_name, folder_depth, path_stem, start_in_name

# Names of letters of any language, without control characters or wildcards.
_SAFE_PART = r"[^\W_](?:[\w.,+=@~() -]*[\w.,+=@~()-])?"
_SAFE_NAME = re.compile(rf"{_SAFE_PART}(/{_SAFE_PART})*")
MAX_NAME_BYTES = 100  # of a file or folder: `<name>.txt` must be a valid file name
_FILE_TYPES = {
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@dataclass(frozen=True)
class ScanFile:
    """A scan as it lies in a folder, with its inclination log and its registration if there are any.

    `parts` are the files of an epoch of several, in order of their names; path and log are then those of the
    first, the size is that of all, the mtime the latest.
    """

    name: str  # in the journal: of the file, with its folders below the inbox, or of the epoch
    path: Path
    log: Path | None
    size: int
    mtime_ns: int
    parts: tuple[ScanFile, ...] = ()
    matrix: Path | None = None  # the registration of this file

    @property
    def files(self) -> tuple[ScanFile, ...]:
        """The files of the scan, each as a scan of its own."""
        return self.parts or (self,)

    @property
    def paths(self) -> list[Path]:
        """The paths of its files."""
        return [file.path for file in self.files]

    @property
    def logs(self) -> list[Path]:
        """The inclination logs of its files."""
        return list(dict.fromkeys(file.log for file in self.files if file.log is not None))

    @property
    def matrices(self) -> list[Path]:
        """The registrations of its files."""
        return [file.matrix for file in self.files if file.matrix is not None]


class ScanListing:
    """The files of a folder at the depth of `scans.name`, listed once, and the scans that they are.

    Raises NotReadyError if the folder cannot be listed.
    """

    def __init__(self, site: Site, folder: Path, suffixes: Iterable[str]) -> None:
        self._site = site
        self._folder = folder
        self._log_suffix = site.inclination.suffix if site.inclination else ""
        self._matrix_suffix = (site.registration and site.registration.suffix) or ""
        beside = tuple(filter(None, (self._log_suffix, self._matrix_suffix)))
        self.files = dict(_list_files(folder, folder_depth(site.scans.pattern)))
        known = tuple(suffixes)
        self._names = {name for name in self.files if is_scan(name, known, beside)}

    @cached_property
    def rejected(self) -> dict[str, str]:
        """Why files are rejected whatever they contain, by their names."""
        reasons = ((name, self._rejection_reason(name)) for name in sorted(self._names))
        return {name: reason for name, reason in reasons if reason}

    @cached_property
    def scans(self) -> dict[str, list[str]]:
        """The names of the files of each scan, by its name in the journal."""
        scans: dict[str, list[str]] = {}
        for name in sorted(self._names):
            if name not in self.rejected:
                scans.setdefault(name_in_journal(self._site, name), []).append(name)
        return scans

    def size_and_mtime_ns(self, scan: str) -> tuple[int, int]:
        """Return the size of a scan [bytes] and its latest change [ns], of all of its files."""
        statuses = [self.files[name] for name in self.scans[scan]]
        return sum(status.st_size for status in statuses), max(status.st_mtime_ns for status in statuses)

    def identity(self, scan: str) -> tuple[tuple[object, ...], ...]:
        """Return what changes when one of the files of a scan does, or its log."""
        names = self.scans[scan]
        beside = (
            companion
            for name in names
            for companion in (self._beside(name, self._log_suffix), self._beside(name, self._matrix_suffix))
            if companion
        )
        return tuple((name, *file_key(self.files[name])) for name in (*names, *beside))

    def scan(self, scan: str) -> ScanFile:
        """Return a scan that was listed."""
        parts = tuple(self._file(name) for name in self.scans[scan])
        if self._site.epoch is None:
            return parts[0]
        return ScanFile(scan, parts[0].path, parts[0].log, *self.size_and_mtime_ns(scan), parts)

    def _file(self, name: str) -> ScanFile:
        status, folder = self.files[name], self._folder
        log, matrix = (self._beside(name, suffix) for suffix in (self._log_suffix, self._matrix_suffix))
        return ScanFile(
            name,
            folder / name,
            folder / log if log else None,
            status.st_size,
            status.st_mtime_ns,
            matrix=folder / matrix if matrix else None,
        )

    def _beside(self, name: str, suffix: str) -> str:
        """Return the name of the file of a suffix beside a scan; '' without a regular one with content."""
        companion = f"{path_stem(name)}{suffix}" if suffix else ""
        status = self.files.get(companion)
        is_usable = status is not None and stat.S_ISREG(status.st_mode) and status.st_size > 0
        return companion if is_usable else ""

    def _rejection_reason(self, name: str) -> str:
        """Return why a file is rejected whatever its content, '' if it is not."""
        mode = self.files[name].st_mode
        if not stat.S_ISREG(mode):
            file_type = _FILE_TYPES.get(stat.S_IFMT(mode), "something else")
            return f"is {file_type}: only regular files are read; copy the scan itself into the inbox"
        if not _is_safe(name):
            return "the name has special characters, a space at its end, or is too long: rename it"
        if self._site.epoch is not None and start_in_name(name, self._site.scans.pattern) is None:
            return (
                f"the name does not match scans.name = {self._site.scans.name!r}, which tells the epoch that"
                " it belongs to"
            )
        return ""


def name_in_journal(site: Site, name: str) -> str:
    """Return the name under which a file is in the journal: its own, or that of its epoch."""
    start = start_in_name(name, site.scans.pattern) if site.epoch else None
    if start is None or site.epoch is None:
        return name
    return epoch_name(start, site.row_pattern, site.epoch.window_s)


def _list_files(folder: Path, depth: int, prefix: str = "") -> Iterator[tuple[str, os.stat_result]]:
    """Yield name and `lstat` of the entries of the folders at a depth.

    Hidden folders, links and folders that cannot be listed are skipped.
    """
    for name, status in list_folder(folder).items():
        if not depth:
            yield prefix + name, status
        elif stat.S_ISDIR(status.st_mode) and not name.startswith("."):
            with suppress(NotReadyError):
                yield from _list_files(folder / name, depth - 1, f"{prefix}{name}{SEPARATOR}")


def list_folder(folder: Path) -> dict[str, os.stat_result]:
    """Return the `lstat` of each entry of a folder by name; raise NotReadyError if it cannot be listed."""
    files = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                try:
                    files[entry.name] = entry.stat(follow_symlinks=False)
                except FileNotFoundError:
                    continue  # it was removed between the listing and the stat
    except OSError as error:
        raise NotReadyError(f"the inbox {folder} cannot be listed: {error.strerror}") from error
    return files


def is_scan(name: str, suffixes: tuple[str, ...], beside: tuple[str, ...] = ()) -> bool:
    """Return True if a file name is that of a scan; hidden files are transfers in progress.

    `beside` are the suffixes of inclination logs and matrices, which may end like scans in text.
    """
    base = name.rpartition(SEPARATOR)[2]
    return base.lower().endswith(suffixes) and not base.startswith(".") and not base.endswith(beside)


def _is_safe(name: str) -> bool:
    """Return True if a name may stand in the journal and in log lines as it is."""
    if not _SAFE_NAME.fullmatch(composed(name)):
        return False
    return all(len(os.fsencode(part)) <= MAX_NAME_BYTES for part in name.split(SEPARATOR))


def safe_name(name: str) -> str:
    """Return a file name escaped for the journal and for log lines; a plain name is returned unchanged."""
    if _is_safe(name):
        return name
    escaped = name.encode("unicode_escape").decode("ascii").replace("/", "")
    if len(escaped) <= 100:
        return escaped
    return f"{escaped[:90]}~{hashlib.sha256(os.fsencode(name)).hexdigest()[:9]}"


def start_from_name(name: str, pattern: str) -> datetime:
    """Return the start of a scan according to its name; datetime.max (sorted last) if the name has none."""
    return start_in_name(name, pattern) or datetime.max.replace(tzinfo=UTC)


def file_key(status: os.stat_result) -> tuple[int, ...]:
    """Return inode, size and mtime of a file."""
    return status.st_ino, status.st_size, status.st_mtime_ns
