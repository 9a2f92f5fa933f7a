"""Undisturbed runs to compare with, and services that end with their test."""

from __future__ import annotations

import random
import secrets
import shutil
import sys
from os import environ
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import harness


@pytest.fixture(scope="session")
def warm():
    made = harness.Warm()
    yield made
    made.close()


@pytest.fixture(scope="session")
def quiet(tmp_path_factory, warm):
    """Return the undisturbed run of a method: a station whose scans came one after the other."""
    known = {}

    def run(method="none"):
        if method not in known:
            folder = harness.build(tmp_path_factory.mktemp("quiet") / method, method=method)
            station = harness.Station(folder, warm)
            station.drop(*range(harness.SCANS))
            station.start()
            station.finish(*range(harness.SCANS))
            known[method] = station
        return known[method]

    return run


@pytest.fixture
def make(tmp_path, warm, quiet):
    """Return a function that makes a station with an empty inbox, like that of the undisturbed run."""
    made = []

    def station(method="none", *, cold=False, folder=None):
        folder = folder or tmp_path / f"station{len(made)}"
        ignored = shutil.ignore_patterns("data", "inbox", "log", "steps.*", "died")
        shutil.copytree(quiet(method).folder, folder, ignore=ignored)
        (folder / "inbox").mkdir()
        made.append(harness.Station(folder, None if cold else warm))
        return made[-1]

    yield station
    for one in made:
        one.close()


@pytest.fixture
def dice():
    """Return dice whose seed is told where a test fails, and may be set by STATION_FAULTS_SEED."""
    seed = int(environ.get("STATION_FAULTS_SEED", secrets.randbits(31)))
    print(f"STATION_FAULTS_SEED={seed}")
    return random.Random(seed)  # noqa: S311 - no secret
