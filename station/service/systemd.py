"""Notifications to systemd: readiness, reload, watchdog and a status line. Source: sd_notify(3)."""

from __future__ import annotations

import math
import os
import socket
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

_WATCHDOG_INTERVAL_S = 1.0
_START_EXTENSION_S = 120.0  # extension requested from systemd, repeatedly while a slow start makes progress


def notify(message: str) -> None:
    """Send a message to systemd if $NOTIFY_SOCKET is set. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.settimeout(5.0)  # an unresponsive systemd must not block the service
        try:
            sender.connect(f"\0{address[1:]}" if address.startswith("@") else address)
            sender.sendall(message.encode("utf-8"))
        except OSError:
            return


class SystemdNotifier:
    """Notifications to systemd, sent on progress and never from a timer.

    A stalled loop sends none, and systemd restarts it (service.md, 6).
    """

    def __init__(self, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        self._monotonic_s = monotonic_s
        self._is_ready = False
        self._status_text = ""
        self._last_watchdog_s = -math.inf
        is_for_this_process = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_s = int(os.environ.get("WATCHDOG_USEC", "0")) / 1e6 if is_for_this_process else 0.0
        self.max_wait_s = watchdog_s / 3 if watchdog_s else 60.0  # of an idle loop

    def watchdog(self) -> None:
        """Report progress; rate-limited, so cheap enough for an inner loop."""
        now_s = self._monotonic_s()
        if now_s - self._last_watchdog_s < min(_WATCHDOG_INTERVAL_S, self.max_wait_s):
            return
        self._last_watchdog_s = now_s
        notify("WATCHDOG=1" if self._is_ready else f"EXTEND_TIMEOUT_USEC={_START_EXTENSION_S * 1e6:.0f}")

    def ready(self) -> None:
        """Report that the service is up, or that a reload has finished."""
        if not self._is_ready:
            self._is_ready = True
            notify("READY=1")

    def reloading(self) -> None:
        """Report the beginning of a reload; `ready()` ends it."""
        self._is_ready = False
        notify(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """Report that the service is stopping."""
        notify("STOPPING=1")

    def status(self, text: str) -> None:
        """Send a one-line description of the present activity, if it has changed."""
        if text != self._status_text:
            self._status_text = text
            notify(f"STATUS={text.replace(chr(10), ' ')}")
