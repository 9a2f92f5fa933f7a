"""The web server of the page: local and read-only."""

import json
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

import station
from station.commands.products import serve
from station.errors import ConfigError, StationError

RISES = "polygon=632050,5185850,632200,5185850,632200,5185950,632050,5185950"


@pytest.fixture
def opened():
    """What is closed at the end."""
    with ExitStack() as stack:
        yield stack


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def served(site, tmp_path):
    """A process running `station serve`, and its address."""
    page = site.station.data / "page"
    page.mkdir()
    (page / "index.html").write_text("<!doctype html><title>x</title>")
    (page / ".hidden").write_text("secret")
    (page / "out").symlink_to(tmp_path / "site.toml")
    port = free_port()
    command = [sys.executable, "-m", "station", "serve", site.path, "--port", str(port)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    yield process, f"http://127.0.0.1:{port}/"
    process.terminate()
    process.wait(timeout=20)
    process.stderr.close()


def request(address, **options):
    deadline = time.monotonic() + 120
    while True:
        try:
            with urlopen(Request(address, **options), timeout=10) as response:  # noqa: S310 - a local server
                return response.status, dict(response.headers)
        except HTTPError as error:
            error.close()
            return error.code, {}
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.1)


@pytest.mark.integration
def test_server_is_local_and_read_only(served):
    process, address = served
    status, headers = request(address)
    assert status == 200
    assert "default-src 'none'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert "server" not in {name.lower() for name in headers}
    for method in ("POST", "PUT", "DELETE"):
        assert request(address, method=method)[0] == 405
    for path in (".hidden", "out", "../site.toml", "%2e%2e/site.toml", "nothing"):
        assert request(address + path)[0] == 404
    assert request(address, headers={"Host": "evil.example"})[0] == 400  # DNS rebinding
    with Path("/proc/net/tcp").open() as table:
        port = f"{int(address.rstrip('/').rpartition(':')[2]):04X}"
        listening = [line.split()[1] for line in table if line.split()[3] == "0A"]
    assert [address for address in listening if address.endswith(port)] == [f"0100007F:{port}"]
    assert process.poll() is None


def get(address):
    """Return status and JSON of an answer."""
    try:
        with urlopen(address, timeout=120) as response:  # noqa: S310 - a local server
            return response.status, json.load(response)
    except HTTPError as error:
        with error:
            return error.code, json.load(error)


def talk(address, data, *, read=True):
    """Send bytes to a server; return the first line of its answer, or the open connection."""
    host, _, port = address.removeprefix("http://").rstrip("/").partition(":")
    connection = socket.create_connection((host, int(port)), timeout=60)
    connection.sendall(data)
    if not read:
        return connection
    with connection:
        return connection.recv(4096).split(b"\r\n")[0].decode()


@pytest.mark.integration
def test_server_answers_and_survives_hostile_requests(served, opened):
    process, address = served
    assert request(address)[0] == 200  # it has started
    api = f"{address}api/"

    # slow clients: headers and requests that never end
    for _ in range(20):
        opened.callback(talk(address, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow:", read=False).close)
    status, answer = get(f"{api}change?{RISES}")
    assert status == 200
    assert answer["epochs"][0]["mean_change"] == pytest.approx(0.30, abs=0.006)

    for query, message in (
        ("change", "three corners"),
        (f"change?{RISES}&against=../../x", "neither a stored scan"),
        ("change?polygon=" + ",".join(["1"] * 1002), "at most 500"),
        ("change?polygon=0,0,1,0,1,1", "no cell of the grid"),
        ("change?polygon=-9e7,-9e7,9e7,-9e7,9e7,9e7,-9e7,9e7", None),  # the whole grid
        ("export.tif?variable=../x", "not a variable"),
        ("export.nc?box=0,0,1,1", "no cell of the grid"),
    ):
        status, answer = get(api + query)
        assert status == (400 if message else 200)
        assert message is None or message in answer["error"]
    for path, status in (("change?" + "x" * 40_000, 414), ("nothing", 404), ("../site.toml", 404)):
        assert get(api + path)[0] == status
    assert request(f"{api}change?{RISES}", headers={"Sec-Fetch-Site": "cross-site"})[0] == 403
    assert request(f"{api}change?{RISES}", method="POST")[0] == 405
    for line in (b"GET /../../../../etc/passwd", b"GET //etc/passwd", b"GET /api/..%2f..%2fsite.toml"):
        answer = talk(address, line + b" HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
        assert answer.split()[1] == "404"
    for data in (b"\x16\x03\x01nonsense\r\n\r\n", b"GET / HTTP/1.1\r\nHost: " + b"a" * 100_000 + b"\r\n\r\n"):
        assert talk(address, data).split()[1] == "400"
    assert request(address, headers={"Range": "bytes=0-3"})[0] == 206
    for ranges in ("9-1," * 2000, "0-0," * 2000):
        assert request(address, headers={"Range": f"bytes={ranges}"})[0] in {200, 206, 400, 416}

    # many at once: some are refused, none is lost, and the files are served meanwhile
    with ThreadPoolExecutor(16) as pool:
        asked = [pool.submit(get, f"{api}change?{RISES}") for _ in range(16)]
        assert request(address)[0] == 200
        statuses = [one.result()[0] for one in asked]
    assert set(statuses) <= {200, 503}
    assert statuses.count(200) >= 8
    assert 503 in statuses
    assert get(f"{api}change?{RISES}")[0] == 200
    assert process.poll() is None


@pytest.mark.integration
def test_server_sends_files(served):
    _, address = served
    assert request(address)[0] == 200
    for name, magic in (("export.tif?", b"II*"), ("export.nc?variables=elevation_change", b"\x89HDF")):
        with urlopen(f"{address}api/{name}", timeout=120) as response:  # noqa: S310 - a local server
            assert response.read(4).startswith(magic)
            assert response.headers["content-disposition"].startswith('attachment; filename="hef_export')


@pytest.mark.integration
def test_several_stations_are_served_below_one_page(site, tmp_path):
    text = site.path.read_text()
    other = tmp_path / "other.toml"
    other.write_text(text.replace('id = "hef"', 'id = "second"').replace('data = "data"', 'data = "other"'))
    for folder in ("data", "other"):
        (tmp_path / folder / "page").mkdir(parents=True)
        (tmp_path / folder / "page" / "index.html").write_text(f"page of {folder}")
    port = free_port()
    command = [sys.executable, "-m", "station", "serve", site.path, other, "--port", str(port)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        address = f"http://127.0.0.1:{port}/"
        assert request(address)[0] == 200
        with urlopen(address) as response:
            html = response.read().decode()
        assert 'href="second/index.html"' in html
        assert "<img src=x" not in html  # names are escaped
        for path, expected in (("hef/", "page of data"), ("second/index.html", "page of other")):
            with urlopen(address + path) as response:  # noqa: S310 - a local server
                assert response.read().decode() == expected
        assert get(f"{address}hef/api/change?{RISES}")[0] == 200
        assert get(f"{address}second/api/change?{RISES}")[0] == 400  # nothing is stored
        assert request(f"{address}second/../hef/.hidden")[0] == 404
        process.terminate()


@pytest.mark.parametrize("missing", ["starlette", "uvicorn"])
def test_missing_library_is_reported_instead_of_an_address(write_site, monkeypatch, capsys, missing):
    site = write_site()
    page = site.parent / "data" / "page"
    page.mkdir(parents=True)
    (page / "index.html").touch()
    monkeypatch.setitem(sys.modules, missing, None)
    for name in [name for name in sys.modules if name.startswith("starlette.") and missing == "starlette"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(StationError, match="pip install"):
        serve([site])
    assert capsys.readouterr().err == ""


def test_two_stations_of_one_name_are_refused(site, tmp_path):
    copy = tmp_path / "copy.toml"
    copy.write_text(site.path.read_text())
    (site.station.data / "page").mkdir()
    (site.station.data / "page" / "index.html").touch()
    with pytest.raises(ConfigError, match=r"same station\.id"):
        serve([site.path, copy])


@pytest.mark.integration
def test_serving_without_a_page(site):
    command = [sys.executable, "-m", "station", "serve", site.path]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 1
    assert "no page yet" in result.stderr


@pytest.mark.integration
def test_notebook_shows_the_page_until_it_is_closed(site):
    with pytest.raises(StationError, match="no page yet"):
        station.view(site.path)
    page = site.station.data / "page"
    page.mkdir()
    (page / "index.html").write_text("the page")
    view = station.view(site.path, height_px=500)
    assert f'<iframe src="{view.address}" width="100%" height="500"' in view._repr_html_()
    status, headers = request(view.address)
    assert status == 200
    assert "frame-ancestors http://localhost:* http://127.0.0.1:*" in headers["content-security-policy"]
    assert get(f"{view.address}api/change?{RISES}")[0] == 200
    view.close()
    with pytest.raises(OSError, match="refused"):
        urlopen(view.address, timeout=5)  # noqa: S310 - a local server
