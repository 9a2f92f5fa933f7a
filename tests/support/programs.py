"""Other programs that read what this one writes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


def tool(name):
    """Return the path of a program; without it, skip the test."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return path


def run(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)


def readers_python():
    """Return the interpreter of an environment with cf-python, Iris and others; without one, skip the test.

    They pin libraries, and so have an environment of their own: `STATION_READERS` is its interpreter.
    """
    python = os.environ.get("STATION_READERS")
    if python is None:
        pytest.skip("no environment of other readers: see .ci/run")
    return Path(python)


def findings(report, *paths, convention="cf:1.11"):
    """Return the objections of the compliance checker to files: path, check, messages."""
    checker = shutil.which("compliance-checker", path=f"{sys.prefix}/bin") or tool("compliance-checker")
    subprocess.run(
        [checker, f"--test={convention}", "--format=json_new", f"--output={report}", *paths],
        capture_output=True,
        check=False,
        timeout=120,
    )
    results = json.loads(report.read_text())
    assert set(results) == set(map(str, paths))
    return [
        (path, check["name"], check["msgs"])
        for path, result in results.items()
        for priority in ("high_priorities", "medium_priorities", "low_priorities")
        for check in result[convention][priority]
        if check["msgs"]
    ]
