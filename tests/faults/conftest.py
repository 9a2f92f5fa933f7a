"""Undisturbed runs for comparison, and services that end with their test."""

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
import simulated_world


@pytest.fixture(scope="session")
def warm():
    process = harness.Warm()
    yield process
    process.close()


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, warm):
    """Return the undisturbed run of an adjustment method: a station whose scans all arrived in order."""
    stations = {}

    def run(method="none"):
        if method not in stations:
            folder = harness.build(tmp_path_factory.mktemp("undisturbed") / method, method=method)
            station = harness.Station(folder, warm)
            station.drop(*range(harness.SCANS))
            station.start()
            station.finish(*range(harness.SCANS))
            stations[method] = station
        return stations[method]

    return run


@pytest.fixture
def make_station(tmp_path, warm, undisturbed):
    """Return a function that creates a copy of the undisturbed station with an empty inbox."""
    started = []

    def station(method="none", *, cold=False, folder=None):
        folder = folder or tmp_path / f"station{len(started)}"
        ignored = shutil.ignore_patterns("data", "inbox", "log", "steps.*", "died")
        shutil.copytree(undisturbed(method).folder, folder, ignore=ignored)
        (folder / "inbox").mkdir()
        started.append(harness.Station(folder, None if cold else warm))
        return started[-1]

    yield station
    for running in started:
        running.close()


@pytest.fixture
def rng():
    """Return a random generator; a failed test prints its seed, STATION_FAULTS_SEED sets it."""
    seed = int(environ.get("STATION_FAULTS_SEED", secrets.randbits(31)))
    print(f"STATION_FAULTS_SEED={seed}")
    return random.Random(seed)  # noqa: S311 - no secret


@pytest.fixture(scope="session")
def template(tmp_path_factory):
    """Return the station of which all simulated worlds begin as copies."""
    return simulated_world.make_template(tmp_path_factory.mktemp("world") / "template")
