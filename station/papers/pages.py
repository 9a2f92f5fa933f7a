"""One page for each paper, written from the table of figures and the docstrings of the science."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import station.science
from station.errors import StoreError
from station.papers.errata import ERRATA, NOT_REPRODUCIBLE, PAPERS, Paper
from station.papers.figures import FIGURES, Figure


@dataclass(frozen=True)
class Result:
    """A figure and what the program gives for it."""

    figure: Figure
    told: float

    @property
    def good(self) -> bool:
        """Whether it is the right number."""
        return abs(self.told - self.figure.right) <= self.figure.tolerance


def results(paper: str | None = None) -> list[Result]:
    """Compute the figures of a paper, or of all."""
    return [Result(one, one.told()) for one in FIGURES if paper in {None, one.paper}]


def table(found: Sequence[Result]) -> str:
    """Return the figures as lines of text, the papers' values beside the program's."""
    lines = [f"{'':2} {'':15} {'':11} {'':62} {'paper':>9} {'right':>9} {'here':>9}"]
    for one in found:
        figure = one.figure
        printed = "-" if figure.printed is None else f"{figure.printed:.5g}"
        mark = "ok" if one.good else "NO"
        lines.append(
            f"{mark:2} {figure.paper:15} {figure.equation:11} {figure.what:62} {printed:>9}"
            f" {figure.right:>9.5g} {one.told:>9.5g} {figure.unit:7}"
            f"{'! ' + figure.error if figure.error else ''}".rstrip()
        )
    good = sum(one.good for one in found)
    lines.append(f"{good} of {len(found)} right within their tolerance; ! the paper has it otherwise")
    return "\n".join(lines)


def page(paper: Paper, found: Sequence[Result]) -> str:
    """Return the page of a paper in Markdown: numbers, errors, where its equations are."""
    rows = [
        f"| {f.what} | {f.equation} | {'–' if f.printed is None else f'{f.printed:.5g}'} | {f.right:.5g}"
        f" ± {f.tolerance:.2g} | {one.told:.5g} | {f.unit}"
        f" | {'' if one.good else '**not reproduced** '}{f.error} |"
        for one in found
        if (f := one.figure).paper == paper.key
    ]
    wrong = [f"| {e.equation} | {e.wrong} | {e.built} |" for e in ERRATA if e.paper == paper.key]
    homes = [f"| `{name}` | {what} | {source} |" for name, what, source in sorted(set(_homes(paper)))]
    return "\n".join(
        [
            f"# {paper.authors}", "", f"{paper.title}", "", f"What it is for here: {paper.subject}.", "",
            "## Numbers", "",
            "Computed by the functions that measure; `right` is from an independent computation.", "",
            "| what | equation | paper | right | here | unit | note |", "|---|---|---|---|---|---|---|",
            *rows, "",
            f"Cannot be reproduced: {NOT_REPRODUCIBLE[paper.key]}.", "",
            "## Errors and open points", "",
            "| equation | in the paper | here |", "|---|---|---|", *wrong, "",
            "## Where its equations are", "",
            "| function | gives | source |", "|---|---|---|", *homes, "",
        ]
    )  # fmt: skip


def write_pages(found: Sequence[Result], folder: Path) -> list[Path]:
    """Write a page for each paper that figures were computed of; raise StoreError where it cannot."""
    written = []
    for paper in PAPERS:
        if any(one.figure.paper == paper.key for one in found):
            path = folder / f"{paper.key}.md"
            try:
                folder.mkdir(parents=True, exist_ok=True)
                path.write_text(page(paper, found), encoding="utf-8")
            except OSError as error:
                raise StoreError(f"{path}: cannot be written: {error.strerror}") from error
            written.append(path)
    return written


def _homes(paper: Paper) -> Iterator[tuple[str, str, str]]:
    """Give every function and class of the science that names the paper: name, what it gives, source."""
    for found in pkgutil.iter_modules(station.science.__path__):
        module = importlib.import_module(f"station.science.{found.name}")
        for name, member in inspect.getmembers(module):
            if getattr(member, "__module__", "") != module.__name__ or not callable(member):
                continue
            parts = [(name, member)]
            if inspect.isclass(member):
                parts += [
                    (f"{name}.{inner}", one) for inner, one in vars(member).items() if inspect.isfunction(one)
                ]
            for full, part in parts:
                text = " ".join((inspect.getdoc(part) or "").split())
                if paper.authors in text:
                    source = text[text.index(paper.authors) + len(paper.authors) :].strip(" ,:")
                    yield f"{found.name}.{full}", _sentence(text), _sentence(source)


def _sentence(text: str) -> str:
    """Return the first sentence of a text in which `Eq.` and `Fig.` end none."""
    return re.split(r"(?<!Eq)(?<!Fig)\.(?: |$)", text)[0]
