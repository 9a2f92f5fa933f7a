"""One page per paper, from the table of numbers and the docstrings of the science modules."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import station.science
from station.errors import StoreError
from station.papers import mobile_lidar
from station.papers.errata import ERRATA, NOT_REPRODUCIBLE, PAPERS, Paper
from station.papers.hartzell import HARTZELL_NUMBERS
from station.papers.leslar import LESLAR_NUMBERS
from station.papers.ozendi import OZENDI_NUMBERS
from station.papers.paper_number import PaperNumber
from station.papers.voordendag import VOORDENDAG_NUMBERS

PAPER_NUMBERS = (*HARTZELL_NUMBERS, *VOORDENDAG_NUMBERS, *OZENDI_NUMBERS, *LESLAR_NUMBERS)


@dataclass(frozen=True)
class Check:
    """A paper number and the value computed by the program."""

    number: PaperNumber
    computed: float

    @property
    def passes(self) -> bool:
        """Whether the computed value is within the tolerance."""
        return abs(self.computed - self.number.expected) <= self.number.tolerance


def run_checks(paper: str | None = None) -> list[Check]:
    """Compute the numbers of one paper, or of all."""
    return [Check(number, number.computed()) for number in PAPER_NUMBERS if paper in {None, number.paper}]


def format_table(checks: Sequence[Check]) -> str:
    """Return the numbers as lines of text by paper, the printed values next to the computed ones."""
    lines: list[str] = []
    for paper in PAPERS:
        rows = [check for check in checks if check.number.paper == paper.key]
        if rows:
            lines += [f"{paper.key}: {paper.authors}", _format_row("", "where", "number", *_HEADINGS)]
            lines += [line for check in rows for line in _format_check(check)]
            lines.append("")
    compared = [check for check in checks if check.number.is_check]
    passed = sum(check.passes for check in compared)
    lines += [
        f"{passed} of {len(compared)} numbers within tolerance (ok, else NO).",
        f"{len(checks) - len(compared)} further rows (-) cannot disagree: they convert a unit,",
        "or their inputs were chosen for the printed value. A line with ! explains the row above it.",
    ]
    return "\n".join(lines)


_HEADINGS = ("printed", "expected", "computed", "unit")


def _format_row(mark: str, *columns: str) -> str:
    where, what, printed, expected, computed, unit = columns
    return f"{mark:2} {where:11} {what:64} {printed:>8} {expected:>8} {computed:>8} {unit}".rstrip()


def _format_check(check: Check) -> Iterator[str]:
    """Yield the row of a number, and its note on a line of its own."""
    number = check.number
    mark = ("ok" if number.is_check else "-") if check.passes else "NO"
    values = ("-" if number.printed is None else f"{number.printed:.5g}", f"{number.expected:.5g}")
    yield _format_row(mark, number.equation, number.what, *values, f"{_rounded(check):.5g}", number.unit)
    if number.note:
        yield f"{'':15}! {number.note}"


def _rounded(check: Check) -> float:
    """Return the computed value, zero if it is far below the tolerance."""
    return check.computed if abs(check.computed) >= 1e-6 * check.number.tolerance else 0.0


def format_page(paper: Paper, checks: Sequence[Check]) -> str:
    """Return the page of a paper in Markdown: numbers, errata, functions for its equations."""
    numbers = [check for check in checks if check.number.paper == paper.key]
    rows = [_page_row(check) for check in numbers if check.number.is_check]
    other_rows = [_page_row(check) for check in numbers if not check.number.is_check]
    header = [
        "| number | equation | paper | expected | computed | unit | note |",
        "|---|---|---|---|---|---|---|",
    ]
    errata = [f"| {e.equation} | {e.wrong} | {e.built} |" for e in ERRATA if e.paper == paper.key]
    functions = [
        f"| `{name}` | {what} | {source} |" for name, what, source in sorted(set(_functions_citing(paper)))
    ]
    return "\n".join(
        [
            f"# {paper.authors}", "", f"{paper.title}", "", f"Used for: {paper.subject}.", "",
            "## Numbers", "",
            "Computed by the functions of the program; `expected` is from an independent computation.", "",
            *header, *rows, "",
            *(
                ["Rows that cannot disagree: unit conversions, and inputs chosen for the printed value.", "",
                 *header, *other_rows, ""]
                if other_rows else []
            ),
            f"Cannot be reproduced: {NOT_REPRODUCIBLE[paper.key]}.", "",
            "## Errors and open points", "",
            "| equation | in the paper | in this program |", "|---|---|---|", *errata, "",
            "## Functions for its equations", "",
            "| function | returns | source |", "|---|---|---|", *functions, "",
        ]
    )  # fmt: skip


def _page_row(check: Check) -> str:
    number = check.number
    printed = "–" if number.printed is None else f"{number.printed:.5g}"
    expected = f"{number.expected:.5g} ± {number.tolerance:.2g}"
    note = number.note if check.passes else f"**not reproduced** {number.note}"
    computed = f"{_rounded(check):.5g}"
    cells = (number.what, number.equation, printed, expected, computed, number.unit, note)
    return f"| {' | '.join(cells)} |"


def write_pages(checks: Sequence[Check], folder: Path) -> list[Path]:
    """Write a page for each paper with computed numbers; raise StoreError if it cannot be written."""
    written = []
    for paper in PAPERS:
        if any(check.number.paper == paper.key for check in checks):
            path = folder / f"{paper.key}.md"
            try:
                folder.mkdir(parents=True, exist_ok=True)
                path.write_text(format_page(paper, checks), encoding="utf-8")
            except OSError as error:
                raise StoreError(f"{path}: cannot be written: {error.strerror}") from error
            written.append(path)
    return written


def science_modules() -> Iterator[ModuleType]:
    """Yield the modules that implement equations of the papers."""
    for info in pkgutil.walk_packages(station.science.__path__, "station.science."):
        if not info.ispkg:
            yield importlib.import_module(info.name)
    yield mobile_lidar


def _functions_citing(paper: Paper) -> Iterator[tuple[str, str, str]]:
    """Yield name, summary and source of every function and class that cites the paper."""
    for module in science_modules():
        for name, member in vars(module).items():
            if getattr(member, "__module__", "") != module.__name__ or not callable(member):
                continue
            parts = [(name, member)]
            if inspect.isclass(member):
                parts += [
                    (f"{name}.{method}", function)
                    for method, function in vars(member).items()
                    if inspect.isfunction(function)
                ]
            for full_name, part in parts:
                text = " ".join((inspect.getdoc(part) or "").split())
                if paper.authors in text:
                    source = text[text.index(paper.authors) + len(paper.authors) :].strip(" ,:")
                    module_name = module.__name__.rpartition(".")[2]
                    yield f"{module_name}.{full_name}", _sentence(text), _sentence(source)


def _sentence(text: str) -> str:
    """Return the first sentence of a text; abbreviations do not end it."""
    return re.split(r"(?<!Eq)(?<!Fig)(?<!al)\.(?: |$)", text)[0]
