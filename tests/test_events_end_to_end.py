"""From scans to the table of events: debris on rough ground, at the real scanner's density of points."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks import event_stations
from station.simulation.scenario import full_resolution, named

SCANS = 16
DEPOSIT_SCAN = 14


@pytest.mark.integration
def test_debris_2_km_away_is_told_by_the_second_scan_with_its_volume(tmp_path):
    rough = full_resolution(named("rough", SCANS, seed=1))
    sector = replace(
        rough,
        azimuth_deg=(202.0, 212.0),
        lines=round(rough.lines * 10 / 148),
        extent_m=(-2300.0, -300.0, 300.0, 2300.0),
        terrain_step_m=3.0,
        reference_scans=4,
    )
    scenario = event_stations.with_deposits(sector, [DEPOSIT_SCAN])
    total = event_stations.Score()
    event_stations.score(total, event_stations.events_of(tmp_path, scenario), scenario)
    assert (total.late, total.false, total.widespread) == ([0], 0, [])
    assert abs(total.z[0]) < 1.96
    assert 5 < total.sigma_m3[0] < 40  # of 150 m³
