"""Closed days and months are joined in a child of its own while scans are taken: a month takes minutes."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

from station.config import Site
from station.errors import NotReadyError
from station.service import child
from station.service.upkeep import Checksums, join_beside


class Joining:
    """One thread that waits for that child; it touches neither journal nor series."""

    def __init__(self, site: Site, on_done: Callable[[], None]) -> None:
        """`on_done` is called, in another thread, when there is something to `take`."""
        self._site = site
        self._on_done = on_done
        self._stop = threading.Event()
        self._thread = ThreadPoolExecutor(max_workers=1)
        self._under_way: Future[Checksums] | None = None

    def begin(self, known: Mapping[str, str], *, in_backlog: bool) -> None:
        """Begin, unless it is under way; see `upkeep.join_epochs`."""
        if self._under_way is None:
            self._under_way = self._thread.submit(self._run, dict(known), in_backlog)
            self._under_way.add_done_callback(lambda _: self._on_done())

    def take(self) -> Checksums | None:
        """Return the checksums of what was joined, once; None while there is nothing to tell.

        Raises what the child raised: StoreError where a file is damaged or cannot be written.
        """
        if self._under_way is None or not self._under_way.done():
            return None
        done, self._under_way = self._under_way, None
        try:
            return done.result()
        except NotReadyError:  # stopped, or killed again and again: it comes again at its time
            return {}

    def close(self) -> None:
        """End it, whatever it is at: what is half done is made anew another time."""
        self._stop.set()
        self._thread.shutdown()

    def _run(self, known: Mapping[str, str], in_backlog: bool) -> Checksums:  # noqa: FBT001
        return child.run(
            join_beside,
            self._site,
            known,
            in_backlog,
            memory_gb=self._site.service.memory_gb,
            timeout_s=math.inf,
            should_stop=self._stop.is_set,
        )
