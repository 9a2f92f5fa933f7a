"""Consistency of store and journal: checksums, quarantine of damaged files, recovery of a lost journal.

Functions with a `progress` argument read many files and run in a worker process.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np

from station.archive.areas import FILE_NAME as AREAS
from station.archive.atomic_files import DAMAGED
from station.archive.derived.boxes import BOXES, DAILY, block_files
from station.archive.derived.event_table import FILE_NAME as EVENTS
from station.archive.derived.fingerprints import is_intact as is_derived_intact
from station.archive.derived.level_files import damaged_levels
from station.archive.derived.product_files import product_keys, product_path
from station.archive.epochs import (
    EpochRef,
    compacted_files,
    epoch_files,
    epochs_in_file,
    parse_epoch_filename,
)
from station.archive.netcdf_layout import Series, decode_text
from station.archive.reference_files import version_path
from station.archive.schema import VERDICTS
from station.archive.series.epoch_reader import middle
from station.archive.series.index import list_epochs, source_files
from station.archive.series.manifest import index_if_current, is_intact
from station.archive.tilt_offsets import (
    damaged_tilt_offsets,
    read_tilt_offset,
    stored_tilt_offsets,
    write_tilt_offset,
)
from station.config import Site
from station.errors import StoreError
from station.inbox.file_hash import sha256_file
from station.inbox.journal_reader import Entry, State
from station.processing.provenance import StoredEpoch, stored_epochs
from station.processing.scans.scan_files import ScanFinder
from station.processing.site_files import series_for
from station.processing.workers.worker_process import Progress


@dataclass(frozen=True)
class Verification:
    """Result of a verification: new checksums of intact files, and damaged files (relative paths)."""

    new_checksums: dict[str, str]  # SHA-256 by file
    damaged: tuple[str, ...]


def store_files(series: Series) -> list[Path]:
    """Return the immutable files of the store: epochs, compacted files, versions of the reference."""
    return [
        *(epoch_file.path for epoch_file in epoch_files(series)),
        *compacted_files(series, "days"),
        *compacted_files(series, "months"),
        *sorted(series.folder.glob("reference_*.nc")),
    ]


def is_reference(path: Path | str) -> bool:
    """Return True if a file is a version of the reference, False if it contains epochs."""
    return Path(path).name.startswith("reference_")


def holds_epochs(series: Series) -> bool:
    """Return True if the store contains epochs."""
    return any(not is_reference(path) for path in store_files(series))


def verify_checksums(
    site: Site, checksums: Mapping[str, str], progress: Progress, *, deep: bool = True
) -> Verification:
    """Verify files against their checksums; read files without a checksum completely.

    With `deep=False`, only files without a checksum are read.
    """
    series = series_for(site)
    new_checksums, damaged = {}, []
    for path in store_files(series):
        name = str(path.relative_to(series.folder))
        progress()
        if name not in checksums:
            if is_readable(path, progress):
                new_checksums[name] = sha256_file(path)
            else:
                damaged.append(name)
        elif deep and sha256_file(path) != checksums[name]:
            damaged.append(name)
    return Verification(new_checksums, tuple(damaged))


def add_checksums(site: Site, checksums: Mapping[str, str], progress: Progress) -> Verification:
    """Compute the checksums of files that have none yet."""
    return verify_checksums(site, checksums, progress, deep=False)


def unreadable_files(site: Site, progress: Progress) -> tuple[str, ...]:
    """Return the epoch and compacted files that cannot be opened, or a variable of which cannot be.

    That is fast, but blind to flipped bits in the values.
    """
    series = series_for(site)
    unreadable = []
    for path in store_files(series):
        progress()
        try:
            if not is_reference(path):
                epochs_in_file(path)
                _open_variables(path)
        except (StoreError, OSError, RuntimeError, KeyError):
            unreadable.append(str(path.relative_to(series.folder)))
    return tuple(unreadable)


def _open_variables(path: Path) -> None:
    """Open every variable of a file, whose description has a checksum; raise KeyError if one is damaged."""
    with h5py.File(path, "r") as file:
        for name in file:
            file[name]


def is_readable(path: Path, progress: Progress) -> bool:
    """Return True if a file can be read completely; its compressed chunks carry checksums."""
    try:
        with h5py.File(path, "r") as file:
            for name in file:
                variable = file[name]
                if not isinstance(variable, h5py.Dataset) or variable.shape is None:
                    continue
                indices = range(variable.shape[0]) if variable.ndim == 3 else (...,)
                for index in indices:
                    np.asarray(variable[index])
                progress()
    except (OSError, RuntimeError, KeyError, ValueError):
        return False
    return True


def quarantine(series: Series, names: Iterable[str]) -> None:
    """Rename damaged files so that the series ignores them; nothing is deleted."""
    for name in names:
        path = series.folder / name
        quarantined = path.with_name(path.name + DAMAGED)
        try:
            if path.exists():
                path.rename(quarantined)
        except OSError as error:
            raise StoreError(f"{path}: damaged, and cannot be renamed: {error}") from error


def missing_epochs(site: Site, epochs: Mapping[str, str], progress: Progress) -> list[str]:
    """Return the names of scans whose epoch is missing: not stored, not compacted, not superseded.

    `epochs` are the epoch files in the journal by scan name. Raises StoreError if a file of the store cannot
    be opened.
    """
    series = series_for(site)
    index = index_if_current(series)
    indexed = set() if index is None else {name.decode("ascii") for name in index.epoch_file.tolist()}
    if all(Path(epoch).name in indexed for epoch in epochs.values()):
        return []  # no file has to be opened
    refs: list[EpochRef] = []
    for path in _intact_files(series, ()):
        progress()
        refs += epochs_in_file(path)
    return _scans_without_epoch(epochs, refs)


def unjournaled_epochs(site: Site, epochs: Mapping[str, str], progress: Progress) -> list[Entry]:
    """Return reconstructed journal rows for epochs of the series that the journal does not contain.

    Their `size` is -1, so that the inbox treats the file as changed and its SHA-256 is compared.
    """
    series = series_for(site)
    journaled = {Path(epoch).name for epoch in epochs.values()}
    progress()
    index = index_if_current(series)
    if index is None:
        refs = [ref for ref in list_epochs(series) if ref.epoch_file not in journaled]
    else:
        names = index.epoch_file.tolist()
        refs = [
            index[position] for position, name in enumerate(names) if name.decode("ascii") not in journaled
        ]
    finder = ScanFinder(site)
    return [_journal_entry(site, finder, stored) for stored in stored_epochs(series, refs)]


def check_store(
    site: Site, entries: list[Entry], checksums: Mapping[str, str], progress: Progress
) -> list[tuple[str, str, str]]:
    """Return the findings on all files and epochs of the store: (level, subject, message)."""
    series = series_for(site)
    verification = verify_checksums(site, checksums, progress)
    findings = [
        ("fault", "file", f"{name}: damaged: station reprocess quarantines it and rebuilds its epochs")
        for name in verification.damaged
    ]
    refs = [ref for path in _intact_files(series, verification.damaged) for ref in epochs_in_file(path)]
    epochs = {entry.name: entry.epoch for entry in entries if entry.epoch}
    for name in _scans_without_epoch(epochs, refs):
        message = f"{epochs[name]}, the epoch of {name}, is in no intact file: station reprocess rebuilds it"
        findings.append(("fault", "epoch", message))
    if verification.new_checksums:
        count = len(verification.new_checksums)
        message = f"{count} readable files without a checksum: the service adds it when it starts"
        findings.append(("warning", "file", message))
    names = {Path(epoch).name for epoch in epochs.values()}
    starts = {
        epoch_file.start for epoch in epochs.values() if (epoch_file := parse_epoch_filename(Path(epoch)))
    }
    orphans = {ref.epoch_file for ref in refs if ref.epoch_file not in names and ref.start not in starts}
    for name in sorted(orphans):
        message = f"{name}: not in the journal: the service imports it when it starts"
        findings.append(("warning", "epoch", message))
    findings += [
        ("warning", "file", f"{path.relative_to(series.folder)}: damaged, quarantined")
        for path in sorted(series.folder.glob(f"**/*{DAMAGED}"))
    ]
    findings += _check_references(series)
    findings += _check_series(series, refs, is_complete=not verification.damaged)
    findings += _check_derived(series)
    file_count = len(checksums) + len(verification.new_checksums)
    return [("ok", "store", f"{file_count} files, {len({ref.start for ref in refs})} epochs"), *findings]


def _intact_files(series: Series, damaged: Iterable[str]) -> list[Path]:
    """Return the files that contain epochs, without the damaged ones."""
    excluded = {series.folder / name for name in damaged}
    return [path for path in store_files(series) if path not in excluded and not is_reference(path)]


def _scans_without_epoch(epochs: Mapping[str, str], refs: Iterable[EpochRef]) -> list[str]:
    """Return the names of scans whose epoch is in no file, in this or a newer revision."""
    names: set[str] = set()
    newest: dict[datetime, int] = {}
    for ref in refs:
        names.add(ref.epoch_file)
        newest[ref.start] = max(newest.get(ref.start, 0), ref.revision)
    missing = []
    for name, epoch in epochs.items():
        epoch_file = parse_epoch_filename(Path(epoch))
        if (
            epoch_file
            and epoch_file.path.name not in names
            and newest.get(epoch_file.start, 0) <= epoch_file.revision
        ):
            missing.append(name)
    return missing


def _check_references(series: Series) -> list[tuple[str, str, str]]:
    """Return findings on versions of the reference that epochs refer to and that do not exist."""
    if not series.path.is_file():
        return []
    try:
        with h5py.File(series.path, "r") as file:
            referenced = set(decode_text(file["reference_version"][:])) - {""}
    except (OSError, RuntimeError, KeyError):  # reported by `_check_series`
        return []
    missing = sorted(version for version in referenced if not version_path(series, version).is_file())
    message = "is missing: restore it, or station reprocess computes its epochs with another version"
    return [("fault", "reference", f"reference_{version}.nc {message}") for version in missing]


def _check_derived(series: Series) -> list[tuple[str, str, str]]:
    """Return findings on the derived files and the tilt offsets, which the service restores while it runs."""
    paths = damaged_tilt_offsets(series.folder)
    derived = [series.folder / name for name in (AREAS, BOXES, DAILY, EVENTS)]
    derived += [product_path(series.folder, key) for key in product_keys(series.folder)]
    paths += [path for path in derived if path.exists() and not is_derived_intact(path)]
    message = "damaged: the service restores it with the next scan"
    findings = [("fault", "file", f"{path.relative_to(series.folder)}: {message}") for path in paths]
    message = "damaged: delete it, the service computes it again with the next scan"
    findings += [
        ("fault", "file", f"{path.relative_to(series.folder)}: {message}")
        for path in sorted(block_files(series))
        if not is_derived_intact(path)
    ]
    message = "damaged: station reprocess computes it again"
    return findings + [
        ("fault", "file", f"{path.relative_to(series.folder)}: {message}") for path in damaged_levels(series)
    ]


def _check_series(series: Series, refs: list[EpochRef], *, is_complete: bool) -> list[tuple[str, str, str]]:
    """Return findings if `series.nc` does not contain the stored epochs in order of time."""
    for path in (series.path, series.processing_path):
        if not path.is_file():
            message = f"{path.name} is missing: the service rebuilds it when it starts"
            return [("fault", "series", message)] if refs else []
    if not is_intact(series):
        what = "series.nc or processing.nc is damaged"
        return [("fault", "series", f"{what}: the service rebuilds both with the next scan")]
    try:
        missing = [path for path in source_files(series.path) if not path.is_file()]
        with h5py.File(series.path, "r") as file:
            times = middle(file["time_bnds"][:])
            names = decode_text(file["epoch_file"][:])
    except (StoreError, OSError, RuntimeError, KeyError) as error:
        return [("fault", "series", f"series.nc cannot be read: {error}")]
    remedy = "start the service or run station reprocess to rebuild it"
    findings = [
        ("fault", "series", f"series.nc refers to {path}, which is missing: {remedy}") for path in missing
    ]
    if not (np.diff(times) > 0).all():
        findings.append(("fault", "series", f"the time in series.nc does not increase: {remedy}"))
    if is_complete and names != [ref.epoch_file for ref in list_epochs(series)]:
        findings.append(("fault", "series", f"series.nc does not list the stored epochs: {remedy}"))
    return findings


def restore_tilt_offsets(site: Site, progress: Progress) -> None:
    """Restore lost and damaged tilt offsets of SOPs from the stored epochs."""
    for sop_id, tilt_offset in stored_tilt_offsets(site).items():
        progress()
        if read_tilt_offset(site, sop_id) is None:
            write_tilt_offset(site, sop_id, tilt_offset)


def _journal_entry(site: Site, finder: ScanFinder, stored: StoredEpoch) -> Entry:
    start = stored.ref.start
    epoch = Path("epochs") / start.strftime("%Y/%m/%d") / stored.ref.epoch_file
    return Entry(
        name=_scan_filename(site, finder, stored),
        size=-1,
        mtime_ns=-1,
        state=State.STORED,
        waiting_reason="",
        reason=stored.verdict_reason,
        sha256=stored.provenance.scan_sha256,
        log_sha256=stored.provenance.log_sha256,
        outcome=State.STORED,
        verdict=VERDICTS[stored.verdict],
        epoch=str(epoch),
        start_utc_s=stored.provenance.start_s,
        revision=stored.ref.revision,
        reference=stored.reference or None,
        metrics={},
        attempts=0,
        next_try_utc_s=None,
        first_seen_utc_s=stored.provenance.start_s,
        changed_utc_s=stored.provenance.end_s,
    )


def _scan_filename(site: Site, finder: ScanFinder, stored: StoredEpoch) -> str:
    """Return the name of the scan of an epoch in the journal; the store has it without suffix."""
    scan = stored.provenance
    suffix = ".laz" if site.epoch is None else ""
    return finder.name_of(scan.scan_id, scan.start_s) or f"{scan.scan_id}{suffix}"
