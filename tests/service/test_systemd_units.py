"""The systemd units: valid keys, hardening, and timeouts that match the service."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from station.monitoring.notifiers import SEND_TIMEOUT_S
from station.processing.workers.isolation import STALL_S
from station.service.daemon import LoopTiming

UNIT = "systemd/station@.service"


@pytest.fixture
def service_unit(request):
    return request.config.rootpath / UNIT


@pytest.fixture
def analyze():
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed (Debian: systemd)")
    return lambda *arguments: subprocess.run(
        ["systemd-analyze", *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.integration
def test_systemd_accepts_the_unit(analyze, service_unit):
    result = analyze("verify", str(service_unit))
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.integration
def test_systemd_rejects_an_unknown_key(analyze, service_unit, tmp_path):
    broken = tmp_path / "broken@.service"
    broken.write_text(service_unit.read_text().replace("WatchdogSec=", "WatchdogSecs="))
    assert "WatchdogSecs" in analyze("verify", str(broken)).stderr


@pytest.mark.integration
def test_unit_is_hardened(analyze, service_unit):
    report = analyze("security", "--offline=yes", str(service_unit)).stdout
    exposure = float(re.search(r"Overall exposure level for \S+: ([\d.]+)", report).group(1))
    assert exposure <= 0.5


def test_timeouts_match_those_of_the_service(service_unit):
    keys = dict(
        line.split("=", 1) for line in service_unit.read_text().splitlines() if re.match(r"[A-Z]\w+=", line)
    )
    assert float(keys["TimeoutStopSec"]) > LoopTiming().grace_s + 20
    assert float(keys["WatchdogSec"]) / 3 >= LoopTiming().period_s
    assert float(keys["WatchdogSec"]) > STALL_S + 30  # the service ends a blocked worker before
    assert keys["RestartPreventExitStatus"] == "78"
    assert keys["Type"] == "notify"


@pytest.mark.integration
def test_alarms_have_their_own_unit_and_timer(analyze, service_unit):
    """Only the alarms need a network; the process that reads scans has none."""
    service, timer = (service_unit.with_name(f"station-alarms@.{kind}") for kind in ("service", "timer"))
    result = analyze("verify", str(service), str(timer))
    assert (result.returncode, result.stderr) == (0, "")
    report = analyze("security", "--offline=yes", str(service)).stdout
    assert float(re.search(r"Overall exposure level for \S+: ([\d.]+)", report).group(1)) <= 1.5
    limit_s = float(re.search(r"^TimeoutStartSec=(\d+)$", service.read_text(), re.MULTILINE).group(1))
    assert limit_s > 2 * SEND_TIMEOUT_S + 60  # alarms, then the digest


@pytest.mark.integration
def test_publishing_can_write_to_its_own_folder_only(analyze, service_unit):
    service, timer = (service_unit.with_name(f"station-publish@.{kind}") for kind in ("service", "timer"))
    result = analyze("verify", str(service), str(timer))
    assert (result.returncode, result.stderr) == (0, "")
    report = analyze("security", "--offline=yes", str(service)).stdout
    assert float(re.search(r"Overall exposure level for \S+: ([\d.]+)", report).group(1)) <= 1.5
    text = service.read_text()
    assert re.findall(r"^(?:StateDirectory|ReadWritePaths|ProtectSystem)=.*", text, re.MULTILINE) == [
        "StateDirectory=station/%i/publish",
        "ProtectSystem=strict",
    ]


@pytest.mark.integration
def test_metrics_drop_in_opens_only_the_loopback(analyze, service_unit, tmp_path):
    (tmp_path / "station@.service.d").mkdir()
    copied_unit = shutil.copy(service_unit, tmp_path)
    shutil.copy(service_unit.with_name("metrics.conf"), tmp_path / "station@.service.d")
    result = analyze("verify", str(copied_unit))
    assert (result.returncode, result.stderr) == (0, "")
    # systemd-analyze security reads no drop-ins of a unit outside the system's folders.
    merged_unit = tmp_path / "merged@.service"
    merged_unit.write_text(
        service_unit.read_text().replace("[Install]", service_unit.with_name("metrics.conf").read_text())
    )
    report = analyze("security", "--offline=yes", str(merged_unit)).stdout
    assert float(re.search(r"Overall exposure level for \S+: ([\d.]+)", report).group(1)) <= 1.2
    assert re.search(r"IPAddressDeny= .*with only localhost entries", report)
