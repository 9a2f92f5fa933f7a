"""The figures of the benchmark as tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.stations import METHODS

Figures = dict[str, Any]

PUBLISHED = (  # box error in m: Voordendag et al. (2023), and the prototype on its own simulation
    ("unattended, published", "±0.50"),
    ("by hand, published", "±0.10"),
    ("prototype, fixed SOP", "0.134 rms"),
    ("prototype, filtered inclination", "0.197 rms"),
    ("prototype, joint: rock all round / ridge and hut", "0.020 / 0.078 rms"),
    ("prototype, joint, surface carried: ridge and hut", "0.025 rms"),
)
BOX_MUST_M = {  # rms / 95 % / max of 100 m boxes
    ("calm", "joint_good"): ("0.03 / 0.06 / 0.10", "0.015 / 0.03 / 0.06"),
    ("calm", "joint_poor"): ("0.04 / 0.08 / 0.15", "0.025 / 0.05 / 0.10"),
    ("snow", "joint_good"): ("0.05", "0.03"),
    ("snow", "joint_poor"): ("0.08", "0.045"),
}
EVENTS = {  # what each figure of an event is, and what it must and should be
    "melt_retained": ("melt retained", "0.95-1.05", "1.00"),
    "melt_last_ratio": ("melt at the end, measured / true", "0.95-1.05", "1.00"),
    "melt_scatter_m": ("scatter of the melting area's mean [m]", "", ""),
    "melt_true_end_m": ("its true change at the end [m]", "", ""),
    "deposit_ratio": ("deposit, measured / true", "", "1.00"),
    "deposit_significant": ("cells of the deposit flagged", "", "1.00"),
    "deposit_cells": ("cells of the deposit", "", ""),
    "away_step_most_m": ("largest step of a box away from it [m]", "", ""),
    "away_step_rms_m": ("rms step of boxes away from it [m]", "", ""),
    "leak_most_m": ("largest box error due to it alone [m]", "≤ 0.01", ""),
    "leak_rms_m": ("rms box error due to it alone [m]", "", ""),
    "thin_few_points": ("10 cm of change found, 1-2 points a cell", "≥ 0.92", "0.98"),
    "thin_few_points_far": ("the same beyond 2.5 km", "≥ 0.92", "0.98"),
    "thin_more_points": ("10 cm of change found, more points", "", ""),
    "thin_cells": ("cells with 1-2 points looked at", "", ""),
}
SPEED_MUST_S, SPEED_AIM_S = 3.0, 2.0


def show(told: Figures) -> None:
    """Print all figures."""
    console = Console(width=150)
    console.print(_table("For comparison: error of 100 m boxes", ("what", "m"), PUBLISHED))
    if "accuracy" in told:
        _show_accuracy(console, told["accuracy"])
    if "disturbed" in told:
        console.print(_disturbed(told["disturbed"]))
    if "speed" in told:
        for name, figures in told["speed"].items():
            console.print(_speed(name, figures))


def _show_accuracy(console: Console, told: Figures) -> None:
    for name, of_methods in told.items():
        console.print(_boxes(name, of_methods))
        events = [
            (what, METHODS[key].title, _number(figures[figure]), must, aim)
            for figure, (what, must, aim) in EVENTS.items()
            for key, figures in of_methods.items()
            if figure in figures
        ]
        if events:
            heads = ("what", "method", "measured", "must", "aim")
            console.print(_table(f"{name}: what is left of the change", heads, events))
        for key, figures in of_methods.items():
            if "calibration" in figures:
                console.print(_calibration(f"{name}, {METHODS[key].title}", figures["calibration"]))
            console.print(f"{name}, {METHODS[key].title}: {figures['verdicts']}")


def _boxes(name: str, of_methods: Figures) -> Table:
    fixed = of_methods.get("fixed")
    rows = []
    for key, one in of_methods.items():
        must, aim = BOX_MUST_M.get((name, key), ("", ""))
        rows.append((
            METHODS[key].title,
            *(_number(one[f"box_{figure}_m"]) for figure in ("rms", "95", "max", "bias", "spread")),
            _number(one["all_boxes_rms_m"]),
            _number(one["far_cell_noise_m"]),
            _number(one["far_cell_noise_m"] / fixed["far_cell_noise_m"]) if fixed else "",
            _number(fixed["box_rms_m"] / one["box_rms_m"]) if fixed else "",
            str(must),
            str(aim),
        ))  # fmt: skip
    heads = (
        "method", "rms", "95 %", "max", "bias", "spread", "rms of all", "cell noise > 2 km", "to fixed SOP",
        "fixed rms / rms", "must", "aim",
    )  # fmt: skip
    return _table(f"{name}: errors of the twenty 100 m boxes [m]", heads, rows)


def _calibration(title: str, told: Figures) -> Table:
    """Lay out spread and coverage of error / sigma; 1 and 0.95 are right."""
    rows = [
        (what, *(_number(one.get(figure, float("nan"))) for figure in ("z_std", "z_robust", "z_mean")),
         _number(one["inside_95"]), str(int(one["count"])))
        for what, one in told.items()
    ]  # fmt: skip
    heads = ("scale and range", "sd of z (aim 1)", "robust sd", "mean", "in 95 % (aim .95)", "n")
    return _table(f"{title}: error / sigma", heads, rows)


def _disturbed(told: Figures) -> Table:
    rows = [
        (
            case, str(one["finished"]), _counted(one["verdicts"]), _counted(one["reasons"]),
            _number(one["box_rms_m"]), _number(one["box_max_m"]), _number(one["z_std_100_m"]),
        )
        for case, one in told.items()
    ]  # fmt: skip
    heads = ("input", "scans finished", "verdicts", "reasons", "box rms [m]", "max [m]", "sd of z, 100 m")
    return _table("Spoilt inputs: a small calm station, joint", heads, rows)


def _counted(told: dict[str, int]) -> str:
    return "\n".join(f"{count} × {what}" for what, count in told.items())


def _speed(name: str, told: Figures) -> Table:
    rows = [(name, _number(value), "", "") for name, value in told.items() if name != "adjustment_s"]
    last = ("adjustment_s", _number(told["adjustment_s"]), f"≤ {SPEED_MUST_S:g}", f"{SPEED_AIM_S:g}")
    return _table(
        f"CPU of the adjustment, 20 M cells, one core, {name}",
        ("what", "measured", "must", "aim"),
        [*rows, last],
    )


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3f}"


def _table(title: str, heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Table:
    table = Table(title=title, title_justify="left")
    for head in heads:
        table.add_column(head)
    for row in rows:
        table.add_row(*row)
    return table
