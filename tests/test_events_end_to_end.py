"""From scans to the table of events: debris under disturbances, at the real scanner's density of points."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks import event_stations
from station.simulation.scenario import full_resolution, named

SCANS, REFERENCE_SCANS = 12, 2
DEPOSIT_SCAN = 10  # the first scan that is searched is the next


@pytest.mark.integration
def test_debris_2_km_away_is_found_by_the_second_scan_with_its_volume(tmp_path):
    station = full_resolution(named("disturbed", SCANS, seed=2))
    sector = replace(
        station,
        azimuth_deg=(200.0, 210.0),
        lines=round(station.lines * 10 / 148),
        elevation_deg=(-28.0, -4.0),
        shots_per_line=600,
        extent_m=(-2300.0, -300.0, 300.0, 2300.0),
        terrain_step_m=5.0,
        reference_scans=REFERENCE_SCANS,
    )
    scenario = event_stations.with_deposits(sector, [DEPOSIT_SCAN])
    total = event_stations.Score()
    event_stations.score(total, event_stations.events_of(tmp_path, scenario), scenario)
    assert (total.late, total.false, total.widespread) == ([0], 0, [])
    assert abs(total.z[0]) < 1.96
    assert total.sigma_m3[0] < 50  # of 150 m³
