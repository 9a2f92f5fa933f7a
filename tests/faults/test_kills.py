"""Whoever is killed, whenever: no scan is lost, none doubled, and no value is another."""

from __future__ import annotations

import harness
import pytest

ALL = range(harness.SCANS)
RANDOM_KILLS = 300
HOLDS = "lost=0 doubled=0 wrong=0"


def test_an_undisturbed_run_is_sound_and_crosses_boundaries(quiet):
    station = quiet()
    harness.assert_sound(station, ALL, station)
    assert station.step() > 200


def live_through(station, quiet, plans, capsys, *, hours=ALL):
    """Start the service, as often as it is killed, until it is through; then everything must hold."""
    station.drop(*hours)
    for plan in plans:
        station.start(**plan)
        station.await_(lambda: station.is_through(*hours) or not station.is_alive())
        if station.is_alive():
            station.end()
            break
    else:
        station.finish(*hours)
    harness.assert_sound(station, hours, quiet)
    with capsys.disabled():
        print(f"\n  trials=1 starts={station.starts} kills={station.kills} {HOLDS}")


@pytest.mark.slow
@pytest.mark.parametrize("whom", ["both", "child"])
def test_a_death_at_every_write_boundary(make, quiet, capsys, whom):
    """At each moment before and after a change of the disk someone dies, once; nobody dies there twice."""
    station = make()
    live_through(station, quiet(), [{"once": whom}] * 1000, capsys)
    assert station.kills > 150


def drawn(dice, *, kills, most=60):
    """Draw moments to kill at, a boundary and a little later: the child so many times, then the service."""
    at, plan = 0, []
    for _ in range(kills):
        at += dice.randrange(1, most)
        plan.append([at, dice.choice([0.0, dice.uniform(0.0, 0.15)]), "child"])
    plan.append([at + dice.randrange(1, most), dice.uniform(0.0, 0.15), dice.choice(["service", "both"])])
    return {"kills": plan}


def test_a_few_random_kills(make, quiet, dice, capsys):
    live_through(make(), quiet(), [drawn(dice, kills=2) for _ in range(3)], capsys)


@pytest.mark.slow
def test_three_hundred_random_kills(make, quiet, dice, capsys):
    """Kills of the service by kills -9, and of its child, which decodes, publishes, joins."""
    stations = []
    while sum(station.kills for station in stations) < RANDOM_KILLS:
        method = "joint" if len(stations) % 5 == 4 else "none"
        station = make(method)
        live_through(
            station, quiet(method), [drawn(dice, kills=dice.randrange(3)) for _ in range(12)], capsys
        )
        stations.append(station)
    with capsys.disabled():
        kills, starts = (sum(getattr(one, name) for one in stations) for name in ("kills", "starts"))
        print(f"\n  trials={len(stations)} starts={starts} kills={kills} {HOLDS}")


@pytest.mark.slow
def test_kills_of_a_service_started_by_its_command(make, quiet, dice, capsys):
    """The same without the shortcut of the other tests, which fork the service from a warm process."""
    live_through(make(cold=True), quiet(), [drawn(dice, kills=2) for _ in range(5)], capsys)
