"""Kills of the service and its workers at any time: no scan lost or duplicated, no value changed."""

from __future__ import annotations

import harness
import pytest
from support.effort import SHARE

pytestmark = pytest.mark.integration

ALL = range(harness.SCANS)
RANDOM_KILLS = 300 // SHARE
ONE_LIFE_S = 600.0  # a service survives hundreds of kills of its workers, 0.2 s each on an idle machine
HOLDS = "lost=0 doubled=0 wrong=0"


def test_undisturbed_run_is_intact_and_crosses_write_boundaries(undisturbed):
    station = undisturbed()
    harness.assert_store_intact(station, ALL, station)
    assert station.step() > 200


def run_until_finished(station, undisturbed, plans, capsys, *, hours=ALL):
    """Restart the service after each kill until all is processed; then check the invariants."""
    station.drop(*hours)
    for plan in plans:
        station.start(**plan)
        station.wait_until(lambda: station.is_finished(*hours) or not station.is_alive(), ONE_LIFE_S)
        if station.is_alive():
            station.end()
            break
    else:
        station.finish(*hours)
    harness.assert_store_intact(station, hours, undisturbed)
    with capsys.disabled():
        print(f"\n  trials=1 starts={station.starts} kills={station.kills} {HOLDS}")


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["both", "child"])
def test_kill_at_write_boundaries(make_station, undisturbed, rng, capsys, victim):
    """A process dies once before and once after each change on disk; a share of them is drawn in each run."""
    station = make_station()
    plan = {"once": victim, "draw": [SHARE, rng.random()]}
    run_until_finished(station, undisturbed(), [plan] * 1000, capsys)
    assert station.kills > 150 / SHARE


def draw_kills(rng, *, kills, max_spacing=60):
    """Draw boundaries and delays of kills: `kills` of the worker process, then one of the service."""
    at, plan = 0, []
    for _ in range(kills):
        at += rng.randrange(1, max_spacing)
        plan.append([at, rng.choice([0.0, rng.uniform(0.0, 0.15)]), "child"])
    plan.append([at + rng.randrange(1, max_spacing), rng.uniform(0.0, 0.15), rng.choice(["service", "both"])])
    return {"kills": plan}


def test_few_random_kills(make_station, undisturbed, rng, capsys):
    run_until_finished(make_station(), undisturbed(), [draw_kills(rng, kills=2) for _ in range(3)], capsys)


@pytest.mark.slow
def test_random_kills(make_station, undisturbed, rng, capsys):
    """SIGKILL to the service and to its worker process, which decodes, publishes and compacts."""
    stations = []
    while sum(station.kills for station in stations) < RANDOM_KILLS:
        method = "joint" if len(stations) % 5 == 4 else "none"
        station = make_station(method)
        run_until_finished(
            station, undisturbed(method), [draw_kills(rng, kills=rng.randrange(3)) for _ in range(12)], capsys
        )
        stations.append(station)
    with capsys.disabled():
        kills, starts = (sum(getattr(station, name) for station in stations) for name in ("kills", "starts"))
        print(f"\n  trials={len(stations)} starts={starts} kills={kills} {HOLDS}")


@pytest.mark.slow
def test_kills_of_a_service_started_by_its_command(make_station, undisturbed, rng, capsys):
    """As above; the service is started by its command, not forked from a warm process."""
    run_until_finished(
        make_station(cold=True), undisturbed(), [draw_kills(rng, kills=2) for _ in range(5)], capsys
    )
