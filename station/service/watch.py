"""An ear at the inbox. It only wakes the loop: no file event is necessary, none sufficient (SERVICE.md)."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from watchdog.events import FileSystemEvent, FileSystemEventHandler
from watchdog.observers import Observer
from watchdog.observers.polling import PollingObserver

from station.service.logs import logfmt

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from watchdog.observers.api import BaseObserver

log = logging.getLogger("station")

_OUR_OWN = {"opened", "closed_no_write"}  # reading a scan is not news
_POLL_S = 5.0


class Ear(FileSystemEventHandler):
    """Hears what happens in a folder, also when the folder is removed and made again."""

    def __init__(self, folder: Path, wake: Callable[[], None], *, polling: bool) -> None:
        self._folder = folder
        self._wake = wake
        self._polling = polling
        self._observer: BaseObserver | None = None
        self._identity: tuple[int, int] | None = None

    def listen(self) -> None:
        """Be listening to the folder that is there now; without one, or without watches, be quietly deaf."""
        try:
            status = self._folder.stat()
        except OSError:
            self.close()
            return
        identity = (status.st_dev, status.st_ino)
        # A folder made again may get the old one's number: then its watch tells, which ended with the folder.
        if identity == self._identity and (self._observer is None or all_alive(self._observer)):
            return
        self.close()
        self._identity = identity
        observer = PollingObserver(timeout=_POLL_S) if self._polling else Observer()
        try:
            observer.schedule(self, str(self._folder))
            observer.start()
        except OSError as error:  # the system's watches are used up
            log.warning(logfmt(inbox=self._folder, events="none", reason=f"{error}: it is listed anyway"))
            return
        self._observer = observer

    def close(self) -> None:
        """Listen no more."""
        if self._observer is not None:
            self._observer.stop()
            self._observer.join(5.0)
        self._observer = None
        self._identity = None

    def on_any_event(self, event: FileSystemEvent) -> None:
        """Wake the loop."""
        if event.event_type not in _OUR_OWN:
            self._wake()


def all_alive(observer: BaseObserver) -> bool:
    """Tell whether an observer still hears; one whose folder was removed lives on, deaf."""
    return observer.is_alive() and all(emitter.is_alive() for emitter in observer.emitters)
