"""The table of ratios: what each way takes against decoding the scan, and how it grows."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.cost import Cost, fresh_s_a_gb

VERSIONS = ("numpy", "scipy", "laspy", "lazrs", "netCDF4", "datashader", "numba", "py4dgeo")
HEADS = ("CPU-s", "ratio", "wall-s", "ratio ", "peak GB")


@dataclass(frozen=True)
class Row:
    """One way: what it took against what `base` took; no cost: why there is none stands in the note."""

    title: str
    cost: Cost | None
    base: Cost | None = None
    must: dict[str, float] = field(default_factory=dict)  # cpu, wall: ratios; cpu_s, wall_s; peak_gb
    aim: dict[str, float] = field(default_factory=dict)
    note: str = ""

    @property
    def figures(self) -> dict[str, float]:
        """Return what was measured of it, and what it is to the base."""
        if self.cost is None:
            return {}
        told = {name: value for name, value in vars(self.cost).items() if value and name != "startup_s"}
        for name in ("cpu", "wall"):
            most = vars(self.base).get(f"{name}_s") if self.base else None
            if most and f"{name}_s" in told:
                told[name] = told[f"{name}_s"] / most
        return told

    @property
    def missed(self) -> list[str]:
        """Return which figures are not what they must be."""
        return [name for name, most in self.must.items() if self.figures.get(name, 0.0) > most]


WORDS = {
    "cpu": "CPU × {:g}",
    "wall": "wall × {:g}",
    "cpu_s": "{:g} CPU-s",
    "wall_s": "{:g} s",
    "peak_gb": "{:.2f} GB",
}


def show(sections: Iterable[tuple[str, list[Row]]]) -> None:
    """Print all rows as one table, and what it was measured on."""
    table = Table(title="Ratios", title_justify="left", caption=footer(), caption_justify="left")
    table.add_column("what")
    for head in HEADS:
        table.add_column(head, justify="right")
    table.add_column("must (aim)")
    table.add_column("without")
    for title, rows in sections:
        table.add_section()
        table.add_row(f"[bold]{title}")
        for row in rows:
            table.add_row(row.title, *_cells(row), _limits(row), row.note)
    Console(width=170).print(table)


def _cells(row: Row) -> list[str]:
    told = row.figures
    shown = (("cpu_s", ".2f"), ("cpu", ".2f"), ("wall_s", ".1f"), ("wall", ".2f"), ("peak_gb", ".2f"))
    return [f"{told[name]:{form}}" if name in told else "" for name, form in shown]


def _limits(row: Row) -> str:
    told = []
    for name, most in row.must.items():
        aim = f" ({row.aim[name]:g})" if name in row.aim else ""
        said = "" if name not in row.figures else ": missed" if name in row.missed else ": met"
        told.append(WORDS[name].format(most) + aim + said)
    return ", ".join(told)


def footer() -> str:
    """Say on what the figures were measured."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        cpu = platform.processor() or platform.machine()
    found = []
    for name in VERSIONS:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    fresh_s = fresh_s_a_gb()
    cores, loaded = len(os.sched_getaffinity(0)), os.getloadavg()[1]
    said = f"{cores} cores of {cpu}, load {loaded:.1f}, Python {sys.version.split()[0]}, {', '.join(found)}."
    return (
        f"{said} CPU: user and system of the process and its children. Start-up (imports, first compilation)"
        " and the end of a process are taken off everywhere. A GB of memory that was not used for a while"
        f" takes {fresh_s:.2g} CPU-s, which is little on a machine of its own."
        " Accuracy: python -m benchmarks.accuracy; soak: python -m benchmarks.soak."
    )
