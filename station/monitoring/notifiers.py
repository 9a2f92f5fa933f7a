"""Delivery of messages by apprise. Each URL is a named credential: the site file contains no secret."""

from __future__ import annotations

import logging
import os
import re
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from urllib.parse import unquote

from station.errors import ConfigError
from station.logs import logfmt

if TYPE_CHECKING:
    from collections.abc import Iterable

log = logging.getLogger("station")

MIN_SECRET = 4  # characters; shorter parts of a URL are no secrets
_SEPARATORS = re.compile(r"[:/?&=@,;#\s]+")
SEND_TIMEOUT_S = 60.0  # for all targets together; slower ones count as not delivered


def target_urls(names: tuple[str, ...]) -> dict[str, str]:
    """Return the URL of each target, read from the file of its name in $CREDENTIALS_DIRECTORY.

    Raises ConfigError that names all missing targets.
    """
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    if names and not folder:
        raise ConfigError(
            f"no URL for {', '.join(names)}: $CREDENTIALS_DIRECTORY is not set. systemd sets it by"
            " LoadCredential= lines; by hand, set it to a folder with one file per name that contains its URL"
        )
    urls, faults = {}, []
    for name in names:
        path = Path(folder or "") / name
        try:
            urls[name] = path.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            faults.append(f"target {name}: no URL in {path}: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return urls


class _Redactor(logging.Filter):
    """Removes every part of secret URLs from log records; apprise logs one that it does not understand."""

    def __init__(self, urls: Iterable[str]) -> None:
        super().__init__()
        parts = {part for url in urls for text in (url, unquote(url)) for part in _SEPARATORS.split(text)}
        self._parts = sorted((part for part in parts if len(part) >= MIN_SECRET), key=len, reverse=True)

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return False
        text = record.getMessage()
        for part in self._parts:
            text = text.replace(part, "***")
        record.msg, record.args, record.exc_info = text, (), None
        return True


def send(messages: dict[str, tuple[str, str]], *, timeout_s: float = SEND_TIMEOUT_S) -> dict[str, str]:
    """Send each target its (title, text), all in parallel; return the reason of each failure by target.

    Returns within `timeout_s`, whatever the receivers do. Raises ConfigError if a target has no URL or
    apprise is not installed.
    """
    try:
        import apprise  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError("alarms need apprise: pip install 'tls-station[alarms]'") from error
    urls = target_urls(tuple(messages))
    logging.getLogger("apprise").addFilter(redactor := _Redactor(urls.values()))
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
    if not any(thread.is_alive() for thread in threads):
        logging.getLogger("apprise").removeFilter(redactor)
    for target, reason in undelivered.items():
        log.error(logfmt(target=target, reason=reason))
    return undelivered


def exit_now(status: int) -> NoReturn:
    """End the process at once: apprise's threads would keep it alive until the last target has answered."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
