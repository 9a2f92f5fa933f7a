"""The fork server: a process without threads from which workers are forked within milliseconds.

Its socket lies in the runtime folder of the service, because programs that clean /tmp would delete it there.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
from contextlib import suppress
from multiprocessing import forkserver, util
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

# Modules that cannot be imported are skipped; the first one imports nearly all of the others.
PRELOAD = (
    "station.processing.scan_tasks",
    "station.service.publishing",
    "station.processing.workers.worker_process",
    "typer",  # imported by the main module of the command, which a worker loads too
    "PIL.WebPImagePlugin",  # without it, each worker imports the plugins of all image formats to write one
    "station.readers.las",
    "netCDF4",
    "scipy.signal",  # for the spectrum of an inclination log; its import takes longer than the spectrum
)
# Decoding uses two cores, everything else one: each further BLAS thread reserves address space that counts
# against RLIMIT_AS. Freed memory is kept for the next array, because clearing fresh pages is slow; between
# steps with arrays of different sizes a task may call `trim_heap`. Arrays use small pages: a virtual machine
# returns free huge pages to its host, and requesting them again would take 0.5 s per scan. Cell look-ups in
# small pages are not measurably slower.
WORKER_ENV = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "2",
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "NUMPY_MADVISE_HUGEPAGE": "0",
}
context = multiprocessing.get_context("forkserver")
_lock = threading.Lock()  # several threads may run workers


def ensure_running(preload: Sequence[str] = PRELOAD) -> None:
    """Start the server if it does not run; what it preloads is chosen by the first call.

    Raises OSError if it cannot be started.
    """
    with _lock:
        saved = {name: os.environ.get(name) for name in WORKER_ENV}
        os.environ.update(WORKER_ENV)
        try:
            _create_socket_folder()
            context.set_forkserver_preload(list(preload))
            forkserver.ensure_running()
        finally:
            for name, value in saved.items():
                os.environ.pop(name)
                if value is not None:
                    os.environ[name] = value


def stop() -> None:
    """Kill the server, so that the next call of `ensure_running` starts a new one; its workers are lost."""
    server: Any = forkserver._forkserver  # noqa: SLF001 - there is no public way
    with _lock:
        pid = server._forkserver_pid  # noqa: SLF001
        with suppress(OSError):  # it is dead, or its socket is gone
            if pid is not None:
                os.kill(pid, signal.SIGKILL)
            server._stop()  # noqa: SLF001


def _create_socket_folder() -> None:
    """Create the folder of the socket, in the runtime folder that systemd provides, if there is one."""
    previous, runtime = tempfile.tempdir, os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    tempfile.tempdir = runtime or previous
    try:
        folder = Path(util.get_temp_dir())
    finally:
        tempfile.tempdir = previous
    if not folder.is_dir():
        folder.mkdir(mode=0o700)
