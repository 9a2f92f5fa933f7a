"""Arguments and options that several commands share."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, TypeVar

import typer

T = TypeVar("T")


class Period(StrEnum):
    """A period of a series (UTC): of each exported file, or of each rate."""

    day = "1D"
    month = "1M"


SiteArgument = Annotated[
    Path, typer.Argument(metavar="SITE", help="The site file (TOML).", show_default=False)
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
FromOption = Annotated[
    str | None, typer.Option("--from", metavar="TIME", help="First epoch, UTC.", show_default=False)
]
ToOption = Annotated[
    str | None, typer.Option("--to", metavar="TIME", help="Last epoch, UTC.", show_default=False)
]
Polygons = Annotated[
    Path | None,
    typer.Argument(
        metavar="POLYGONS",
        help="File of named polygons; without it, those of the site.",
        show_default=False,
    ),
]
CsvOption = Annotated[
    str | None, typer.Option("--csv", metavar="FILE", help="Write CSV; - is stdout.", show_default=False)
]
Against = Annotated[
    str, typer.Option(metavar="EPOCH", help="reference, previous, or an epoch: a scan's name or a time.")
]
TIMES = ["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%SZ"]


def print_or_write(text: str, file: str | None) -> None:
    """Write a text to a file; print it without one, and as it is to stdout, which - stands for."""
    if file is None or file == "-":
        print(text, end="" if file else "\n")
    else:
        Path(file).write_text(text, encoding="utf-8")


def progress_bar(label: str) -> Callable[[list[T]], Iterable[T]]:
    """Return a function that iterates over a list, with a progress bar if stderr is a terminal."""
    from rich.console import Console
    from rich.progress import track

    return lambda rows: track(
        rows, label, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()
    )


@contextmanager
def amount_bar(label: str, total: float) -> Iterator[Callable[[float], None]]:
    """Yield a function that takes what was done of a total, for a progress bar if stderr is a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task(label, total=total)
        yield lambda amount: progress.advance(task, amount)


def json_safe(value: object) -> object:
    """Return the same value with NaN and infinity replaced by None: JSON has neither."""
    if isinstance(value, dict):
        return {key: json_safe(item) for key, item in value.items()}
    if isinstance(value, list):
        return [json_safe(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
