"""Whoever is killed, whenever: no scan is lost, none doubled, and no value is another."""

from __future__ import annotations

import harness

ALL = range(harness.SCANS)


def test_an_undisturbed_run_is_sound_and_crosses_boundaries(quiet):
    station = quiet()
    harness.assert_sound(station, ALL, station)
    assert station.step() > 200
