"""From scans in the inbox to a word to people: an avalanche is told, a quiet day is not."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from station.archive.aggregate import Aggregates
from station.config import read_site
from station.service import alarms
from station.service.alarm_rules import judge
from station.service.area_series import Curve
from station.service.once import process_scans
from station.service.tasks import areas_of, series_of
from station.simulation.station import simulate, tiny

RULES = """
[alarms]
targets = ["hook"]
stalled_h = 0
[alarms.change]
false_alarms_per_year = 1
"""


def made(folder, scenario):
    simulate(folder, scenario)
    with (folder / "site.toml").open("a", encoding="utf-8") as file:
        file.write(RULES)
    site = read_site(folder / "site.toml")
    return site, sorted(site.scans.inbox.glob("*.laz"))


def lived_through(site, scans):
    """Process scans one by one and look after alarms after each; return what was told after which."""
    told = []
    for scan in scans:
        assert process_scans(site, [scan], lambda _: None) == 0
        alarms.look(site, tell=lambda line, name=scan.stem: told.append((name, line)))
    return told


@pytest.mark.slow
def test_the_alarm_of_an_avalanche(tmp_path, credentials, webhook):
    """In the third hour; two scans must show it."""
    credentials(hook=webhook.url)
    scenario = replace(tiny(hours=5), melt_m_per_h=0.0, avalanche_hour=3.0)
    site, scans = made(tmp_path / "station", scenario)
    told = lived_through(site, scans)
    assert {name for name, _ in told} == {"250715_040000"}
    assert [line.split(" by ")[0] for _, line in told if "deposit" in line] == ["alarm: deposit rose"]
    title, text = webhook.came[0]
    assert title == f"[station simulated] {len(told)} alarm"
    assert text.splitlines() == [line for _, line in told]
    assert len(webhook.came) == 1
    deposit = next(line for _, line in told if "deposit" in line)
    size_m = float(deposit.split(" by ")[1].split(" m")[0])
    assert size_m == pytest.approx(true_rise_m(site), abs=0.02)

    told = subprocess.run(
        [sys.executable, "-m", "station.cli", "alarms", "look", site.path],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert (told.returncode, told.stdout) == (0, "")  # it lasts, and was told


def true_rise_m(site):
    """Mean rise of the deposit in the truth of the simulation, which the station never reads."""
    with xr.open_dataset(site.path.parent / "truth.nc") as truth:
        rise_m = (truth.change[3:].mean("time") - truth.change[:3].mean("time")).values
    return float(rise_m[areas_of(site)["deposit"]].mean())


@pytest.mark.slow
def test_a_quiet_day_and_200_quiet_hours_raise_no_alarm(tmp_path, credentials, webhook):
    """A day from scans; 200 h of twenty stations drawn from the covariance that day's epochs state."""
    credentials(hook=webhook.url)
    scenario = replace(tiny(hours=24), melt_m_per_h=0.0, avalanche_m=0.0, reference_scans=4)
    site, scans = made(tmp_path / "station", scenario)
    assert lived_through(site, scans) == []
    assert webhook.came == []
    rng = np.random.default_rng(1)
    for name, shared_m, own_m in sigmas(site):
        assert own_m > 0
        for _ in range(20):
            hours = np.arange(200)
            change_m = shared_m * rng.normal() + own_m * rng.normal(size=200)
            curve = Curve(name, hours * 3600.0, change_m, np.full(200, np.hypot(shared_m, own_m)))
            told = judge(curve, site.alarms.change, areas=3, expected_every_s=3600.0)
            assert not told.found.any()


def sigmas(site):
    """Part of each area's sigma that all epochs share (the reference's) and that each has alone."""
    aggregates = Aggregates(series_of(site))
    one, other = aggregates.row(-1), aggregates.row(-2)
    for name, cells in areas_of(site).items():
        weights = cells / cells.sum()
        both = aggregates.variance(weights, one) + aggregates.variance(weights, other)
        apart = aggregates.variance(weights, one, other)
        yield name, np.sqrt(max(both - apart, 0) / 2), np.sqrt(apart / 2)
