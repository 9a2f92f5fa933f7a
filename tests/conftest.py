"""Fixtures shared by all tests."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

# As in the worker processes: on a busy machine, threaded linear algebra is many times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
pytest_plugins = ["support.epochs", "support.site"]
LONGEST = (  # files whose integration tests take longest; those whose faults have no end come last
    "test_truth", "test_large", "test_products_truth", "test_joint", "test_docs_snippets", "test_worker",
    "test_reprocessing", "test_several_files_end_to_end", "test_products_of_kinds", "test_alarm_rules",
    "test_pose_stability", "test_end_to_end", "test_world", "test_earlier_findings", "test_simulated_world",
    "test_kills", "test_soak", "test_fuzz",
)  # fmt: skip
LATEST_START_S = float(os.environ.get("STATION_TESTS_LATEST_START", "inf"))  # of a test, since 1970
PROJECT = Path(__file__).resolve().parents[1]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Run the longest files last, the longest of them first: where time ends, few tests are left."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, -1))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup():
    """Skip what the time of a run of CI, on a machine that is slow today, does not suffice for."""
    if time.time() > LATEST_START_S:
        pytest.skip("no time left: CI on a machine at its usual speed runs it")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scans, logs and matrices, `STATION_SHARED_DATA`; without it, skip the test.

    The data are not part of the project because of their size and licences.
    """
    folder = Path(os.environ.get("STATION_SHARED_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set STATION_SHARED_DATA to its folder")
    return folder
