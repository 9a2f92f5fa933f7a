"""Scans that are read from a temporary copy: compressed ones, and those that a command of the user converts.

Both run in the worker process, with its limit on memory and the limit on time of a scan. The copy is limited
in size, and removed at the end; what a killed worker left behind, by the next conversion.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from isal import igzip

from station.errors import InconclusiveError, NotReadyError, ScanError
from station.readers.scan import ScanReader, decoder_errors, open_scan, suffixes
from station.scan_names import COMPRESSED, scan_stem
from station.sections.inputs import ScansSection

MAX_EXPANSION = 50  # of a copy against its scan: text from a compressed format is some 20 times as long
MIN_LIMIT_BYTES = 1 << 28  # that a copy may have however short its scan is
COPY_BYTES = 1 << 20
POLL_S = 0.05
MESSAGE_CHARACTERS = 300  # of what a command writes to stderr
FOLDER_PREFIX = "converting-"  # and the id of the process, in the data folder


def scan_suffixes(scans: ScansSection) -> tuple[str, ...]:
    """Return the suffixes of the files in the inbox that are scans, in lower case."""
    return (scans.suffix.lower(),) if scans.suffix else suffixes()


@contextmanager
def open_site_scan(
    path: Path, scans: ScansSection, *, range_max_m: float | None, work_folder: Path
) -> Iterator[ScanReader]:
    """Yield a scan, read as the site file says; a copy lies in `work_folder`, if one is needed.

    Raises what `open_scan` raises; InconclusiveError if the command of the user fails, and NotReadyError if
    there is no such command.
    """
    is_compressed = path.name.lower().endswith(COMPRESSED)
    if scans.convert is None and not is_compressed:
        with open_scan(path, range_max_m=range_max_m, columns=scans.columns) as reader:
            yield reader
        return
    with _temporary_folder(work_folder) as folder:
        limit_bytes = max(MIN_LIMIT_BYTES, MAX_EXPANSION * path.stat().st_size)
        if is_compressed:
            copy = folder / f"{scan_stem(path)}{Path(path.stem).suffix}"
            with decoder_errors("cannot be decompressed"):
                _decompress(path, copy, limit_bytes)
        else:
            copy = folder / f"{scan_stem(path)}.laz"
        if scans.convert is not None:
            source, copy = (copy if is_compressed else path), folder / f"{scan_stem(path)}.laz"
            convert(scans.convert, source, copy, timeout_s=scans.timeout_s, limit_bytes=limit_bytes)
        with open_scan(copy, range_max_m=range_max_m, columns=scans.columns) as reader:
            yield reader


def _decompress(path: Path, copy: Path, limit_bytes: int) -> None:
    """Write the decompressed content of a file; raise ScanError if it is implausibly long."""
    written = 0
    with igzip.open(path, "rb") as file, copy.open("xb") as out:
        while block := file.read(COPY_BYTES):
            written += len(block)
            if written > limit_bytes:
                raise ScanError(f"more than {MAX_EXPANSION} times as long when decompressed: not a scan")
            out.write(block)


def convert(command: Sequence[str], source: Path, copy: Path, *, timeout_s: float, limit_bytes: int) -> None:
    """Run the command with `{in}` and `{out}` replaced by the paths; it must write `copy`.

    Its processes have the memory limit of this one each, and end with it, or when it or the time does.
    """
    arguments = [word.replace("{in}", str(source)).replace("{out}", str(copy)) for word in command]
    name = Path(arguments[0]).name
    with tempfile.TemporaryFile() as stderr:
        usual_limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:  # the command inherits the limit, from its first byte on
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, usual_limits[1]))
            process = subprocess.Popen(  # noqa: S603 - the command of the site file
                arguments,
                cwd=copy.parent,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
            )
        except OSError as error:
            raise NotReadyError(f"scans.convert: {arguments[0]} cannot be run: {error.strerror}") from error
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, usual_limits)
        with _killed_with_this_process(process):
            status = _wait(process, time.monotonic() + timeout_s)
        stderr.seek(0)
        lines = stderr.read(1 << 16).decode("utf-8", "replace").split("\n")
    if status is None:
        raise InconclusiveError(f"scans.convert: {name} took longer than scans.timeout_s = {timeout_s:g}")
    # A program that ignores the signal may end well with a file that is cut off.
    if status == -signal.SIGXFSZ or (copy.is_file() and copy.stat().st_size >= limit_bytes):
        raise ScanError(f"scans.convert: {name} wrote more than {limit_bytes:,} bytes")
    if status:
        message = next((line.strip() for line in reversed(lines) if line.strip()), "without a message")
        raise InconclusiveError(
            f"scans.convert: {name} failed (exit status {status}): {message[:MESSAGE_CHARACTERS]}"
        )
    if not copy.is_file() or copy.is_symlink():
        raise InconclusiveError(f"scans.convert: {name} did not write {{out}}")


def _wait(process: subprocess.Popen[bytes], deadline_s: float) -> int | None:
    """Return the exit status of a command; None if it did not end in time."""
    while time.monotonic() < deadline_s:
        with suppress(subprocess.TimeoutExpired):
            return process.wait(POLL_S)
    return None


@contextmanager
def _killed_with_this_process(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Kill the processes of a command at the end of the block, also if this process is killed before.

    A fork of this process waits for the end of a pipe, which the kernel closes with this process.
    """
    read_end, write_end = os.pipe()
    guard = os.fork()
    if not guard:
        os.setsid()
        os.close(write_end)
        os.read(read_end, 1)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        os._exit(0)
    os.close(read_end)
    try:
        yield
    finally:
        os.close(write_end)
        os.waitpid(guard, 0)
        process.wait()


@contextmanager
def _temporary_folder(work_folder: Path) -> Iterator[Path]:
    """Yield an empty folder that is removed at the end; remove those of processes that do not exist."""
    usable = work_folder if os.access(work_folder, os.W_OK) else None
    for folder in usable.glob(f"{FOLDER_PREFIX}*") if usable else ():
        owner = folder.name.removeprefix(FOLDER_PREFIX).partition("-")[0]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            shutil.rmtree(folder, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=f"{FOLDER_PREFIX}{os.getpid()}-", dir=usable) as name:
        yield Path(name)
