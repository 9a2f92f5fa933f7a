"""Notices of new epochs: the owner's command (hook), and a request to a dead man's switch (heartbeat)."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import tempfile
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

from station.archive.epochs import epoch_files
from station.config import Site
from station.logs import logfmt
from station.monitoring.notifiers import target_urls
from station.processing.site_files import series_for
from station.sections.publish import PublishSection
from station.service.publication.upload_record import UploadRecord

log = logging.getLogger("station")

MAX_TRIES = 3  # of the hook for one epoch
HEARTBEAT_TIMEOUT_S = 20.0
_PATH = "/usr/local/bin:/usr/bin:/bin"


def send_notices(site: Site, settings: PublishSection, record: UploadRecord) -> list[str]:
    """Send the heartbeat and run the hook for epochs that are new; return what failed.

    A failed heartbeat is repeated by the next call, a failed hook at most twice. Raises ConfigError if the
    heartbeat has no URL, StoreError if the record cannot be kept.
    """
    paths = [epoch_file.path for epoch_file in epoch_files(series_for(site))]
    faults = []
    if settings.heartbeat and paths:
        faults.append(_send_heartbeat(settings.heartbeat, paths[-1], record))
    if settings.hook:
        faults.append(_run_hooks(site, settings, paths, record))
    return [fault for fault in faults if fault]


def _send_heartbeat(name: str, newest: Path, record: UploadRecord) -> str:
    """Request the URL once for the newest epoch: without new epochs the switch gives the alarm."""
    if newest.name in record.tries("heartbeat"):
        return ""
    url = target_urls((name,))[name]
    reason = ""
    try:
        if not url.startswith(("https://", "http://")):
            raise ValueError("not a web address")  # noqa: TRY301 - as the errors of urllib
        with urllib.request.urlopen(url, timeout=HEARTBEAT_TIMEOUT_S):  # noqa: S310 - checked above
            pass
    except urllib.error.HTTPError as error:
        reason = f"status {error.code}"
    except (OSError, ValueError) as error:  # its text may contain the secret URL
        reason = type(error).__name__
    if reason:
        return f"heartbeat {name}: {reason}"
    record.add_try("heartbeat", [newest.name], is_done=True)
    return ""


def _run_hooks(site: Site, settings: PublishSection, paths: list[Path], record: UploadRecord) -> str:
    """Run the hook for each new epoch, oldest first; those from before the first call are not new."""
    tries = record.tries("hook")
    if not tries:
        record.add_try("hook", ["", *(path.name for path in paths)], is_done=True)
        return ""
    fault = ""
    for path in paths:
        if tries.get(path.name, 0) >= MAX_TRIES:
            continue
        reason = _run_hook(site, settings, path)
        record.add_try("hook", [path.name], is_done=not reason)
        if reason:
            log.error(logfmt(hook="failed", epoch=path.name, reason=reason))
            fault = f"hook: {path.name}: {reason}"
    return fault


def _run_hook(site: Site, settings: PublishSection, epoch: Path) -> str:
    """Run the hook with the path of an epoch as its last argument; return why it failed, or ''.

    It gets no variable of our environment but PATH, an empty folder to work in, and an end after its limit,
    with all processes it started.
    """
    environment = {
        "PATH": _PATH,
        "STATION_ID": site.station.id,
        "STATION_SITE": str(site.path),
        "STATION_EPOCH": str(epoch),
    }
    with tempfile.TemporaryDirectory(prefix="station-hook-") as folder:
        try:
            process = subprocess.Popen(  # noqa: S603 - the owner's command, without a shell
                [*settings.hook, str(epoch)],
                env=environment,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=2,  # data goes to stdout, logs to stderr
                start_new_session=True,
            )
        except OSError as error:
            return f"{settings.hook[0]}: {error.strerror}"
        try:
            status = process.wait(timeout=settings.hook_limit_s)
        except subprocess.TimeoutExpired:
            return f"ended after {settings.hook_limit_s:g} s"
        finally:
            _kill_group(process)
    return f"exit status {status}: see the log" if status else ""


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """End a process and all that are left in its session."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
