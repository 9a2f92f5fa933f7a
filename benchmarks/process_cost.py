"""CPU time, wall time and peak memory of programs, each in its own process, and the table of their ratios."""

from __future__ import annotations

import gc
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

MEMORY_REST_S = 5.0
SERVICE_PROCESSES = 3  # of an idle service: itself, multiprocessing's resource tracker, its fork server
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}  # a BLAS thread that spins while it waits would count as work
PACKAGES = ("numpy", "scipy", "laspy", "lazrs", "netCDF4", "datashader", "numba", "py4dgeo")
COLUMNS = {
    "cpu_s": "CPU-s",
    "cpu": "ratio",
    "wall_s": "wall-s",
    "wall": "ratio ",
    "peak_gb": "peak GB",
    "disk_gb": "disk GB",
}
DECIMALS = {"cpu_s": 2, "cpu": 2, "wall_s": 1, "wall": 2, "peak_gb": 2, "disk_gb": 2}
LIMITS = {
    "cpu": "CPU × {:g}",
    "wall": "wall × {:g}",
    "cpu_s": "{:g} CPU-s",
    "wall_s": "{:g} s",
    "peak_gb": "{:.2f} GB",
    "disk_gb": "{:g} GB on disk",
}


@dataclass(frozen=True)
class Cost:
    """Cost of a program without start-up and exit, which a service pays once; 0 where not measured."""

    cpu_s: float  # user and system time of the process and all its children
    wall_s: float = 0.0
    peak_gb: float = 0.0  # of the largest process
    startup_s: float = 0.0
    disk_gb: float = 0.0  # of what it wrote


class FailedError(Exception):
    """A program that failed; the message ends with the last line of its output."""


def cost_of(command: Sequence[str], folder: Path, env: dict[str, str] | None = None) -> tuple[Cost, str]:
    """Return the cost of a command run in a folder, and its standard output; FailedError if it fails.

    The peak includes the size of the calling process at the start of the command, so that must be small.
    """
    start_s = time.monotonic()
    with (folder / "stdout").open("wb+") as out, (folder / "stderr").open("wb+") as err:
        child = subprocess.Popen(
            command, cwd=folder, stdout=out, stderr=err, env=os.environ | ONE_THREAD | (env or {})
        )
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.monotonic() - start_s
    output = (folder / "stdout").read_text(encoding="utf-8", errors="replace")
    if child.returncode:
        text = (folder / "stderr").read_text(encoding="utf-8", errors="replace").strip() or output.strip()
        raise FailedError(f"exit status {child.returncode}: {text.splitlines()[-1] if text else ''}")
    return Cost(usage.ru_utime + usage.ru_stime, wall_s, usage.ru_maxrss * 1024 / 1e9), output


def job_cost(
    module: str, name: str, folder: Path, env: dict[str, str] | None = None, /, **arguments: object
) -> tuple[Cost, dict[str, Any]]:
    """Run a job of a benchmark module in a folder; return its cost without imports, and its result."""
    root = str(Path(__file__).parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", module, name, json.dumps(arguments)]
    cost, output = cost_of(command, folder, {"PYTHONPATH": path} | (env or {}))
    result = json.loads(output.strip().splitlines()[-1])
    startup_s, peak_gb = result.pop("startup_s"), result.pop("peak_gb")
    return Cost(cost.cpu_s - startup_s, cost.wall_s - startup_s, peak_gb, startup_s), result


def run_job(jobs: dict[str, Callable[..., dict[str, Any]]]) -> None:
    """Run the job named on the command line, with its arguments as JSON, and print its result as JSON.

    The process starts and ends as a worker process of the service does: neither a garbage collection of the
    imported modules nor the shutdown of the interpreter is part of the work.
    """
    name, arguments = sys.argv[1:]
    gc.freeze()
    end_startup()
    result = jobs[name](**json.loads(arguments))
    children_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e9
    peak_gb = max(peak_of(os.getpid()), children_gb)
    print(json.dumps(result | {"startup_s": _startup_s[-1], "peak_gb": peak_gb}), flush=True)
    os._exit(0)


def end_startup() -> None:
    """Count all CPU time of this process so far as start-up."""
    _startup_s.append(time.process_time())


_startup_s: list[float] = []


def median_cost(costs: Sequence[Cost]) -> Cost:
    """Return the median of each figure."""
    return Cost(*(median(getattr(cost, name) for cost in costs) for name in Cost.__annotations__))


def fresh_memory_s_per_gb() -> float:
    """CPU time for a gigabyte of memory that was unused for a while [s/GB].

    It is seconds on virtual machines that return free memory to their host, for every program of that size.
    """
    time.sleep(MEMORY_REST_S)
    start_s = time.process_time()
    memory = b"1" * 2**30
    return (time.process_time() - start_s) / (len(memory) / 1e9)


def family(pid: int) -> list[int]:
    """Return the ids of a process and of all its descendants, parents first."""
    pids = [pid]
    for parent in pids:
        with suppress(OSError):  # it has ended
            for task in list(Path(f"/proc/{parent}/task").iterdir()):
                pids += [int(child) for child in _read(task / "children").split()]
    return pids


def cpu_of(pids: Sequence[int]) -> float:
    """User and system time of processes and of all children they have waited for [s]."""
    ticks = 0
    for pid in pids:
        fields = _read(Path(f"/proc/{pid}/stat")).rpartition(")")[2].split()
        ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def peak_of(pid: int) -> float:
    """Peak resident memory of a process [GB], 0 if it has ended."""
    lines = _read(Path(f"/proc/{pid}/status")).splitlines()
    return next((int(line.split()[1]) * 1024 / 1e9 for line in lines if line.startswith("VmHWM")), 0.0)


def _read(path: Path) -> str:
    """Return a text file of /proc, empty if the process has ended."""
    try:
        return path.read_text()
    except OSError:
        return ""


@dataclass(frozen=True)
class Row:
    """A row of the table: a cost relative to `base`; `limits` and `goals` are by figure.

    `cpu` and `wall` are ratios. A row without cost has the reason in its note.
    """

    title: str
    cost: Cost | None
    base: Cost | None = None
    limits: dict[str, float] = field(default_factory=dict)
    goals: dict[str, float] = field(default_factory=dict)
    note: str = ""

    @property
    def figures(self) -> dict[str, float]:
        """Return the measured figures and their ratios to the base."""
        if self.cost is None:
            return {}
        figures = {name: value for name, value in vars(self.cost).items() if value and name != "startup_s"}
        for name in ("cpu", "wall"):
            base = vars(self.base).get(f"{name}_s") if self.base else None
            if base and f"{name}_s" in figures:
                figures[name] = figures[f"{name}_s"] / base
        return figures

    @property
    def exceeded(self) -> list[str]:
        """Return the names of the figures above their limits."""
        return [name for name, limit in self.limits.items() if self.figures.get(name, 0.0) > limit]

    def cells(self) -> list[str]:
        """Return the texts of the row, by column."""
        figures = self.figures
        numbers = [
            f"{figures[name]:.{digits}f}" if name in figures else "" for name, digits in DECIMALS.items()
        ]
        limits = []
        for name, limit in self.limits.items():
            goal = f" ({self.goals[name]:g})" if name in self.goals else ""
            verdict = ": missed" if name in self.exceeded else ": met"
            limits.append(LIMITS[name].format(limit) + goal + (verdict if name in figures else ""))
        return [self.title, *numbers, ", ".join(limits), self.note]


def print_rows(sections: Iterable[tuple[str, list[Row]]]) -> None:
    """Print all rows as one table, with a description of the machine."""
    from rich.console import Console  # noqa: PLC0415 - not part of the start-up of a job
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="Ratios", title_justify="left", caption=_footer(), caption_justify="left")
    table.add_column("what")
    for head in COLUMNS.values():
        table.add_column(head, justify="right")
    table.add_column("limit (goal)")
    table.add_column("does not include")
    for title, rows in sections:
        table.add_section()
        table.add_row(f"[bold]{title}")
        for row in rows:
            table.add_row(*row.cells())
    Console(width=170).print(table)


def _footer() -> str:
    """Return a description of the machine, the packages and the kind of figures."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        cpu = platform.processor() or platform.machine()
    packages = []
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            packages.append(f"{name} {version(name)}")
    load = os.getloadavg()[1]  # before the pause of the memory test
    return (
        f"{len(os.sched_getaffinity(0))} cores of {cpu}, load {load:.1f}, Python {sys.version.split()[0]}, "
        f"{', '.join(packages)}. CPU: user and system time of the process and its children, without start-up "
        "(imports, first compilation) and exit. A gigabyte of memory that was unused for a while costs "
        f"{fresh_memory_s_per_gb():.2g} CPU-s; on a physical machine this is little. "
        "Accuracy: python -m benchmarks.accuracy; endurance: python -m benchmarks.soak."
    )
