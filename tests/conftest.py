"""Fixtures shared by all tests."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

# As in the worker processes: on a busy machine, threaded linear algebra is many times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
pytest_plugins = ["support.epochs", "support.site"]
LONGEST = (  # files whose integration tests take longest
    "test_truth", "test_large", "test_products_truth", "test_joint", "test_docs_snippets", "test_worker",
    "test_reprocessing", "test_several_files_end_to_end", "test_products_of_kinds", "test_alarm_rules",
    "test_pose_stability", "test_end_to_end", "test_world", "test_earlier_findings",
)  # fmt: skip
DRAWN = ("test_simulated_world", "test_kills", "test_soak", "test_fuzz")  # a share, see `effort`
LATEST_DRAW_S = float(os.environ.get("STATION_TESTS_LATEST_DRAW", "inf"))  # since 1970
PROJECT = Path(__file__).resolve().parents[1]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Run the longest files last, the longest of them first, and after them those that try a share."""
    rank = {name: number for number, name in enumerate((*LONGEST, *DRAWN))}
    items.sort(key=lambda item: rank.get(item.path.stem, -1))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Draw nothing more of what has no end once its time is over; every other test runs."""
    if item.path.stem in DRAWN and time.time() > LATEST_DRAW_S:
        pytest.skip("nothing drawn of what has no end: the other tests took all the time")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scans, logs and matrices, `STATION_SHARED_DATA`; without it, skip the test.

    The data are not part of the project because of their size and licences.
    """
    folder = Path(os.environ.get("STATION_SHARED_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set STATION_SHARED_DATA to its folder")
    return folder
