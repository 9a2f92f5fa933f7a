"""The accuracy table: figures of each row beside what is required, for a terminal or a page of the docs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.accuracy_measures import SCALES
from benchmarks.accuracy_rows import Limits, Row
from benchmarks.markdown_tables import write_tables

Figures = dict[str, Any]
SHARE = 0.95  # of the scans: verdicts, reasons
RETAINED = (0.9, 1.1)
CHANCE = 0.01  # less is beyond chance
WIDER = 1.1
HEADS = (
    "case", "100 m boxes, rms / 95 % [m]", "must (aim)", "z: cell / 10 m / 100 m / area", "must",
    "cells in 95 %", "unchanged, yet significant", "good / degraded / unusable", "most frequent reason",
    "retained: 100 m / cells of 1-2 points", "scans with positive error (seed)", "missed",
)  # fmt: skip


def missed(row: Row, figures: Figures) -> list[str]:
    """Return the names of the figures that are outside the limits of a row."""
    z = figures["z"]
    checks: list[tuple[str, float, Limits | None]] = [
        ("rms", figures["box_rms_m"], row.boxes_must_m and (0.0, row.boxes_must_m[0])),
        ("95 %", figures["box_95_m"], row.boxes_must_m and (0.0, row.boxes_must_m[1])),
        *((f"z {scale}", z[scale], row.z) for scale in SCALES),
        ("significant", figures["significant"], row.significant),
        ("good", figures["verdicts"]["good"], (SHARE, 1.0) if row.good else None),
        ("reason", figures["reason_share"], (SHARE, 1.0) if row.reason else None),
        ("sign", figures["sign_chance"], (CHANCE, 1.0) if row.sign else None),
        ("wider", figures.get("sigma_ratio", math.nan), (WIDER, math.inf) if row.wider else None),
    ]
    if row.z_bands:
        checks += [
            (f"z {scale} {band}", value, row.z)
            for band, by_scale in figures["z_bands"].items()
            for scale, value in by_scale.items()
        ]
    covered = row.z is None or row.z[0] <= z["area"] <= row.z[1]
    if row.retained and not covered:
        checks.append(("retained", figures["retained"]["100 m"], RETAINED))
    return [
        name for name, value, limits in checks
        if limits and not math.isnan(value) and not limits[0] <= value <= limits[1]
    ]  # fmt: skip


def main_table(rows: dict[str, Row], figures: dict[str, Figures]) -> list[tuple[str, ...]]:
    """Return the cells of the main table, a row a case."""
    table: list[tuple[str, ...]] = []
    for name, its in figures.items():
        row = rows[name]
        retained, verdicts = its["retained"], its["verdicts"]
        table.append((
            f"{name}: {row.title}",
            _slashed((its["box_rms_m"], its["box_95_m"]), 3),
            _limits(row),
            _slashed(its["z"].values(), 2),
            f"{row.z[0]:g}-{row.z[1]:g}" if row.z else "",
            _number(its["inside_95"], 3),
            f"{_percent(its['significant'], 1)}{' (3-7 %)' if row.significant else ''}",
            " / ".join(_percent(share) for share in verdicts.values()),
            its["reason"],
            _slashed((retained["100 m"], retained["few"]), 2),
            ", ".join(f"{_percent(share)} ({seed})" for seed, share in its["positive"].items()),
            ", ".join(missed(row, its)) or "none",
        ))  # fmt: skip
    return table


def band_table(figures: dict[str, Figures]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return heads and cells of the table of z by range, and of differences between consecutive scans."""
    bands = list(next(iter(figures.values()))["z_bands"])
    by_range = (f"z at {band}: cell / 10 m / 100 m" for band in bands)
    heads = ("case", *by_range, "scan to scan: 10 m / 100 m / area", "σ of 100 m boxes [m]")
    cells = [
        (
            name,
            *(_slashed(its["z_bands"][band].values(), 2) for band in bands),
            _slashed(its["z_pairs"].values(), 2),
            _number(its["sigma_m"], 3) + (f" (× {its['sigma_ratio']:.1f})" if "sigma_ratio" in its else ""),
        )
        for name, its in figures.items()
    ]
    return heads, cells


def print_tables(rows: dict[str, Row], figures: dict[str, Figures], title: str) -> None:
    """Print both tables."""
    console = Console(width=240)
    for heads, cells in ((HEADS, main_table(rows, figures)), band_table(figures)):
        table = Table(title=title, title_justify="left")
        for head in heads:
            table.add_column(head)
        for row in cells:
            table.add_row(*row)
        console.print(table)


def write_markdown(
    page: Path, rows: dict[str, Row], figures: dict[str, Figures], title: str, *, small: bool
) -> None:
    """Write both tables into a page, in which small stations have tables of their own."""
    tables = (HEADS, main_table(rows, figures)), band_table(figures)
    write_tables(page, "accuracy --small" if small else "accuracy", title, tables)


def _limits(row: Row) -> str:
    if not row.boxes_must_m:
        return ""
    aim = f" ({_plain(row.boxes_aim_m)})" if row.boxes_aim_m else ""
    return _plain(row.boxes_must_m) + aim


def _plain(values: Limits) -> str:
    return " / ".join(f"{value:g}" for value in values)


def _slashed(values: Iterable[float], digits: int) -> str:
    return " / ".join(_number(value, digits) for value in values)


def _number(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"


def _percent(share: float, digits: int = 0) -> str:
    return "–" if math.isnan(share) else f"{share:.{digits}%}"
