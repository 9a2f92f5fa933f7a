"""The store against the journal: checksums, damaged files put out of the way, a lost journal made anew.

Functions with `progress` read many files and run in a child process.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np

from station.archive.layout import Series, strings
from station.archive.made import settled
from station.archive.reference import path_of
from station.archive.store import Row, epochs, joined, rows, rows_in, sources, stored
from station.archive.variables import VERDICTS
from station.config import Site
from station.errors import StoreError
from station.readers.scan import suffixes
from station.science.inclination import Cycle
from station.service.content import sha256_of
from station.service.gather import kept_zero, write_zero
from station.service.journal import Entry, State
from station.service.places import find_scan
from station.service.stale import Held, held
from station.service.tasks import Progress, series_of

DAMAGED = ".damaged"  # appended to the name: such a file is read by nobody, and deleted by nobody


@dataclass(frozen=True)
class Found:
    """Files of the store, relative to the data folder: sound ones without a checksum, and damaged ones."""

    fresh: dict[str, str]  # SHA-256 by file
    damaged: tuple[str, ...]


def store_files(series: Series) -> list[Path]:
    """Return every file of the store that must not change: epochs, joined ones, versions of the reference."""
    return [
        *(one.path for one in epochs(series)),
        *joined(series, "days"),
        *joined(series, "months"),
        *sorted(series.folder.glob("reference_*.nc")),
    ]


def is_reference(path: Path | str) -> bool:
    """Tell a version of the reference from a file that holds epochs."""
    return Path(path).name.startswith("reference_")


def holds_epochs(series: Series) -> bool:
    """Tell whether anything is stored."""
    return any(not is_reference(path) for path in store_files(series))


def verify(site: Site, known: Mapping[str, str], progress: Progress, *, deep: bool = True) -> Found:
    """Prove files against their checksums; read those without one from end to end.

    Not `deep`: only what has no checksum is read.
    """
    series = series_of(site)
    fresh, damaged = {}, []
    for path in store_files(series):
        name = str(path.relative_to(series.folder))
        progress()
        if name not in known:
            if is_readable(path, progress):
                fresh[name] = sha256_of(path)
            else:
                damaged.append(name)
        elif deep and sha256_of(path) != known[name]:
            damaged.append(name)
    return Found(fresh, tuple(damaged))


def seal(site: Site, known: Mapping[str, str], progress: Progress) -> Found:
    """Return checksums of files that have none yet."""
    return verify(site, known, progress, deep=False)


def unopened(site: Site, progress: Progress) -> tuple[str, ...]:
    """Return the epochs and joined files that cannot be opened; quick, and blind to a flipped bit."""
    series = series_of(site)
    found = []
    for path in store_files(series):
        progress()
        try:
            if not is_reference(path):
                rows_in(path)
        except StoreError:
            found.append(str(path.relative_to(series.folder)))
    return tuple(found)


def is_readable(path: Path, progress: Progress) -> bool:
    """Tell whether all of a file can be read; its compressed pieces carry checksums of their own."""
    try:
        with h5py.File(path, "r") as file:
            for name in file:
                variable = file[name]
                if not isinstance(variable, h5py.Dataset) or variable.shape is None:
                    continue
                steps = range(variable.shape[0]) if variable.ndim == 3 else (...,)
                for step in steps:
                    np.asarray(variable[step])
                progress()
    except (OSError, RuntimeError, KeyError, ValueError):
        return False
    return True


def quarantine(series: Series, names: Iterable[str]) -> None:
    """Rename damaged files so that the series goes on without them; nothing is deleted."""
    for name in names:
        path = series.folder / name
        beside = path.with_name(path.name + DAMAGED)
        try:
            if path.exists():
                path.rename(beside)
        except OSError as error:
            raise StoreError(f"{path}: damaged, and cannot be put out of the way: {error}") from error


def lost(site: Site, epochs: Mapping[str, str], progress: Progress) -> list[str]:
    """Return the names of scans whose epoch is nowhere: not itself, not joined, not replaced.

    `epochs` are those the journal tells, by the name of the scan. Raises StoreError where a file of the store
    cannot be opened.
    """
    series = series_of(site)
    told = settled(series)
    named = set() if told is None else {name.decode("ascii") for name in told.epoch_file.tolist()}
    if all(Path(epoch).name in named for epoch in epochs.values()):
        return []  # no file needs to be opened
    found: list[Row] = []
    for path in _sound(series, ()):
        progress()
        found += rows_in(path)
    return _missing(epochs, found)


def unknown(site: Site, epochs: Mapping[str, str], progress: Progress) -> list[Entry]:
    """Return rows for epochs of the series that are not among those the journal tells: as it had them.

    Their size is unknown, so that the inbox shows them anew and they are told by their bytes.
    """
    series = series_of(site)
    told = {Path(epoch).name for epoch in epochs.values()}
    progress()
    named = settled(series)
    if named is None:
        found = [row for row in rows(series) if row.epoch_file not in told]
    else:
        names = named.epoch_file.tolist()
        found = [named[at] for at, name in enumerate(names) if name.decode("ascii") not in told]
    return [_entry(site, one) for one in held(series, found)]


def prove(
    site: Site, entries: list[Entry], known: Mapping[str, str], progress: Progress
) -> list[tuple[str, str, str]]:
    """Return what the store is like, file by file and epoch by epoch: (level, what, says)."""
    series = series_of(site)
    found = verify(site, known, progress)
    told = [
        ("fault", "file", f"{name}: damaged: station reprocess puts it aside and rebuilds its epochs")
        for name in found.damaged
    ]
    sound = [row for path in _sound(series, found.damaged) for row in rows_in(path)]
    epochs = {entry.name: entry.epoch for entry in entries if entry.epoch}
    for name in _missing(epochs, sound):
        says = f"{epochs[name]}, the epoch of {name}, is in no sound file: station reprocess rebuilds it"
        told.append(("fault", "epoch", says))
    if found.fresh:
        says = f"{len(found.fresh)} files without a checksum, readable: the service notes one when it starts"
        told.append(("warning", "file", says))
    names = {Path(epoch).name for epoch in epochs.values()}
    starts = {one.start for epoch in epochs.values() if (one := stored(Path(epoch)))}
    orphans = {row.epoch_file for row in sound if row.epoch_file not in names and row.start not in starts}
    for name in sorted(orphans):
        says = f"{name}: the journal does not know it: the service takes it in when it starts"
        told.append(("warning", "epoch", says))
    told += [
        ("warning", "file", f"{path.relative_to(series.folder)}: damaged, was put aside")
        for path in sorted(series.folder.glob(f"**/*{DAMAGED}"))
    ]
    told += _references(series)
    told += _series(series, sound, is_whole=not found.damaged)
    kept = len(known) + len(found.fresh)
    return [("ok", "store", f"{kept} files, {len({row.start for row in sound})} epochs"), *told]


def _sound(series: Series, damaged: Iterable[str]) -> list[Path]:
    """Return the files that hold epochs, without the damaged ones."""
    out = {series.folder / name for name in damaged}
    return [path for path in store_files(series) if path not in out and not is_reference(path)]


def _missing(epochs: Mapping[str, str], sound: Iterable[Row]) -> list[str]:
    """Return the names of scans whose epoch is in no file, nor a newer revision of it."""
    names: set[str] = set()
    newest: dict[datetime, int] = {}
    for row in sound:
        names.add(row.epoch_file)
        newest[row.start] = max(newest.get(row.start, 0), row.revision)
    missing = []
    for name, epoch in epochs.items():
        told = stored(Path(epoch))
        if told and told.path.name not in names and newest.get(told.start, 0) <= told.revision:
            missing.append(name)
    return missing


def _references(series: Series) -> list[tuple[str, str, str]]:
    """Tell which versions of the reference are named by epochs and are not there."""
    if not series.path.is_file():
        return []
    try:
        with h5py.File(series.path, "r") as file:
            named = set(strings(file["reference_version"][:])) - {""}
    except (OSError, RuntimeError, KeyError):  # told by `_series`
        return []
    gone = sorted(version for version in named if not path_of(series, version).is_file())
    says = "is gone: restore it, or station reprocess measures its epochs from another"
    return [("fault", "reference", f"reference_{version}.nc {says}") for version in gone]


def _series(series: Series, sound: list[Row], *, is_whole: bool) -> list[tuple[str, str, str]]:
    """Tell whether `series.nc` names what there is, in the order of time."""
    if not sound:
        return []
    if not series.path.is_file():
        return [("fault", "series", "series.nc is gone: the service writes it anew when it starts")]
    try:
        gone = [path for path in sources(series.path) if not path.is_file()]
        with h5py.File(series.path, "r") as file:
            times = np.asarray(file["time"][:])
            names = strings(file["epoch_file"][:])
    except (StoreError, OSError, RuntimeError, KeyError) as error:
        return [("fault", "series", f"series.nc is damaged: the service writes it anew at start: {error}")]
    anew = "start the service, or station reprocess: it is written anew"
    told = [("fault", "series", f"series.nc points to {path}, which is gone: {anew}") for path in gone]
    if not (np.diff(times) > 0).all():
        told.append(("fault", "series", f"the time of series.nc does not increase: {anew}"))
    if is_whole and names != [row.epoch_file for row in rows(series)]:
        told.append(("fault", "series", f"series.nc does not name the epochs that are there: {anew}"))
    return told


def restore_zeros(site: Site, progress: Progress) -> None:
    """Write the zeros of lean again that are gone, as the epochs tell them."""
    if site.inclination is None or site.inclination.mode == "absolute":
        return
    for sop_id, zero in _zeros(series_of(site)).items():
        progress()
        if zero and kept_zero(site, sop_id) is None:
            write_zero(site, sop_id, Cycle(**json.loads(zero)))


def _zeros(series: Series) -> dict[str, str]:
    """Return the zero of lean that the first epoch of each SOP tells; of the series, unless it is lost."""
    try:
        with h5py.File(series.path, "r") as file:
            told = [strings(file[name][:]) for name in ("sop_id", "lean_zero")]
    except (OSError, RuntimeError, KeyError):
        made = [one.made for one in held(series)]
        told = [[one.sop_id for one in made], [one.lean_zero for one in made]]
    pairs = [(sop_id, zero) for sop_id, zero in zip(*told, strict=True) if zero]
    return dict(reversed(pairs))


def _entry(site: Site, one: Held) -> Entry:
    start = one.row.start
    epoch = Path("epochs") / start.strftime("%Y/%m/%d") / one.row.epoch_file
    return Entry(
        name=_name_of(site, one),
        size=-1,
        mtime_ns=-1,
        state=State.STORED,
        waits_for="",
        reason=one.verdict_reason,
        sha256=one.made.scan_sha256,
        log_sha256=one.made.log_sha256,
        outcome=State.STORED,
        verdict=VERDICTS[one.verdict],
        epoch=str(epoch),
        start_utc_s=one.made.start_s,
        revision=one.row.revision,
        reference=one.reference or None,
        figures={},
        attempts=0,
        next_try_utc_s=None,
        seen_utc_s=one.made.start_s,
        changed_utc_s=one.made.end_s,
    )


def _name_of(site: Site, one: Held) -> str:
    """Return the file name of a scan of which the epoch knows the stem."""
    for suffix in suffixes():
        name = one.made.scan_id + suffix
        if find_scan(site, name, one.made.start_s):
            return name
    return one.made.scan_id + ".laz"
