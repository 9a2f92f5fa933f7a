"""Where messages go: apprise URLs, each a credential by its name; no secret stands in the site file."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from pathlib import Path
from typing import NoReturn

from station.errors import ConfigError
from station.service.logs import logfmt

log = logging.getLogger("station")

PATIENCE_S = 60.0  # with all targets together; what is slower counts as not delivered


def urls_of(names: tuple[str, ...]) -> dict[str, str]:
    """Return the URL of each target, the file of its name in $CREDENTIALS_DIRECTORY.

    Raises ConfigError naming all that are missing.
    """
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    if names and not folder:
        raise ConfigError(
            f"alarms: where are {', '.join(names)}? $CREDENTIALS_DIRECTORY is not set: systemd sets it by"
            " LoadCredential= lines; by hand, set it to a folder with a file of each name that holds its URL"
        )
    urls, faults = {}, []
    for name in names:
        path = Path(folder or "") / name
        try:
            urls[name] = path.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            faults.append(f"alarms: target {name}: no URL in {path}: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return urls


def send(messages: dict[str, tuple[str, str]], *, patience_s: float = PATIENCE_S) -> dict[str, str]:
    """Send each target its (title, text), all at once; return why it failed, by target, for those that did.

    Returns within `patience_s`, whatever the other side does. Raises ConfigError where a target has no URL or
    apprise is not installed.
    """
    try:
        import apprise  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError("alarms need apprise: pip install 'tls-station[alarms]'") from error
    logging.getLogger("apprise").setLevel(logging.WARNING)  # beyond, it tells URLs
    failed = dict.fromkeys(messages, f"no answer within {patience_s:g} s")

    def deliver(target: str, url: str, title: str, text: str) -> None:
        try:
            way = apprise.Apprise()
            if not way.add(url):
                failed[target] = "its URL is none that apprise knows"
            elif not way.notify(title=title, body=text, body_format=apprise.NotifyFormat.TEXT):
                failed[target] = "not delivered: see the log"
            else:
                del failed[target]
        except Exception as error:  # noqa: BLE001 - other people's code; its words may hold the URL
            failed[target] = f"not delivered: {type(error).__name__}"

    urls = urls_of(tuple(messages))
    workers = [
        threading.Thread(target=deliver, args=(target, urls[target], *message), daemon=True)
        for target, message in messages.items()
    ]
    for worker in workers:
        worker.start()
    until_s = time.monotonic() + patience_s
    for worker in workers:
        worker.join(max(0.0, until_s - time.monotonic()))
    lost = dict(failed)  # a late answer changes nothing any more
    for target, why in lost.items():
        log.error(logfmt(target=target, reason=why))
    return lost


def leave(status: int) -> NoReturn:
    """End the process now: apprise's own threads would hold it until the last target has answered."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
