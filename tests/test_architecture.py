"""The architecture: layers, names, the home of each equation, and the citations."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "station"
MODULES = sorted(PACKAGE.rglob("*.py"))
SCIENCE = [*sorted((PACKAGE / "science").rglob("*.py")), PACKAGE / "papers" / "mobile_lidar.py"]
FORBIDDEN = (
    "felt", "told", "held", "lean", "leans", "leaning", "leaned", "leant", "likeness", "outlook", "outlooks",
    "onset", "onsets", "anew", "nought", "amid", "lest", "beforehand",
)  # fmt: skip
VAGUE = {"utils", "util", "helpers", "helper", "common", "misc", "manager", "base", "made", "once", "held"}
MAX_MODULES = 14
TEXTS = {
    path: path.read_text(encoding="utf-8")
    for path in PACKAGE.rglob("*")
    if path.suffix in {".py", ".js", ".css", ".html", ".j2", ".toml"}
}


def name(path):
    return str(path.relative_to(ROOT).with_suffix("")).replace("/", ".")


MODULE_NAMES = {name(path).removesuffix(".__init__") for path in MODULES}


@cache
def nodes(path):
    """Return all nodes of the syntax tree of a file."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def functions(path):
    return [node for node in nodes(path) if isinstance(node, ast.FunctionDef)]


def imported_modules(path):
    """Return the names under which a module imports other modules of the package."""
    return {
        alias.asname or alias.name
        for node in nodes(path)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if f"{node.module}.{alias.name}" in MODULE_NAMES
    }


def test_only_known_entries_at_the_top_level():
    expected = {
        "station", "config", "systemd", "tests", "benchmarks", "docs", "pyproject.toml",
        "mkdocs.yml", "requirements.lock", "README.md", "CHANGELOG.md", "CONTRIBUTING.md",
        "CITATION.cff", "LICENSE",
    }  # fmt: skip
    generated = {"build", "dist", "site", "station-demo"}  # left by the README's and the docs' commands
    actual = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")} - generated
    assert actual <= expected


def test_no_vague_module_names():
    assert not [path for path in MODULES if path.stem in VAGUE]


def test_no_folder_has_too_many_modules():
    modules = Counter(path.parent for path in MODULES if path.name != "__init__.py")
    assert not {name(folder): count for folder, count in modules.items() if count > MAX_MODULES}


@pytest.mark.parametrize("word", FORBIDDEN)
def test_forbidden_words(word):
    """Private words occur nowhere in the package: not in a name, a message, a comment or a docstring."""
    pattern = re.compile(rf"(?<![A-Za-z]){word}(?![A-Za-z])", re.IGNORECASE)
    camel = re.compile(rf"(?<![A-Z]){word.capitalize()}(?=[A-Z]|\b)")
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path, text in TEXTS.items()
        if word in text.lower()  # much faster than the patterns
        for number, line in enumerate(text.splitlines(), 1)
        if pattern.search(line) or camel.search(line)
    ]
    assert not found


def test_no_class_name_twice():
    classes = Counter(
        node.name
        for path in MODULES
        for node in nodes(path)
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert not [name for name, count in classes.items() if count > 1]


def test_no_name_shadows_an_imported_module():
    """No function, parameter or variable bears the name of a module that its file imports."""
    found = []
    for path in MODULES:
        modules = imported_modules(path)
        fields = {
            id(field.target)
            for node in nodes(path)
            if isinstance(node, ast.ClassDef)
            for field in node.body
            if isinstance(field, ast.AnnAssign)
        }
        for node in nodes(path):
            if id(node) in fields:
                continue
            bound = (
                node.name if isinstance(node, (ast.FunctionDef, ast.ClassDef))
                else node.arg if isinstance(node, ast.arg)
                else node.id if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
                else None
            )  # fmt: skip
            if bound in modules:
                found.append(f"{name(path)}:{node.lineno} {bound}")
    assert not found


def test_citations_resolve():
    """`equations.md, 6.2` in the code is a numbered heading of a page of the docs."""
    headings = {}
    for page in (ROOT / "docs").rglob("*.md"):
        numbers = re.findall(r"^#+ (\d+(?:\.\d+)*)\b", page.read_text(encoding="utf-8"), re.MULTILINE)
        headings.setdefault(page.name, set()).update(numbers)
    missing, cited = [], 0
    for path in [*MODULES, *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        for page, numbers in re.findall(
            r"\b([a-z_-]+\.md)\b(?:,\s+((?:\d+(?:\.\d+)*(?:,\s+|\s+and\s+)?)+))?", text
        ):
            cited += 1
            if page not in headings:
                missing.append(f"{name(path)}: {page}")
            missing += [
                f"{name(path)}: {page}, {number}"
                for number in re.findall(r"\d+(?:\.\d+)*", numbers)
                if number not in headings.get(page, ())
            ]
    assert cited > 50
    assert not missing


def test_the_map_of_the_code_leads_to_the_word():
    """Each word of CONTRIBUTING's map stands in the path, docstring, definitions or headings of its file."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|`]+?) \| `([^`|]+)` \|", text[text.index("Map of the code") :], re.MULTILINE)
    assert len(rows) >= 40
    missing = []
    for words, place in rows:
        path = ROOT / place
        if not path.is_file():
            missing.append(f"{words}: no file {place}")
            continue
        content = path.read_text(encoding="utf-8")
        if path.suffix == ".py":
            tree = ast.parse(content)
            defined = [
                node.name for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.ClassDef))
            ]
            content = f"{ast.get_docstring(tree)} {' '.join(defined)}"
        else:
            content = "\n".join(re.findall(r"^#+ .*$", content, re.MULTILINE))
        searched = re.sub(r"[_\-/.]", " ", f"{place} {content}").lower()
        searched = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", searched)
        if not any(re.sub(r"[_\-]", " ", word.strip().lower()) in searched for word in words.split(",")):
            missing.append(f"{words}: not in {place}")
    assert not missing


def test_each_equation_has_one_home():
    """No two functions claim the same equation of the same paper first."""
    homes = {}
    for path in SCIENCE:
        for function in functions(path):
            source = re.search(
                r"Source: (\w+) et al\. \((\d{4})\), Eq\. ([\d, -]+)", ast.get_docstring(function) or ""
            )
            if source:
                homes.setdefault((source[1], source[3].strip(" ,")), []).append(
                    f"{path.stem}.{function.name}"
                )
    shared = {key: names for key, names in homes.items() if len(names) > 1}
    # The mean of residuals and the variance of a mean are taken of one scan and of several.
    assert set(shared) <= {("Hartzell", "12"), ("Voordendag", "10")}, shared


def test_every_equation_of_the_papers_has_a_home():
    """Except for two that docs/explanation/equations.md does not use."""
    actual = set()
    for path in SCIENCE:
        for node in nodes(path):
            if not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                continue
            text = " ".join((ast.get_docstring(node) or "").split())
            parts = re.split(r"(Hartzell|Voordendag|Ozendi|Leslar) et al\.", text)
            for author, citation in zip(parts[1::2], parts[2::2], strict=True):
                for numbers in re.findall(r"Eq\. (\d+(?:(?:-|, | and )\d+)*)", citation):
                    for part in re.split(", | and ", numbers):
                        first, _, last = part.partition("-")
                        actual |= {(author, number) for number in range(int(first), int(last or first) + 1)}
    counted = {"Hartzell": 21, "Voordendag": 18, "Ozendi": 8, "Leslar": 12}
    expected = {(author, 1 + number) for author, count in counted.items() for number in range(count)}
    assert expected - actual == {("Ozendi", 5), ("Leslar", 8)}


def test_every_equation_is_tested():
    """Each function with a source is named in a test or in a row of the papers, or called by one that is."""
    paths = [*(ROOT / "tests").rglob("test_*.py"), *(PACKAGE / "papers").glob("*.py")]
    tests = set(re.findall(r"\w+", "\n".join(path.read_text(encoding="utf-8") for path in paths)))
    missing = []
    for path in SCIENCE:
        calls = {
            function.name: {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
            for function in functions(path)
        }
        covered = tests & set(calls)
        covered |= {called for name in covered for called in calls[name]}
        missing += [
            f"{path.stem}.{function.name}"
            for function in functions(path)
            if "Source:" in (ast.get_docstring(function) or "")
            and not function.name.startswith("_")
            and function.name not in covered
        ]
    assert not missing


def test_numbers_carry_their_unit():
    """A parameter that is named after a bare quantity does not tell its unit."""
    bare = {
        "range", "angle", "temperature", "pressure", "humidity", "distance", "height", "time", "tilt_angle",
    }  # fmt: skip
    found = [
        f"{path.stem}.{function.name}({argument.arg})"
        for path in [*SCIENCE, PACKAGE / "processing" / "pipeline.py"]
        for function in functions(path)
        for argument in [*function.args.args, *function.args.kwonlyargs]
        if argument.arg in bare
    ]
    assert not found
