"""Figures for Prometheus, as Prometheus itself and its parser read them."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from station.config import read_site
from station.errors import ConfigError
from station.service.alarm_memory import FILE, Alarm, Memory, news, remember
from station.service.journal import Journal
from station.service.metrics import Metrics


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
            journal.seen([(f"{index}.laz", 1, 1, "")])
            figures = {"seconds": 2.5, "stable_z_std": 1.1, "sigma_median_m": 0.04, "roll_deg": 2.1}
            journal.stored(
                f"{index}.laz", sha256=str(index), verdict=verdict, epoch=str(index), revision=1,
                start_utc_s=1000.0 + index, figures=figures,
            )  # fmt: skip
        journal.seen([("bad.laz", 1, 1, "")])
        journal.set_aside("bad.laz", "cut off")
        journal.seen([("new.laz", 1, 1, "")])
    memory = Memory(since_utc_s=0.0)
    news(memory, [Alarm('change in "tongue\\north"\n', "rose")], 0.0, 1.0)
    remember(data / FILE, memory)
    return site


WANTED = {
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


def test_over_loopback_and_as_a_file_they_are_those_of_the_journal(station, port):
    metrics = Metrics(lambda: station)
    with metrics.serving(), urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
        heard = figures(answer.read().decode())
    metrics.write()
    read = figures(station.service.metrics_file.read_text())
    assert {key: heard[key] for key in WANTED} == WANTED
    assert {key: read[key] for key in WANTED} == WANTED
    free = heard["station_disk_free_bytes", None]
    assert free == pytest.approx(shutil.disk_usage(station.station.data).free, rel=0.2)
    assert [path.name for path in station.service.metrics_file.parent.glob("station.prom*")] == [
        "station.prom"
    ]
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics")


def test_without_the_extra_the_service_measures_all_the_same(station, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    metrics = Metrics(lambda: station)
    metrics.write()
    assert "tls-station[metrics]" in caplog.text
    with pytest.raises(ConfigError, match="pip install"), metrics.serving():
        pass  # asked for at the start, it is said at the start


def test_a_taken_port_and_a_folder_that_is_not_there(station, port, make_site, caplog):
    metrics = Metrics(lambda: station)
    with (
        socket.create_server(("127.0.0.1", port)),
        pytest.raises(ConfigError, match=f"127.0.0.1:{port}"),
        metrics.serving(),
    ):
        pass
    lost = make_site(more='[service]\nmetrics_file = "nowhere/station.prom"\n')
    metrics = Metrics(lambda: lost)
    metrics.write()
    metrics.write()
    assert len([one for one in caplog.records if "metrics_file" in one.message]) == 1


@pytest.mark.parametrize("address", ["0.0.0.0:9750", "192.0.2.1:9750", ":9750", "127.0.0.1", "127.0.0.1:0"])
def test_only_this_machine_is_served(write_site, address):
    with pytest.raises(ConfigError, match="address of this machine alone"):
        read_site(write_site(more=f'[service]\nmetrics = "{address}"\n'))


def test_it_serves_ipv6_too(write_site):
    assert read_site(write_site(more='[service]\nmetrics = "[::1]:9750"\n')).service.metrics == "[::1]:9750"


@pytest.mark.slow
def test_a_real_prometheus_scrapes_it(station, port, tmp_path):
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
            found = asked(f"http://{web}/api/v1/query?query=station_scans")
        finally:
            prometheus.terminate()
            prometheus.wait(30)
    assert found == {"stored": 3.0, "set_aside": 1.0, "waiting": 1.0, "later": 0.0}


def asked(url):
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s:
        time.sleep(0.5)
        try:
            with urllib.request.urlopen(url) as answer:  # noqa: S310 - of this very test
                result = json.load(answer)["data"]["result"]
        except OSError:
            continue
        if result:
            return {one["metric"]["state"]: float(one["value"][1]) for one in result}
    return None


def test_the_running_service_serves_and_writes(station, port):
    fake = Path(__file__).with_name("fake_service.py")
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
            heard = figures(answer.read().decode())
        assert heard["station_scans", "stored"] == 3
    finally:
        service.terminate()
        assert service.wait(30) == 0, log.read_text()
