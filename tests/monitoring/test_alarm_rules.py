"""Alarms of simulated stations: an avalanche raises one, a quiet day none."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from station.config import read_site
from station.monitoring import alarms
from station.monitoring.alarm_rules import change_alarms
from station.monitoring.area_curves import AreaCurve
from station.operations.batch import process_scans
from station.processing.site_files import load_areas, series_for
from station.queries.aggregates import Aggregates
from station.simulation.station import simulate, small

RULES = """
[products]
page = false
[alarms]
targets = ["hook"]
stalled_h = 0
disk_gb = 0
[alarms.change]
false_alarms_per_year = 1
"""


def create_station(folder, scenario):
    simulate(folder, scenario)
    with (folder / "site.toml").open("a", encoding="utf-8") as file:
        file.write(RULES)
    site = read_site(folder / "site.toml")
    return site, sorted(site.scans.inbox.glob("*.laz"))


def process_and_evaluate(site, scans):
    """Process scans one by one, evaluate the alarms after each; return (scan, message) pairs."""
    messages = []
    for scan in scans:
        assert process_scans(site, [scan], lambda _: None) == 0
        alarms.evaluate(site, report=lambda line, name=scan.stem: messages.append((name, line)))
    return messages


@pytest.mark.slow
def test_avalanche_raises_an_alarm_of_the_true_size(tmp_path, credentials, webhook):
    """Avalanche in the third hour; the rule needs two scans that show it."""
    credentials(hook=webhook.url)
    scenario = replace(small(hours=5), melt_m_per_h=0.0, avalanche_hour=3.0)
    site, scans = create_station(tmp_path / "station", scenario)
    messages = process_and_evaluate(site, scans)
    assert {name for name, _ in messages} == {"250715_040000"}
    assert [line.split(" by ")[0] for _, line in messages if "deposit" in line] == ["alarm: deposit rose"]
    title, text = webhook.received[0]
    assert title == f"[station simulated] {len(messages)} alarm"
    assert text.splitlines() == [line for _, line in messages]
    assert len(webhook.received) == 1
    deposit = next(line for _, line in messages if "deposit" in line)
    size_m = float(deposit.split(" by ")[1].split(" m")[0])
    assert size_m == pytest.approx(true_rise_m(site), abs=0.02)

    result = subprocess.run(
        [sys.executable, "-m", "station", "alarms", "check", site.path],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert (result.returncode, result.stdout) == (0, "")  # it lasts and was sent


def true_rise_m(site):
    """Mean rise of the deposit in the simulated truth [m], which the station never reads."""
    with xr.open_dataset(site.path.parent / "truth.nc") as truth:
        rise_m = (truth.change[3:].mean("time") - truth.change[:3].mean("time")).values
    return float(rise_m[load_areas(site)["deposit"]].mean())


@pytest.mark.slow
def test_no_false_alarm_in_a_day_of_scans_and_200_drawn_hours(tmp_path, credentials, webhook):
    """A day of scans; then 200 h of twenty stations, drawn from the covariance of that day's epochs."""
    credentials(hook=webhook.url)
    scenario = replace(small(hours=24), melt_m_per_h=0.0, avalanche_m=0.0, reference_scans=4)
    site, scans = create_station(tmp_path / "station", scenario)
    assert process_and_evaluate(site, scans) == []
    assert webhook.received == []
    rng = np.random.default_rng(1)
    for name, shared_m, independent_m in area_sigmas(site):
        assert independent_m > 0
        for _ in range(20):
            hours = np.arange(200)
            change_m = shared_m * rng.normal() + independent_m * rng.normal(size=200)
            curve = AreaCurve(name, hours * 3600.0, change_m, np.full(200, np.hypot(shared_m, independent_m)))
            detections = change_alarms(curve, site.alarms.change, areas=3, expected_every_s=3600.0)
            assert not detections.detected.any()


def area_sigmas(site):
    """Yield for each area its sigma common to all epochs (the reference's) and that of an epoch [m]."""
    aggregates = Aggregates(series_for(site))
    newest, previous = aggregates.find_epoch(-1), aggregates.find_epoch(-2)
    for name, cells in load_areas(site).items():
        weights = cells / cells.sum()
        sum_of_variances = aggregates.variance(weights, newest) + aggregates.variance(weights, previous)
        difference_variance = aggregates.variance(weights, newest, previous)
        common_m = np.sqrt(max(sum_of_variances - difference_variance, 0) / 2)
        yield name, common_m, np.sqrt(difference_variance / 2)
