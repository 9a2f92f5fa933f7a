"""The data folder: locked by one process, recognised at every start, never replaced by another."""

from __future__ import annotations

import shutil

import pytest

from station.errors import StoreError
from station.inbox.lock import LOCK, exclusive_lock, is_locked, read_identity, require_known


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "disk" / "data"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def state(tmp_path):
    folder = tmp_path / "state"
    folder.mkdir()
    return folder


def test_missing_disk_is_noticed_at_the_next_start(data, state):
    """Its mount point is an empty folder, in which a second series would begin."""
    require_known(data, state)
    with exclusive_lock(data):
        pass
    require_known(data, state)
    data.rename(data.with_name("unmounted"))
    for _ in range(2):
        with pytest.raises(StoreError, match=r"is its disk mounted\? .* delete .*data_folder"):
            require_known(data, state)
        data.mkdir(exist_ok=True)
    assert list(data.iterdir()) == []
    shutil.rmtree(data)
    data.with_name("unmounted").rename(data)
    require_known(data, state)


def test_another_data_folder_of_the_site_file_is_accepted(data, state):
    require_known(data, state)
    require_known(data.with_name("new"), state)


def test_data_in_the_state_folder_need_not_be_remembered(state):
    require_known(state, state)
    require_known(state / "data", state)
    assert list(state.iterdir()) == []


def test_locked_folder_knows_its_place(data):
    with exclusive_lock(data) as folder:
        folder.require_same()
        moved = data.rename(data.with_name("moved"))
        with pytest.raises(StoreError, match="another folder is in its place, or none"):
            folder.require_same()
        assert not folder.is_remounted()
        shutil.copytree(moved, data)  # as a new mount: the same identity, other inodes
        assert read_identity(data) == read_identity(moved)
        assert folder.is_remounted()


def test_deleted_lock_is_taken_again_unless_another_process_has_it(data):
    with exclusive_lock(data) as folder:
        (data / LOCK).unlink()
        folder.require_same()
        assert is_locked(data)
        (data / LOCK).unlink()
        with exclusive_lock(data), pytest.raises(StoreError, match="another process uses it"):
            folder.require_same()


def test_a_data_folder_that_the_first_start_creates_is_known_afterwards(data, state):
    data.rmdir()
    for _ in range(3):
        require_known(data, state)
        with exclusive_lock(data):
            pass
    assert (state / "data_folder").read_text() == f"{data}\n{read_identity(data)}\n"
