"""From scans to the table of events: debris at the real scanner's density of points, and a rock face."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks import event_stations
from station.simulation.kinds import rockfall
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


@pytest.mark.integration
def test_scars_in_a_rock_face_and_their_debris_are_found_with_their_volumes(tmp_path):
    """Of 36, 13 and 44 m³, with cells of 1 m, whose blocks are 2 m: those of 10 m would be three at most."""
    scenario = replace(
        rockfall(hours=SCANS + 1), lines=380, shots_per_line=310, cell_m=1.0, terrain_step_m=1.0,
        reference_scans=REFERENCE_SCANS, rockfall_hour=DEPOSIT_SCAN + 0.75,
    )  # fmt: skip
    events = [event for event, _ in event_stations.events_of(tmp_path, scenario)]
    found = sorted(events, key=lambda event: event.volume_m3)
    assert [event.kind for event in found] == ["paired", "loss", "paired"]
    assert [event_stations.scan_of(event.begin, scenario) for event in found] == [DEPOSIT_SCAN + 1] * 3
    true_m3 = (-36.13, -13.01, 44.26)  # of the pattern of a metre
    for event, true in zip(found, true_m3, strict=True):
        assert abs(event.volume_m3 - true) < 1.96 * event.volume_sigma_m3
        assert event.volume_sigma_m3 < 0.06 * abs(true)
