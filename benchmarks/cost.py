"""What a program takes, run in a process of its own."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

LONG_UNUSED_S = 5.0
LASTING = 3  # processes of an idle service: it, the tracker of its resources, the server of its children
STEPS = ("write_s", "publish_s", "show_s")  # of what the store takes for an epoch
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}  # a BLAS that spins for work would be counted as work


@dataclass(frozen=True)
class Cost:
    """What it took, start-up and end taken off: a service has one each. Nought where it was not measured."""

    cpu_s: float  # user and system, of the process and all its children
    wall_s: float = 0.0
    peak_gb: float = 0.0  # of the largest process
    startup_s: float = 0.0


class FailedError(Exception):
    """A program that did not end well; its last words."""


def cost_of(command: Sequence[str], folder: Path, env: dict[str, str] | None = None) -> tuple[Cost, str]:
    """Run a command in a folder; return what it took and its standard output.

    This process must be small: what a child inherits at its start counts towards its peak.
    """
    began_s = time.monotonic()
    with (folder / "stdout").open("wb+") as out, (folder / "stderr").open("wb+") as err:
        child = subprocess.Popen(
            command, cwd=folder, stdout=out, stderr=err, env=os.environ | ONE_THREAD | (env or {})
        )
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.monotonic() - began_s
    said = (folder / "stdout").read_text(encoding="utf-8", errors="replace")
    if child.returncode:
        told = (folder / "stderr").read_text(encoding="utf-8", errors="replace").strip() or said.strip()
        raise FailedError(f"exit status {child.returncode}: {told.splitlines()[-1] if told else ''}")
    return Cost(used.ru_utime + used.ru_stime, wall_s, used.ru_maxrss * 1024 / 1e9), said


def job_cost(
    module: str, name: str, cwd: Path, env: dict[str, str] | None = None, /, **told: object
) -> tuple[Cost, dict[str, Any]]:
    """Run one job of a module of the benchmark; return what it took without its imports, and its figures."""
    command = [sys.executable, "-m", module, name, json.dumps(told)]
    root = str(Path(__file__).parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    cost, said = cost_of(command, cwd, {"PYTHONPATH": path} | (env or {}))
    figures = json.loads(said.strip().splitlines()[-1])
    startup_s = figures.pop("startup_s")
    return Cost(cost.cpu_s - startup_s, cost.wall_s - startup_s, cost.peak_gb, startup_s), figures


def run_job(jobs: dict[str, Any]) -> None:
    """Be the process of one job: the arguments are its name and what it is told, as JSON.

    It begins and ends as the children of a service do: to look through what is loaded for garbage, or to take
    an interpreter down, is no work on a scan.
    """
    name, told = sys.argv[1:]
    gc.freeze()
    ready()
    figures = jobs[name](**json.loads(told))
    print(json.dumps(figures | {"startup_s": _startup_s[-1]}), flush=True)
    os._exit(0)


def ready() -> None:
    """Say that the process of a job has its libraries: what comes now is its work."""
    _startup_s.append(time.process_time())


_startup_s: list[float] = []


def middle(costs: Sequence[Cost]) -> Cost:
    """Return the median of each figure."""
    return Cost(*(median(getattr(one, name) for one in costs) for name in Cost.__annotations__))


def fresh_s_a_gb() -> float:
    """CPU seconds that a gigabyte takes to be had, which nobody has used for a while.

    Virtual machines that hand free memory back to their host take seconds for it, and so does any program of
    its size there.
    """
    time.sleep(LONG_UNUSED_S)
    began_s = time.process_time()
    held = b"1" * 2**30
    return (time.process_time() - began_s) / (len(held) / 1e9)


def family(pid: int) -> list[int]:
    """Return a process and all below it, nearest first."""
    found = [pid]
    for one in found:
        with suppress(OSError):  # it has ended meanwhile
            for task in list(Path(f"/proc/{one}/task").iterdir()):
                found += [int(child) for child in _told(task / "children").split()]
    return found


def cpu_of(pids: Sequence[int]) -> float:
    """User and system time of processes and of all children they have waited for [s]."""
    ticks = 0
    for one in pids:
        fields = _told(Path(f"/proc/{one}/stat")).rpartition(")")[2].split()
        ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def peak_of(pid: int) -> float:
    """Most memory that a process has held [GB]."""
    lines = _told(Path(f"/proc/{pid}/status")).splitlines()
    return next((int(line.split()[1]) * 1024 / 1e9 for line in lines if line.startswith("VmHWM")), 0.0)


def _told(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:  # it has just ended
        return ""
