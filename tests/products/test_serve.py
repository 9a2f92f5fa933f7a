"""The web server of the page: local and read-only."""

import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

from station.commands.products import serve
from station.errors import StationError


@pytest.fixture
def served(site, tmp_path):
    """A process running `station serve`, and its address."""
    page = site.station.data / "page"
    page.mkdir()
    (page / "index.html").write_text("<!doctype html><title>x</title>")
    (page / ".hidden").write_text("secret")
    (page / "out").symlink_to(tmp_path / "site.toml")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "station", "serve", site.path, "--port", str(port)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    yield process, f"http://127.0.0.1:{port}/"
    process.terminate()
    process.wait(timeout=20)
    process.stderr.close()


def request(address, **options):
    deadline = time.monotonic() + 30
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


@pytest.mark.parametrize("missing", ["starlette", "uvicorn"])
def test_missing_library_is_told_instead_of_an_address(write_site, monkeypatch, capsys, missing):
    site = write_site()
    page = site.parent / "data" / "page"
    page.mkdir(parents=True)
    (page / "index.html").touch()
    monkeypatch.setitem(sys.modules, missing, None)
    for name in [name for name in sys.modules if name.startswith("starlette.") and missing == "starlette"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(StationError, match="pip install"):
        serve(site)
    assert capsys.readouterr().err == ""


@pytest.mark.integration
def test_serving_without_a_page(site):
    command = [sys.executable, "-m", "station", "serve", site.path]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 1
    assert "no page yet" in result.stderr
