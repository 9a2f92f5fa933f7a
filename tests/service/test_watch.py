"""The ear hears what comes, and hears again after its folder was removed and made anew."""

from __future__ import annotations

import os
import time
from queue import Empty, SimpleQueue

import pytest

from station.service import watch
from station.service.watch import Ear


@pytest.fixture
def heard():
    return SimpleQueue()


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "inbox").mkdir()
    return tmp_path / "inbox"


@pytest.fixture
def make(heard, folder):
    made = []

    def build(*, polling=False):
        made.append(Ear(folder, lambda: heard.put("something"), polling=polling))
        made[-1].listen()
        return made[-1]

    yield build
    for ear in made:
        ear.close()


def silence(heard, for_s=0.2):
    until_s = time.monotonic() + for_s
    while time.monotonic() < until_s:
        try:
            heard.get(timeout=until_s - time.monotonic())
        except Empty:
            return
        until_s = time.monotonic() + for_s


@pytest.mark.parametrize("polling", [False, True])
def test_it_hears_files_that_are_written_moved_and_linked(
    make, heard, folder, tmp_path, monkeypatch, polling
):
    monkeypatch.setattr(watch, "_POLL_S", 0.1)
    make(polling=polling)
    (folder / "a.laz").write_text("scan")
    assert heard.get(timeout=5.0)
    silence(heard, 0.4)
    (tmp_path / "b.laz").write_text("scan")
    os.link(tmp_path / "b.laz", folder / "linked.laz")
    assert heard.get(timeout=5.0)
    silence(heard, 0.4)
    (tmp_path / "b.laz").replace(folder / "b.laz")
    assert heard.get(timeout=5.0)


def test_reading_a_scan_is_not_news(make, heard, folder):
    (folder / "a.laz").write_text("scan")
    make()
    silence(heard)
    (folder / "a.laz").read_text()
    with pytest.raises(Empty):
        heard.get(timeout=0.3)


@pytest.mark.parametrize("polling", [False, True])
def test_it_hears_again_after_the_folder_was_made_anew(make, heard, folder, monkeypatch, polling):
    monkeypatch.setattr(watch, "_POLL_S", 0.1)
    ear = make(polling=polling)
    for turn in range(3):
        folder.rmdir()
        folder.mkdir()
        silence(heard)
        assert any(_hears(ear, heard, folder / f"{turn}_{look}.laz") for look in range(20))
        for path in folder.iterdir():
            path.unlink()
        silence(heard)


def _hears(ear, heard, path):
    """One look of the loop: it listens, then something comes. A watch may end between the two."""
    ear.listen()
    silence(heard, 0.05)
    path.write_text("scan")
    try:
        return heard.get(timeout=0.5)
    except Empty:
        return False


def test_without_a_folder_it_is_quietly_deaf_until_there_is_one(make, heard, folder):
    folder.rmdir()
    ear = make()
    assert ear._observer is None
    folder.mkdir()
    ear.listen()
    (folder / "a.laz").write_text("scan")
    assert heard.get(timeout=5.0)


def test_used_up_watches_leave_it_to_the_listing(make, folder, monkeypatch, caplog):
    class Exhausted:
        def schedule(self, *_):
            raise OSError(28, "inotify watch limit reached")

    monkeypatch.setattr(watch, "Observer", Exhausted)
    ear = make()
    ear.listen()
    assert folder.is_dir()
    assert caplog.text.count("events=none") == 1
