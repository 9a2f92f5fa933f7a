"""The systemd unit: known keys only, hardened, and in step with what the service does."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from station.service.daemon import Pace
from station.service.targets import PATIENCE_S

UNIT = "systemd/station@.service"


@pytest.fixture
def unit(request):
    return request.config.rootpath / UNIT


@pytest.fixture
def analyze():
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed (Debian: systemd)")
    return lambda *words: subprocess.run(
        ["systemd-analyze", *words], capture_output=True, text=True, check=False
    )


def test_systemd_accepts_every_line(analyze, unit):
    done = analyze("verify", str(unit))
    assert (done.returncode, done.stderr) == (0, "")


def test_systemd_would_have_said_so(analyze, unit, tmp_path):
    broken = tmp_path / "broken@.service"
    broken.write_text(unit.read_text().replace("WatchdogSec=", "WatchdogSecs="))
    assert "WatchdogSecs" in analyze("verify", str(broken)).stderr


def test_it_is_hardened(analyze, unit):
    told = analyze("security", "--offline=yes", str(unit)).stdout
    exposure = float(re.search(r"Overall exposure level for \S+: ([\d.]+)", told).group(1))
    assert exposure <= 0.5


def test_its_times_fit_those_of_the_service(unit):
    keys = dict(line.split("=", 1) for line in unit.read_text().splitlines() if re.match(r"[A-Z]\w+=", line))
    assert float(keys["TimeoutStopSec"]) > Pace().grace_s + 20
    assert float(keys["WatchdogSec"]) / 3 >= Pace().period_s
    assert keys["RestartPreventExitStatus"] == "78"
    assert keys["Type"] == "notify"


def test_alarms_are_told_by_a_unit_and_timer_of_their_own(analyze, unit):
    """The part with a network is apart from the one that reads scans."""
    service, timer = (unit.with_name(f"station-alarms@.{kind}") for kind in ("service", "timer"))
    done = analyze("verify", str(service), str(timer))
    assert (done.returncode, done.stderr) == (0, "")
    told = analyze("security", "--offline=yes", str(service)).stdout
    assert float(re.search(r"Overall exposure level for \S+: ([\d.]+)", told).group(1)) <= 1.5
    limit_s = float(re.search(r"^TimeoutStartSec=(\d+)$", service.read_text(), re.MULTILINE).group(1))
    assert limit_s > 2 * PATIENCE_S + 60  # alarms, then the digest


def test_metrics_open_the_loopback_only(analyze, unit, tmp_path):
    (tmp_path / "station@.service.d").mkdir()
    opened = shutil.copy(unit, tmp_path)
    shutil.copy(unit.with_name("metrics.conf"), tmp_path / "station@.service.d")
    done = analyze("verify", str(opened))
    assert (done.returncode, done.stderr) == (0, "")
    whole = tmp_path / "whole@.service"  # without a root, systemd-analyze security reads no drop-ins
    whole.write_text(unit.read_text().replace("[Install]", unit.with_name("metrics.conf").read_text()))
    told = analyze("security", "--offline=yes", str(whole)).stdout
    assert float(re.search(r"Overall exposure level for \S+: ([\d.]+)", told).group(1)) <= 1.2
    assert re.search(r"IPAddressDeny= .*with only localhost entries", told)
