"""The systemd unit: known keys only, hardened, and in step with what the service does."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from station.service.daemon import Pace

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
