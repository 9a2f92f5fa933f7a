"""Decode on while the block before is worked on, in a process beside this one.

A thread would not do: lazrs holds the interpreter's lock as long as it decodes.
"""

from __future__ import annotations

import mmap
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from station.errors import ScanError

ROOMS = 2  # one is filled while the other is read

Room = NDArray[np.uint8]
Opened = Callable[[], AbstractContextManager[Callable[[Room], None]]]  # gives what fills the next room


def filled(opened: Opened, lengths: Sequence[int]) -> Iterator[Room]:
    """Give rooms of some lengths [bytes], filled one after the other; each holds until the next is asked for.

    They are filled ahead, from the call on, by a fork of this process; not so where one is all there is, or
    where this process has threads, which a fork would leave behind with their locks held, or where the system
    grants no further process. Raises what `opened` and filling raise; where a decoder kills the fork, it
    kills this process too, as if it had run here.
    """
    if len(lengths) < ROOMS or len(list(Path("/proc/self/task").iterdir())) > 1:
        return _in_turn(opened, lengths)
    try:
        rooms = np.frombuffer(mmap.mmap(-1, ROOMS * max(lengths)), np.uint8).reshape(ROOMS, -1)
        here, there = Pipe()
        pid = os.fork()
    except OSError:  # too many processes or too little memory at the moment are not the scan's fault
        return _in_turn(opened, lengths)
    if not pid:
        here.close()
        _fill(opened, lengths, rooms, there)
    there.close()
    return _from_beside(lengths, rooms, here, pid)


def _in_turn(opened: Opened, lengths: Sequence[int]) -> Iterator[Room]:
    room = np.empty(max(lengths, default=0), np.uint8)
    with opened() as fill:
        for length in lengths:
            fill(room[:length])
            yield room[:length]


def _from_beside(lengths: Sequence[int], rooms: Room, here: Connection, pid: int) -> Iterator[Room]:
    lost = False
    try:
        for number, length in enumerate(lengths):
            if (fault := here.recv()) is not None:
                raise fault
            yield rooms[number % ROOMS, :length]
            with suppress(ConnectionError):  # it is through, or what ended it is told next
                here.send(None)
    except (EOFError, ConnectionError):
        lost = True
    finally:
        here.close()
        status = _end(pid)
    if lost:
        if os.WIFSIGNALED(status):
            os.kill(os.getpid(), os.WTERMSIG(status))
        raise ScanError(f"the decoder ended without a word (wait status {status})")


def _fill(opened: Opened, lengths: Sequence[int], rooms: Room, there: Connection) -> NoReturn:
    """Be the process beside; its end is told by the end of the pipe, and so is that of the other."""
    try:
        with opened() as fill:
            for number, length in enumerate(lengths):
                if number >= ROOMS:
                    there.recv()
                fill(rooms[number % ROOMS, :length])
                there.send(None)
    except (EOFError, ConnectionError):
        pass  # nobody wants more
    except BaseException as fault:  # noqa: BLE001 - it is raised there
        there.send(fault)
    finally:
        os._exit(0)


def _end(pid: int) -> int:
    """Make sure that a child has ended; return its wait status."""
    try:
        os.kill(pid, signal.SIGKILL)
        return os.waitpid(pid, 0)[1]
    except (ProcessLookupError, ChildProcessError):  # this process does not want to know of its children
        return 0
