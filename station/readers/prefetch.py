"""Prefetch of decoded points: a child process decodes the next block while the caller uses this one.

A thread would not do: lazrs holds the GIL while it decodes.
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

from station.errors import InconclusiveError

N_BUFFERS = 2  # one is filled while the other is read

Buffer = NDArray[np.uint8]
FillBuffer = Callable[[Buffer], None]  # decodes the next points into a buffer
OpenDecoder = Callable[[], AbstractContextManager[FillBuffer]]


def prefetch(open_decoder: OpenDecoder, lengths: Sequence[int]) -> Iterator[Buffer]:
    """Yield buffers of given lengths [bytes], filled in order; each is valid until the next is requested.

    A fork of this process fills them ahead, from this call on. They are filled in this process instead if
    there is only one buffer, if the process has other threads (a fork would inherit their locks but not the
    threads that release them), or if the system grants no further process. Raises what `open_decoder` and
    decoding raise; a signal that kills the fork kills this process too, as if it had decoded itself.
    """
    if len(lengths) < N_BUFFERS or len(list(Path("/proc/self/task").iterdir())) > 1:
        return _decode_inline(open_decoder, lengths)
    try:
        buffers = np.frombuffer(mmap.mmap(-1, N_BUFFERS * max(lengths)), np.uint8).reshape(N_BUFFERS, -1)
        parent_conn, child_conn = Pipe()
        pid = os.fork()
    except OSError:  # no process or memory to spare at the moment: not the scan's fault
        return _decode_inline(open_decoder, lengths)
    if not pid:
        parent_conn.close()
        _child_main(open_decoder, lengths, buffers, child_conn)
    child_conn.close()
    return _from_child(lengths, buffers, parent_conn, pid)


def _decode_inline(open_decoder: OpenDecoder, lengths: Sequence[int]) -> Iterator[Buffer]:
    buffer = np.empty(max(lengths, default=0), np.uint8)
    with open_decoder() as fill:
        for length in lengths:
            fill(buffer[:length])
            yield buffer[:length]


def _from_child(
    lengths: Sequence[int], buffers: Buffer, parent_conn: Connection, pid: int
) -> Iterator[Buffer]:
    connection_lost = False
    try:
        for index, length in enumerate(lengths):
            if (fault := parent_conn.recv()) is not None:
                raise fault
            yield buffers[index % N_BUFFERS, :length]
            with suppress(ConnectionError):  # the child has finished, or recv() raises next
                parent_conn.send(None)
    except (EOFError, ConnectionError):
        connection_lost = True
    finally:
        parent_conn.close()
        status = _kill_and_reap(pid)
    if connection_lost:
        if os.WIFSIGNALED(status):
            os.kill(os.getpid(), os.WTERMSIG(status))
        raise InconclusiveError(f"the decoder process ended without a message (wait status {status})")


def _child_main(
    open_decoder: OpenDecoder, lengths: Sequence[int], buffers: Buffer, child_conn: Connection
) -> NoReturn:
    """Run as the child process: fill the buffers in turn; the end of either process closes the pipe."""
    try:
        with open_decoder() as fill:
            for index, length in enumerate(lengths):
                if index >= N_BUFFERS:
                    child_conn.recv()
                fill(buffers[index % N_BUFFERS, :length])
                child_conn.send(None)
    except (EOFError, ConnectionError):
        pass  # the parent has stopped reading
    except BaseException as fault:  # noqa: BLE001 - the parent raises it
        child_conn.send(fault)
    finally:
        os._exit(0)


def _kill_and_reap(pid: int) -> int:
    """Kill the child if it still runs; return its wait status."""
    try:
        os.kill(pid, signal.SIGKILL)
        return os.waitpid(pid, 0)[1]
    except (ProcessLookupError, ChildProcessError):  # SIGCHLD is ignored: there is nothing to wait for
        return 0
