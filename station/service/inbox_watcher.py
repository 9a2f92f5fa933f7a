"""Watches the inbox for file events.

Events only wake the loop: no event is necessary, none is sufficient (service.md, 1).
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from watchdog.events import FileSystemEvent, FileSystemEventHandler
from watchdog.observers import Observer
from watchdog.observers.polling import PollingObserver

from station.logs import logfmt

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from watchdog.observers.api import BaseObserver

log = logging.getLogger("station")

_IGNORED_EVENTS = {"opened", "closed_no_write"}  # caused by reading a scan
_POLL_INTERVAL_S = 5.0


class InboxWatcher(FileSystemEventHandler):
    """Reports file events of a folder, also after the folder was removed and created again."""

    def __init__(
        self, folder: Path, on_event: Callable[[], None], *, polling: bool, recursive: bool = False
    ) -> None:
        self._folder = folder
        self._recursive = recursive
        self._on_event = on_event
        self._polling = polling
        self._observer: BaseObserver | None = None
        self._identity: tuple[int, int] | None = None

    def ensure_watching(self) -> None:
        """Watch the present folder; without a folder or free inotify watches, do nothing."""
        try:
            stat = self._folder.stat()
        except OSError:
            self.close()
            return
        identity = (stat.st_dev, stat.st_ino)
        # A recreated folder may reuse the inode; the old observer's emitters ended with the old folder.
        if identity == self._identity and (self._observer is None or is_alive(self._observer)):
            return
        self.close()
        self._identity = identity
        observer = PollingObserver(timeout=_POLL_INTERVAL_S) if self._polling else Observer()
        try:
            observer.schedule(self, str(self._folder), recursive=self._recursive)
            observer.start()
        except OSError as error:  # the inotify watches of the system are used up
            log.warning(logfmt(inbox=self._folder, events="none", reason=f"{error}: the inbox is polled"))
            return
        self._observer = observer

    def close(self) -> None:
        """Stop watching."""
        if self._observer is not None:
            self._observer.stop()
            self._observer.join(5.0)
        self._observer = None
        self._identity = None

    def on_any_event(self, event: FileSystemEvent) -> None:
        """Call `on_event`, except for events that reading causes."""
        if event.event_type not in _IGNORED_EVENTS:
            self._on_event()


def is_alive(observer: BaseObserver) -> bool:
    """Return True if an observer and its emitters run; after removal of the folder only the observer does."""
    return observer.is_alive() and all(emitter.is_alive() for emitter in observer.emitters)
