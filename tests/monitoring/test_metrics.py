"""Metrics, read by the parser of Prometheus and by Prometheus itself."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from station.config import read_site
from station.errors import ConfigError
from station.inbox.journal import Journal
from station.monitoring.alarm_state import FILE_NAME, Alarm, AlarmState, due_messages, save
from station.monitoring.metrics import THREADS, Metrics, _RequestHandler


@pytest.fixture
def port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture
def station(make_site, port):
    site = make_site(more=f'[service]\nmetrics = "127.0.0.1:{port}"\nmetrics_file = "station.prom"\n')
    data = site.station.data
    with Journal(data / "journal.sqlite") as journal:
        for index, verdict in enumerate(["good", "good", "degraded"]):
            journal.record_seen([(f"{index}.laz", 1, 1, "")])
            figures = {"seconds": 2.5, "stable_z_std": 1.1, "sigma_median_m": 0.04, "roll_deg": 2.1}
            journal.record_stored(
                f"{index}.laz", sha256=str(index), verdict=verdict, epoch=str(index), revision=1,
                start_utc_s=1000.0 + index, metrics=figures,
            )  # fmt: skip
        journal.record_seen([("bad.laz", 1, 1, "")])
        journal.set_aside("bad.laz", "cut off")
        journal.record_seen([("new.laz", 1, 1, "")])
    state = AlarmState(since_utc_s=0.0)
    due_messages(state, [Alarm('change in "tongue\\north"\n', "rose")], 0.0, 1.0)
    save(data / FILE_NAME, state)
    return site


EXPECTED = {
    ("station_scans", "stored"): 3, ("station_scans", "set_aside"): 1, ("station_scans", "waiting"): 1,
    ("station_scans", "later"): 0, ("station_epochs", "good"): 2, ("station_epochs", "degraded"): 1,
    ("station_last_scan_timestamp_seconds", None): 1002, ("station_scan_duration_seconds", None): 2.5,
    ("station_stable_z_std", None): 1.1, ("station_sigma_median_metres", None): 0.04,
    ("station_roll_degrees", None): 2.1, ("station_alarm_firing", 'change in "tongue\\north"\n'): 1,
}  # fmt: skip


def figures(text):
    return {
        (sample.name, next(iter(sample.labels.values()), None)): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_served_and_written_metrics_equal_the_journal(station, port):
    metrics = Metrics(lambda: station)
    with metrics.serving(), urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
        served = figures(answer.read().decode())
    metrics.write()
    read = figures(station.service.metrics_file.read_text())
    assert {key: served[key] for key in EXPECTED} == EXPECTED
    assert {key: read[key] for key in EXPECTED} == EXPECTED
    free = served["station_disk_free_bytes", None]
    assert free == pytest.approx(shutil.disk_usage(station.station.data).free, rel=0.2)
    assert [path.name for path in station.service.metrics_file.parent.glob("station.prom*")] == [
        "station.prom"
    ]
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics")


def test_missing_extra_does_not_stop_the_service(station, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    metrics = Metrics(lambda: station)
    metrics.write()
    assert "tls-station[metrics]" in caplog.text
    with pytest.raises(ConfigError, match="pip install"), metrics.serving():
        pass  # a missing extra is reported at the start


def test_occupied_port_and_missing_folder_are_reported(station, port, make_site, caplog):
    metrics = Metrics(lambda: station)
    with (
        socket.create_server(("127.0.0.1", port)),
        pytest.raises(ConfigError, match=f"127.0.0.1:{port}"),
        metrics.serving(),
    ):
        pass
    without_folder = make_site(more='[service]\nmetrics_file = "nowhere/station.prom"\n')
    metrics = Metrics(lambda: without_folder)
    metrics.write()
    metrics.write()
    assert len([record for record in caplog.records if "metrics_file" in record.message]) == 1


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", ""])
def test_requests_to_other_hosts_are_refused(station, port, host):
    request = urllib.request.Request(f"http://127.0.0.1:{port}/metrics", headers={"Host": host})
    with Metrics(lambda: station).serving(), pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request)  # noqa: S310 - an address of this test


@pytest.mark.integration
def test_idle_connections_take_neither_threads_nor_the_service(station, port, monkeypatch):
    monkeypatch.setattr(_RequestHandler, "timeout", 0.1)
    before = threading.active_count()
    with Metrics(lambda: station).serving(), ExitStack() as idle:
        for _ in range(100):
            idle.enter_context(socket.create_connection(("127.0.0.1", port)))
        assert threading.active_count() <= before + 1 + THREADS
        until_s = time.monotonic() + 20
        while time.monotonic() < until_s:  # the idle connections are closed meanwhile
            with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
                assert figures(answer.read().decode())["station_scans", "stored"] == 3
                return
            time.sleep(0.1)
        pytest.fail("no answer")


@pytest.mark.parametrize("address", ["0.0.0.0:9750", "192.0.2.1:9750", ":9750", "127.0.0.1", "127.0.0.1:0"])
def test_only_loopback_addresses_are_accepted(write_site, address):
    with pytest.raises(ConfigError, match="give a loopback address"):
        read_site(write_site(more=f'[service]\nmetrics = "{address}"\n'))


def test_ipv6_loopback_is_accepted(write_site):
    assert read_site(write_site(more='[service]\nmetrics = "[::1]:9750"\n')).service.metrics == "[::1]:9750"


@pytest.mark.slow
def test_prometheus_scrapes_the_metrics(station, port, tmp_path):
    if shutil.which("prometheus") is None:
        pytest.skip("prometheus is not installed (Debian: prometheus)")
    with socket.create_server(("127.0.0.1", 0)) as server:
        web = f"127.0.0.1:{server.getsockname()[1]}"
    scrape = {"job_name": "station", "static_configs": [{"targets": [f"127.0.0.1:{port}"]}]}
    config = tmp_path / "prometheus.yml"
    config.write_text(json.dumps({"global": {"scrape_interval": "1s"}, "scrape_configs": [scrape]}))
    command = [
        "prometheus", f"--config.file={config}", f"--web.listen-address={web}",
        f"--storage.tsdb.path={tmp_path / 'tsdb'}",
    ]  # fmt: skip
    with Metrics(lambda: station).serving(), (tmp_path / "log").open("w") as log:
        prometheus = subprocess.Popen(command, stderr=log)
        try:
            actual = query(f"http://{web}/api/v1/query?query=station_scans")
        finally:
            prometheus.terminate()
            prometheus.wait(30)
    assert actual == {"stored": 3.0, "set_aside": 1.0, "waiting": 1.0, "later": 0.0}


def query(url):
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s:
        time.sleep(0.5)
        try:
            with urllib.request.urlopen(url) as answer:  # noqa: S310 - an address of this test
                result = json.load(answer)["data"]["result"]
        except OSError:
            continue
        if result:
            return {sample["metric"]["state"]: float(sample["value"][1]) for sample in result}
    return None


@pytest.mark.integration
def test_running_service_serves_and_writes_metrics(station, port):
    fake = Path(__file__).parents[1] / "support" / "fake_service.py"
    log = station.station.data / "log"
    site = station.path.read_text().replace("expected_every_s = 3600.0", "expected_every_s = 1.0")
    station.path.write_text(site)
    with log.open("w") as file:
        service = subprocess.Popen([sys.executable, fake, station.path, "0.2", "1"], stderr=file)
    try:
        until_s = time.monotonic() + 60
        while not station.service.metrics_file.exists():
            assert time.monotonic() < until_s, log.read_text()
            time.sleep(0.1)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
            served = figures(answer.read().decode())
        assert served["station_scans", "stored"] == 3
    finally:
        service.terminate()
        assert service.wait(30) == 0, log.read_text()
