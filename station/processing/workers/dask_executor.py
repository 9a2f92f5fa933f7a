"""Reprocessing on a Dask cluster: the same function, on other machines that share the folders."""

from __future__ import annotations

import hashlib
import ipaddress
import os
import platform
import secrets
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import h5py
import netCDF4
import numpy as np
import scipy

from station._version import __version__
from station.config import Site
from station.errors import ConfigError, NotReadyError, StoreError
from station.inbox.listing import ScanFile
from station.processing.scan_tasks import Rejected, ScanHistory, StoredResult, reprocess_scan

CONNECT_TIMEOUT_S = 30.0
_netcdf_lock = threading.Lock()  # among the threads of a Dask worker: the netCDF library is not thread-safe


class DaskExecutor:
    """Executor on a Dask cluster, reached over loopback or TLS, with the same versions and folders."""

    def __init__(self, address: str, site: Site) -> None:
        """Raise ConfigError if the cluster must not be used, NotReadyError if it does not answer."""
        require_secure(address)
        try:
            import distributed  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise ConfigError("--scheduler needs Dask: pip install 'tls-station[cluster]'") from error
        dask: Any = distributed  # lacks type annotations
        try:
            self._client = dask.Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError, RuntimeError) as error:
            raise NotReadyError(f"{address}: no Dask scheduler answers: {error}") from error
        try:
            self._require_same_versions()
            self._require_folders(site)
        except BaseException:
            self.close()
            raise
        self.count = len(self._client.scheduler_info(n_workers=-1)["workers"])

    def start(self, site: Site, scan: ScanFile, history: ScanHistory) -> Future[StoredResult | Rejected]:
        """Start reprocessing a scan."""
        future: Future[StoredResult | Rejected] = Future()
        future.set_running_or_notify_cancel()
        dask_future = self._client.submit(_reprocess_on_worker, site, scan, history, pure=False, retries=2)
        dask_future.add_done_callback(lambda done: _forward_result(done, future))
        return future

    def close(self) -> None:
        """Disconnect from the cluster; running tasks are cancelled."""
        self._client.close()

    def _require_same_versions(self) -> None:
        """Raise ConfigError unless every worker has the same package versions as this process."""
        expected, by_worker = versions(), self._client.run(_worker_versions)
        if not by_worker:
            raise NotReadyError("the cluster has no workers yet")
        differences = [
            f"  {worker}: {name} {installed.get(name)}, here {version}"
            for worker, installed in sorted(by_worker.items())
            for name, version in expected.items()
            if installed.get(name) != version
        ]
        if differences:
            raise ConfigError(
                "\n".join(["the workers have other versions; results might differ:", *differences])
            )

    def _require_folders(self, site: Site) -> None:
        """Raise ConfigError unless every worker shares our folders and can write to the data folder."""
        token = secrets.token_hex(16)
        marker = site.station.data / f".cluster-{token}"
        try:
            marker.write_text(token)
        except OSError as error:
            raise StoreError(f"{marker}: cannot be written: {error.strerror}") from error
        try:
            by_worker = self._client.run(_folder_problem, str(marker), token, str(site.scans.inbox))
        finally:
            marker.unlink(missing_ok=True)
        problems = [f"  {worker}: {problem}" for worker, problem in sorted(by_worker.items()) if problem]
        if problems:
            message = "the workers must have the same folders under the same paths:"
            raise ConfigError("\n".join([message, *problems]))


def require_secure(address: str) -> None:
    """Raise ConfigError unless an address is loopback or encrypted: workers execute arbitrary code."""
    url = urlsplit(address)
    if url.scheme == "tls" and url.hostname:
        return
    if url.scheme != "tcp" or not url.hostname:
        raise ConfigError(f"--scheduler {address}: expected tcp://127.0.0.1:PORT or tls://HOST:PORT")
    try:
        is_loopback = url.hostname == "localhost" or ipaddress.ip_address(url.hostname).is_loopback
    except ValueError:
        is_loopback = False
    if not is_loopback:
        raise ConfigError(
            f"--scheduler {address}: not encrypted: use tls:// for another machine"
            " (with its certificates in the Dask configuration, distributed.comm.tls)"
        )


def versions() -> dict[str, str]:
    """Return the versions of all packages that affect the results."""
    return {
        "station": f"{__version__} {_source_hash()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "netCDF4": netCDF4.__version__,
        "h5py": h5py.__version__,
    }


def _source_hash() -> str:
    """Return a hash of the source of the package: two builds of one version may differ."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[2].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def _worker_versions() -> dict[str, str]:
    return versions()


def _folder_problem(marker: str, token: str, inbox: str) -> str:
    path = Path(marker)
    if not path.is_file() or path.read_text() != token:
        return f"{path.parent} is not the same folder on the worker"
    if not os.access(path.parent, os.W_OK):
        return f"{path.parent} is not writable on the worker"
    return "" if os.access(inbox, os.R_OK | os.X_OK) else f"{inbox} is not readable on the worker"


def _reprocess_on_worker(site: Site, scan: ScanFile, history: ScanHistory) -> StoredResult | Rejected:
    with _netcdf_lock:
        return reprocess_scan(site, scan, history, lambda: None)


def _forward_result(dask_future: Any, future: Future[StoredResult | Rejected]) -> None:  # noqa: ANN401 - Dask has no types
    if dask_future.status == "finished":
        future.set_result(dask_future.result())
    elif dask_future.cancelled():
        future.set_exception(NotReadyError("stopped before it was done"))
    else:
        future.set_exception(dask_future.exception())
