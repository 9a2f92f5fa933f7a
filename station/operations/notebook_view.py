"""The page of a station in a notebook: a frame on a web server in the same process."""

from __future__ import annotations

import socket
from functools import partial
from html import escape
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from station.archive.series.index import series_in
from station.errors import StationError
from station.processing.workers.isolation import TaskRunner
from station.products.serve import LOOPBACK, MISSING_LIBRARIES, NOTEBOOKS, Served, app_for

if TYPE_CHECKING:
    import uvicorn

MEMORY_GB, MAX_ANSWER_S = 4.0, 60.0  # of an answer
STOP_S = 5.0


class View:
    """A page that a notebook shows; it is served until it is closed or the process ends."""

    def __init__(self, address: str, height_px: int, server: uvicorn.Server, thread: Thread) -> None:
        self.address = address
        self._height_px, self._server, self._thread = height_px, server, thread

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{escape(self.address)}" width="100%" height="{self._height_px}"'
            ' style="border: 0" title="station"></iframe>'
        )

    def __repr__(self) -> str:
        return f"station at {self.address}"

    def close(self) -> None:
        """Stop serving."""
        self._server.should_exit = True
        self._thread.join(STOP_S)


def show(site_or_folder: str | Path, height_px: int) -> View:
    """Serve the page of a station on a free port of this machine and return its view.

    Raises StationError without the libraries or without a page, StoreError if there is no series.
    """
    series = series_in(site_or_folder)
    if not (series.folder / "page" / "index.html").is_file():
        raise StationError(
            f"{series.folder / 'page'}: no page yet; `station process` and the service write it"
        )
    run = partial(TaskRunner().run, memory_gb=MEMORY_GB, timeout_s=MAX_ANSWER_S)
    app = app_for([Served(series.station_id, series.name, series.folder)], run, frames=NOTEBOOKS)
    try:
        import uvicorn  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise StationError(MISSING_LIBRARIES) from error
    listening = socket.create_server((LOOPBACK, 0))
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", server_header=False))
    thread = Thread(target=server.run, kwargs={"sockets": [listening]}, name="station-view", daemon=True)
    thread.start()
    return View(f"http://{LOOPBACK}:{listening.getsockname()[1]}/", height_px, server, thread)
