"""Delivery of messages by apprise. Each URL is a named credential: the site file contains no secret."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from pathlib import Path
from typing import NoReturn

from station.errors import ConfigError
from station.logs import logfmt

log = logging.getLogger("station")

SEND_TIMEOUT_S = 60.0  # for all targets together; slower ones count as not delivered


def target_urls(names: tuple[str, ...]) -> dict[str, str]:
    """Return the URL of each target, read from the file of its name in $CREDENTIALS_DIRECTORY.

    Raises ConfigError that names all missing targets.
    """
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    if names and not folder:
        raise ConfigError(
            f"alarms: no URL for {', '.join(names)}: $CREDENTIALS_DIRECTORY is not set. systemd sets it by"
            " LoadCredential= lines; by hand, set it to a folder with one file per name that contains its URL"
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


def send(messages: dict[str, tuple[str, str]], *, timeout_s: float = SEND_TIMEOUT_S) -> dict[str, str]:
    """Send each target its (title, text), all in parallel; return the reason of each failure by target.

    Returns within `timeout_s`, whatever the receivers do. Raises ConfigError if a target has no URL or
    apprise is not installed.
    """
    try:
        import apprise  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError("alarms need apprise: pip install 'tls-station[alarms]'") from error
    logging.getLogger("apprise").setLevel(logging.WARNING)  # below that level it logs URLs
    failed = dict.fromkeys(messages, f"no answer within {timeout_s:g} s")

    def deliver(target: str, url: str, title: str, text: str) -> None:
        try:
            notifier = apprise.Apprise()
            if not notifier.add(url):
                failed[target] = "apprise does not support its URL"
            elif not notifier.notify(title=title, body=text, body_format=apprise.NotifyFormat.TEXT):
                failed[target] = "not delivered: see the log"
            else:
                del failed[target]
        except Exception as error:  # noqa: BLE001 - third-party code; its message may contain the URL
            failed[target] = f"not delivered: {type(error).__name__}"

    urls = target_urls(tuple(messages))
    threads = [
        threading.Thread(target=deliver, args=(target, urls[target], *message), daemon=True)
        for target, message in messages.items()
    ]
    for thread in threads:
        thread.start()
    deadline_s = time.monotonic() + timeout_s
    for thread in threads:
        thread.join(max(0.0, deadline_s - time.monotonic()))
    undelivered = dict(failed)  # later answers are ignored
    for target, reason in undelivered.items():
        log.error(logfmt(target=target, reason=reason))
    return undelivered


def exit_now(status: int) -> NoReturn:
    """End the process at once: apprise's threads would keep it alive until the last target has answered."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
