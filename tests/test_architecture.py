"""The house stays as it was drawn."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "station"
MODULES = sorted(PACKAGE.rglob("*.py"))
SCIENCE = sorted((PACKAGE / "science").glob("*.py"))
IMPURE = {
    "os", "pathlib", "time", "datetime", "logging", "threading", "subprocess",
    "netCDF4", "xarray", "laspy", "watchdog", "apscheduler",
}  # fmt: skip


def functions(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def test_nothing_else_stands_at_the_top():
    wanted = {
        "station", "config", "systemd", "tests", "benchmarks", "pyproject.toml", "README.md",
        "CHANGELOG.md", "LICENSE",
    }  # fmt: skip
    built = {"build", "dist", "station-demo"}  # what the README's commands leave
    found = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")} - built
    assert found <= wanted


def test_no_room_without_a_purpose():
    vague = {"utils", "util", "helpers", "helper", "common", "misc", "manager", "base"}
    assert not [path for path in MODULES if path.stem in vague]


@pytest.mark.parametrize("path", SCIENCE, ids=lambda path: path.stem)
def test_science_is_pure(path):
    imported = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imported |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or "").split(".")[0])
    assert not imported & IMPURE


def test_each_equation_has_one_home():
    """No two functions claim the same equation of the same paper as their source's first."""
    homes = {}
    for path in SCIENCE:
        for function in functions(path):
            told = re.search(
                r"Source: (\w+) et al\. \((\d{4})\), Eq\. ([\d, -]+)", ast.get_docstring(function) or ""
            )
            if told:
                homes.setdefault((told[1], told[3].strip(" ,")), []).append(f"{path.stem}.{function.name}")
    shared = {key: names for key, names in homes.items() if len(names) > 1}
    # The mean of residuals and the variance of a mean are taken of one scan and of several.
    assert set(shared) <= {("Hartzell", "12"), ("Voordendag", "10")}, shared


def test_every_equation_of_the_papers_has_a_home():
    """But two of which the sheet of equations that all was built from has nothing."""
    found = set()
    for path in SCIENCE:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                continue
            text = " ".join((ast.get_docstring(node) or "").split())
            told = re.split(r"(Hartzell|Voordendag|Ozendi|Leslar) et al\.", text)
            for author, said in zip(told[1::2], told[2::2], strict=True):
                for numbers in re.findall(r"Eq\. (\d+(?:(?:-|, | and )\d+)*)", said):
                    for part in re.split(", | and ", numbers):
                        first, _, last = part.partition("-")
                        found |= {(author, number) for number in range(int(first), int(last or first) + 1)}
    counted = {"Hartzell": 21, "Voordendag": 18, "Ozendi": 8, "Leslar": 12}
    wanted = {(author, 1 + number) for author, count in counted.items() for number in range(count)}
    assert wanted - found == {("Ozendi", 5), ("Leslar", 8)}


def test_equations_are_tested():
    """Every function of the science that names its source stands in a test by name."""
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    told = "\n".join(path.read_text(encoding="utf-8") for path in MODULES)
    missing = []
    for path in SCIENCE:
        for function in functions(path):
            if function.name.startswith("_") or "Source:" not in (ast.get_docstring(function) or ""):
                continue
            used_inside = len(re.findall(rf"\b{function.name}\(", told)) > 1
            if not re.search(rf"\b{function.name}\b", tests) and not used_inside:
                missing.append(f"{path.stem}.{function.name}")
    assert not missing


def test_numbers_carry_their_unit():
    """A parameter called by a bare quantity says nothing of its unit."""
    bare = {
        "range",
        "angle",
        "temperature",
        "pressure",
        "humidity",
        "distance",
        "height",
        "time",
        "tilt_angle",
    }
    found = [
        f"{path.stem}.{function.name}({argument.arg})"
        for path in [*SCIENCE, PACKAGE / "pipeline.py"]
        for function in functions(path)
        for argument in [*function.args.args, *function.args.kwonlyargs]
        if argument.arg in bare
    ]
    assert not found
