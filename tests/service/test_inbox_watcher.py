"""The inbox watcher reports new files, also after its folder was removed and recreated."""

from __future__ import annotations

import os
import time
from queue import Empty, SimpleQueue

import pytest

from station.service import inbox_watcher
from station.service.inbox_watcher import InboxWatcher


@pytest.fixture
def events():
    return SimpleQueue()


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "inbox").mkdir()
    return tmp_path / "inbox"


@pytest.fixture
def make(events, folder):
    watchers = []

    def build(*, polling=False):
        watchers.append(InboxWatcher(folder, lambda: events.put("something"), polling=polling))
        watchers[-1].ensure_watching()
        return watchers[-1]

    yield build
    for watcher in watchers:
        watcher.close()


def drain(events, for_s=0.2):
    """Discard events until none has arrived for `for_s` seconds."""
    until_s = time.monotonic() + for_s
    while time.monotonic() < until_s:
        try:
            events.get(timeout=until_s - time.monotonic())
        except Empty:
            return
        until_s = time.monotonic() + for_s


@pytest.mark.parametrize("polling", [False, True])
@pytest.mark.integration
def test_written_moved_and_linked_files_are_events(make, events, folder, tmp_path, monkeypatch, polling):
    monkeypatch.setattr(inbox_watcher, "_POLL_INTERVAL_S", 0.1)
    make(polling=polling)
    (folder / "a.laz").write_text("scan")
    assert events.get(timeout=5.0)
    drain(events, 0.4)
    (tmp_path / "b.laz").write_text("scan")
    os.link(tmp_path / "b.laz", folder / "linked.laz")
    assert events.get(timeout=5.0)
    drain(events, 0.4)
    (tmp_path / "b.laz").replace(folder / "b.laz")
    assert events.get(timeout=5.0)


def test_reading_a_scan_is_no_event(make, events, folder):
    (folder / "a.laz").write_text("scan")
    make()
    drain(events)
    (folder / "a.laz").read_text()
    with pytest.raises(Empty):
        events.get(timeout=0.3)


@pytest.mark.integration
@pytest.mark.parametrize("polling", [False, True])
def test_recreated_folder_is_watched_again(make, events, folder, monkeypatch, polling):
    monkeypatch.setattr(inbox_watcher, "_POLL_INTERVAL_S", 0.1)
    watcher = make(polling=polling)
    for turn in range(3):
        folder.rmdir()
        folder.mkdir()
        drain(events)
        assert any(
            _event_received(watcher, events, folder / f"{turn}_{attempt}.laz") for attempt in range(20)
        )
        for path in folder.iterdir():
            path.unlink()
        drain(events)


def _event_received(watcher, events, path):
    """Return True if a new file is reported; the watch may end between the two calls."""
    watcher.ensure_watching()
    drain(events, 0.05)
    path.write_text("scan")
    try:
        return events.get(timeout=0.5)
    except Empty:
        return False


def test_missing_folder_is_watched_once_it_exists(make, events, folder):
    folder.rmdir()
    watcher = make()
    assert watcher._observer is None
    folder.mkdir()
    watcher.ensure_watching()
    (folder / "a.laz").write_text("scan")
    assert events.get(timeout=5.0)


def test_exhausted_inotify_watches_are_logged_once(make, folder, monkeypatch, caplog):
    class Exhausted:
        def schedule(self, *_, **__):
            raise OSError(28, "inotify watch limit reached")

    monkeypatch.setattr(inbox_watcher, "Observer", Exhausted)
    watcher = make()
    watcher.ensure_watching()
    assert folder.is_dir()
    assert caplog.text.count("events=none") == 1
