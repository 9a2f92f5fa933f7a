"""Scans redone on a Dask cluster: the same function, on other machines that see the same folders."""

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

import station
from station import __version__
from station.config import Site
from station.errors import ConfigError, NotReadyError, StoreError
from station.service.inbox import Arrival
from station.service.tasks import Outcome, Past, Refused, redo

PATIENCE_S = 30.0
_one_at_a_time = threading.Lock()  # of a worker's threads: the netCDF library knows no others


class Cluster:
    """A Dask cluster that is safe to use: reached over loopback or TLS, of one version, with our folders."""

    def __init__(self, address: str, site: Site) -> None:
        """Raise ConfigError where it may not be used, NotReadyError where it is not there."""
        require_safe(address)
        try:
            import distributed  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise ConfigError("--scheduler needs Dask: pip install 'tls-station[cluster]'") from error
        dask: Any = distributed  # has few types
        try:
            self._client = dask.Client(address, timeout=PATIENCE_S, set_as_default=False)
        except (OSError, ValueError, RuntimeError) as error:
            raise NotReadyError(f"{address}: no Dask scheduler answers: {error}") from error
        try:
            self._require_alike()
            self._require_folders(site)
        except BaseException:
            self.close()
            raise
        self.count = len(self._client.scheduler_info(n_workers=-1)["workers"])

    def start(self, site: Site, arrival: Arrival, past: Past) -> Future[Outcome | Refused]:
        """Begin to redo a scan."""
        told: Future[Outcome | Refused] = Future()
        told.set_running_or_notify_cancel()
        there = self._client.submit(_redo_there, site, arrival, past, pure=False, retries=2)
        there.add_done_callback(lambda done: _pass_on(done, told))
        return told

    def close(self) -> None:
        """Let go of the cluster; what runs there is cancelled."""
        self._client.close()

    def _require_alike(self) -> None:
        """Raise ConfigError unless every worker computes with what we compute with."""
        ours, theirs = versions(), self._client.run(_versions_there)
        if not theirs:
            raise NotReadyError("the cluster has no workers yet")
        faults = [
            f"  {worker}: {name} {told.get(name)}, here {version}"
            for worker, told in sorted(theirs.items())
            for name, version in ours.items()
            if told.get(name) != version
        ]
        if faults:
            raise ConfigError("\n".join(["the workers differ, and so might the numbers:", *faults]))

    def _require_folders(self, site: Site) -> None:
        """Raise ConfigError unless every worker sees our folders and may write to our data."""
        token = secrets.token_hex(16)
        mark = site.station.data / f".cluster-{token}"
        try:
            mark.write_text(token)
        except OSError as error:
            raise StoreError(f"{mark}: cannot be written: {error.strerror}") from error
        try:
            theirs = self._client.run(_fault_there, str(mark), token, str(site.scans.inbox))
        finally:
            mark.unlink(missing_ok=True)
        faults = [f"  {worker}: {fault}" for worker, fault in sorted(theirs.items()) if fault]
        if faults:
            says = "the workers must see the same folders, under the same paths:"
            raise ConfigError("\n".join([says, *faults]))


def require_safe(address: str) -> None:
    """Raise ConfigError unless an address is loopback or encrypted: who reaches a worker can run anything."""
    told = urlsplit(address)
    if told.scheme == "tls" and told.hostname:
        return
    if told.scheme != "tcp" or not told.hostname:
        raise ConfigError(f"--scheduler {address}: give tcp://127.0.0.1:PORT or tls://HOST:PORT")
    try:
        near = told.hostname == "localhost" or ipaddress.ip_address(told.hostname).is_loopback
    except ValueError:
        near = False
    if not near:
        raise ConfigError(
            f"--scheduler {address}: not encrypted: another machine is reached by tls:// only"
            " (its certificates in Dask's configuration, distributed.comm.tls)"
        )


def versions() -> dict[str, str]:
    """Return the versions of everything that numbers depend on."""
    return {
        "station": f"{__version__} {_source()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "netCDF4": netCDF4.__version__,
        "h5py": h5py.__version__,
    }


def _source() -> str:
    """Identify the source of the package: two states of one version may compute otherwise."""
    told = hashlib.sha256()
    for path in sorted(Path(station.__file__).parent.rglob("*.py")):
        told.update(path.read_bytes())
    return told.hexdigest()[:8]


def _versions_there() -> dict[str, str]:
    return versions()


def _fault_there(mark: str, token: str, inbox: str) -> str:
    path = Path(mark)
    if not path.is_file() or path.read_text() != token:
        return f"{path.parent} is not the same folder there"
    if not os.access(path.parent, os.W_OK):
        return f"{path.parent} may not be written there"
    return "" if os.access(inbox, os.R_OK | os.X_OK) else f"{inbox} cannot be read there"


def _redo_there(site: Site, arrival: Arrival, past: Past) -> Outcome | Refused:
    with _one_at_a_time:
        return redo(site, arrival, past, lambda: None)


def _pass_on(done: Any, told: Future[Outcome | Refused]) -> None:  # noqa: ANN401 - Dask has no types
    if done.status == "finished":
        told.set_result(done.result())
    elif done.cancelled():
        told.set_exception(NotReadyError("stopped before it was done"))
    else:
        told.set_exception(done.exception())
