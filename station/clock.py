"""The clocks of the machine, as an argument: a simulated clock lets years pass in minutes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Clock:
    """The wall clock, the clock that nobody sets, and waiting; all in seconds."""

    now_s: Callable[[], float] = time.time  # since 1970, UTC
    monotonic_s: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
