"""Arrival of scans: whether the next one is overdue."""

from __future__ import annotations

import logging
from collections.abc import Callable

from station.logs import logfmt

OVERDUE_INTERVALS = 1.5

log = logging.getLogger("station")


class Arrivals:
    """When the last scan arrived, by a clock that only runs forward [s]; logs when they stop and return."""

    def __init__(self, monotonic_s: Callable[[], float]) -> None:
        self._monotonic_s = monotonic_s
        self._last_s = monotonic_s()
        self.is_overdue = False

    def record(self, count: int) -> None:
        """Record that scans arrived since the last call."""
        if count:
            self._last_s = self._monotonic_s()
            if self.is_overdue:
                log.info(logfmt(scans="arriving again", new=count))
            self.is_overdue = False

    def check(self, expected_every_s: float) -> None:
        """Log one warning when a scan is overdue."""
        silent_s = self._monotonic_s() - self._last_s
        if silent_s > OVERDUE_INTERVALS * expected_every_s and not self.is_overdue:
            self.is_overdue = True
            log.warning(
                logfmt(
                    scans="overdue",
                    silent_s=round(silent_s),
                    expected_every_s=round(expected_every_s),
                    reason="nothing new in the inbox: check the scanner and the transfer",
                )
            )
