"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# As in the worker processes: on a busy machine, threaded linear algebra is many times slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
pytest_plugins = ["support.epochs", "support.site"]
LONGEST = (  # files whose integration tests take longest, which begin first
    "test_truth", "test_large", "test_soak", "test_earlier_findings", "test_products_truth",
    "test_docs_snippets", "test_kills", "test_joint", "test_simulated_world", "test_reprocessing",
    "test_world", "test_pose_stability", "test_products_of_kinds", "test_worker",
    "test_several_files_end_to_end", "test_alarm_rules", "test_fuzz", "test_end_to_end",
)  # fmt: skip
PROJECT = Path(__file__).resolve().parents[1]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Begin with the longest files, so that in the end no worker waits for another."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scans, logs and matrices, `STATION_SHARED_DATA`; without it, skip the test.

    The data are not part of the project because of their size and licences.
    """
    folder = Path(os.environ.get("STATION_SHARED_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set STATION_SHARED_DATA to its folder")
    return folder
