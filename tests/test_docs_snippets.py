"""Run the commands and the Python of README.md and docs/, page by page.

A page runs in a folder of its own that holds `station-demo`, a simulated station of three hours, processed
once. Fenced blocks run in their order on the page:

    ```console              each line `$ command`, by bash; other lines are sample output and are not compared
    ```python               all blocks of a page share one namespace
    ```LANG title="PATH"    the block is written to PATH
    ```LANG {.no-run}       not run: needs root, systemd, a network or another program

Blocks of any other language are not run. A command on several lines has a backslash at the end of each line
but the last.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import NamedTuple

import pytest

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[1]
PAGES = sorted(path.relative_to(ROOT) for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")))
OPTIONAL = {"cdo", "gdalinfo", "ncdump", "nccopy", "ncks", "ncra"}  # skipped if not installed
TIMEOUT_S = 300
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<info>[^`\n]+)\n(?P<text>.*?)^(?P=indent)```$", re.MULTILINE | re.DOTALL
)
INTERPRETER = """\
import json, os, sys, traceback
replies = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
namespace = {"__name__": "__main__"}
sys.path.insert(0, os.getcwd())
for line in sys.stdin:
    try:
        exec(compile(json.loads(line), "<snippet>", "exec"), namespace)
        reply = None
    except BaseException:
        reply = traceback.format_exc()
    print(json.dumps(reply), file=replies, flush=True)
"""


class Block(NamedTuple):
    language: str
    title: str
    text: str


def blocks(page):
    """Return the blocks of a page that are run or written, in their order."""
    runnable = []
    for match in FENCE.finditer((ROOT / page).read_text(encoding="utf-8")):
        language, _, rest = match["info"].strip().partition(" ")
        title = re.search(r'title="([^"]+)"', rest)
        if "no-run" not in rest and (title or language in {"console", "python"}):
            text = textwrap.dedent(match["text"])
            runnable.append(Block(language, title[1] if title else "", text))
    return runnable


def commands(text):
    """Return the commands of a console block."""
    joined = re.sub(r"\\\n\s*", "", text)
    return [line.removeprefix("$ ") for line in joined.splitlines() if line.startswith("$ ")]


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Environment variables under which `station` and `python` are those of the tests."""
    folder = tmp_path_factory.mktemp("bin")
    for name, arguments in (("station", "-m station"), ("python", "")):
        program = folder / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n', encoding="utf-8")
        program.chmod(0o755)
    return os.environ | {
        "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "Agg",
        "OPENBLAS_NUM_THREADS": "1",
    }


@pytest.fixture(scope="module")
def demo_station(tmp_path_factory, environment):
    """Simulate and process a station; return its folder."""
    folder = tmp_path_factory.mktemp("docs")
    run("station simulate station-demo --hours 3", folder, environment)
    run("station process station-demo/site.toml station-demo/inbox/*.laz", folder, environment)
    return folder / "station-demo"


def run(command, folder, environment):
    program = command.split()[0]
    if program in OPTIONAL and shutil.which(program) is None:
        return
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", command],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, f"$ {command}\n{done.stdout}{done.stderr}"


class Python:
    """A Python process that executes blocks in one namespace."""

    def __init__(self, folder, environment):
        self._process = subprocess.Popen(
            [sys.executable, "-c", INTERPRETER],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, code):
        self._process.stdin.write(json.dumps(code) + "\n")
        self._process.stdin.flush()
        error = json.loads(self._process.stdout.readline())
        assert error is None, f"{code}\n{error}"

    def close(self):
        self._process.communicate()


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=str)
def test_snippets_run(page, demo_station, environment, tmp_path):
    shutil.copytree(demo_station, tmp_path / "station-demo")
    python = Python(tmp_path, environment)
    try:
        for block in blocks(page):
            if block.title:
                path = tmp_path / block.title
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block.text, encoding="utf-8")
            elif block.language == "python":
                python.run(block.text)
            else:
                for command in commands(block.text):
                    run(command, tmp_path, environment)
    finally:
        python.close()
