"""What every test may ask for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# As in the service's children: on a busy machine matrices take many times as long on several threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
PROJECT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scans, logs and matrices; the test is skipped where there is none.

    They are not part of the project, for their size and licences; `STATION_SHARED_DATA` says where they are.
    """
    folder = Path(os.environ.get("STATION_SHARED_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set STATION_SHARED_DATA to its folder")
    return folder
