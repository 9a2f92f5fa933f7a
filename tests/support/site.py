"""A small site for tests of the service: in map coordinates it needs only a grid."""

from __future__ import annotations

import json
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import h5py
import numpy as np
import pytest

from station.config import read_site

SITE = """
[station]
id = "test"
data = "data"
[scans]
inbox = "inbox"
frame = "map"
settle_s = {settle_s}
polling = {polling}
expected_every_s = {expected_every_s}
[map]
crs = "EPSG:32632"
[grid]
bounds_m = {{ west = 0, south = 0, east = 10, north = 10 }}
{more}
"""


@pytest.fixture
def write_site(tmp_path):
    def write(*, settle_s=60.0, polling="false", expected_every_s=3600.0, more=""):
        (tmp_path / "inbox").mkdir(exist_ok=True)
        (tmp_path / "data").mkdir(exist_ok=True)
        path = tmp_path / "site.toml"
        text = SITE.format(settle_s=settle_s, polling=polling, expected_every_s=expected_every_s, more=more)
        path.write_text(text)
        return path

    return write


@pytest.fixture
def make_site(write_site):
    return lambda **settings: read_site(write_site(**settings))


class Webhook:
    """A web server that records alarm messages: (title, text)."""

    def __init__(self):
        self.received = received = []

        class Hook(BaseHTTPRequestHandler):
            def do_POST(self):
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                received.append((body["title"], body["message"]))
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Hook)
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()
        self.url = f"json://127.0.0.1:{self.server.server_port}/"

    def close(self):
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


@pytest.fixture
def webhook():
    hook = Webhook()
    yield hook
    hook.close()


@pytest.fixture
def unresponsive_url():
    """Yield the address of a server that accepts connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"json://127.0.0.1:{server.getsockname()[1]}/?rto=20"


@pytest.fixture
def credentials(tmp_path, monkeypatch):
    folder = tmp_path / "credentials"
    folder.mkdir()
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(folder))

    def write(**urls):
        for name, url in urls.items():
            (folder / name).write_text(f"{url}\n")

    return write


def char_array(texts, width):
    return np.array([text.encode() for text in texts], f"S{width}").view("S1").reshape(len(texts), width)


@pytest.fixture
def write_series(tmp_path):
    """Return a function that writes the parts of series.nc and areas.nc that alarms read.

    Change and sigma [m] have the shape (times, areas).
    """

    def write(time_s, change_m, sigma_m, names, verdicts=None):
        for name in ("series.nc", "areas.nc"):
            with h5py.File(tmp_path / "data" / name, "w") as file:
                file["time"] = time_s
                file["time_bnds"] = np.stack([time_s, time_s], axis=-1)
                file["epoch_file"] = char_array([f"e{epoch_s:.0f}.nc" for epoch_s in time_s], 64)
                if name == "series.nc":
                    file["verdict"] = np.zeros(len(time_s), "i1") if verdicts is None else verdicts
                else:
                    file["area_name"] = char_array(names, max(len(name.encode()) for name in names))
                    file["mean_change"], file["mean_change_uncertainty"] = change_m, sigma_m

    return write
