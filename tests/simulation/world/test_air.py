"""The simulated air against published numbers (equations.md, 9)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.quantities import Air
from station.simulation.randomness import RandomFourierSeries
from station.simulation.station import Scenario
from station.simulation.world.air import (
    AirOfScan,
    air_of_scan,
    assumed_refractivity_ppm,
    path_refractivity_ppm,
    range_ratio,
    weather,
)


def uniform(temperature_c, lapse=0.0, warmer=0.0):
    flat = RandomFourierSeries(np.zeros(0), np.zeros(0), 0.0)
    return AirOfScan(Air(temperature_c, 684.0, 28.0), warmer, lapse, 0.13, flat)


def test_refractivity_of_the_scanner_setting():
    assert assumed_refractivity_ppm() == pytest.approx(198.498, abs=0.01)  # P5


@pytest.mark.parametrize(("kelvin", "correction_mm"), [(10, 24.3), (-10, -26.1)])
def test_published_range_errors_of_ten_degrees(kelvin, correction_mm):
    """P6: the correction of 3414 m measured with the setting of -2 °C."""
    ratio = range_ratio(uniform(-2.0 + kelvin), np.array([0.0]))[0]
    assert 3414e3 * (1 / ratio - 1) == pytest.approx(correction_mm, abs=0.15)


def test_air_below_the_scanner_is_denser():
    """Sensitivities of equations.md, 5.8: 0.290 ppm/hPa and -0.737 ppm/K along a hydrostatic column."""
    drop_m = np.array([-300.0])
    pressure_gain = 684.0 * 0.0341632 * 150 / 271.6  # to the middle of the path
    expected = 0.290 * pressure_gain - 0.737 * 0.0065 * 150
    column = path_refractivity_ppm(uniform(-2.0, lapse=0.0065), drop_m)[0] - assumed_refractivity_ppm()
    assert column == pytest.approx(expected, abs=0.06)


def test_range_ratio_without_air_is_one():
    assert air_of_scan(replace(Scenario(), air=False), 0) is None
    assert range_ratio(None, np.array([-500.0]))[0] == 1.0


def test_refraction_varies_about_the_standard_coefficient():
    """equations.md, 5.10: k = 0.131 at -6.5 K/km; 0.07 from scan to scan, 0.02 over azimuth."""
    scans = [air_of_scan(Scenario(), scan) for scan in range(300)]
    means = np.array([air.coefficient for air in scans])
    assert means.mean() == pytest.approx(0.131, abs=0.015)
    assert means.std() == pytest.approx(0.07, rel=0.15)
    bearing = np.radians(np.arange(0, 180, 5.0))
    within = np.array([air.coefficient_at(bearing) - air.coefficient for air in scans])
    assert within.std() == pytest.approx(0.02, rel=0.1)


def test_weather_is_plausible_for_a_summer_day_at_3245_m():
    log = weather(Scenario(), Scenario().start_utc_s + np.arange(0, 86400, 60.0))
    assert -6 < log.temperature_c.min() < log.temperature_c.max() < 12
    assert 680 < log.pressure_hpa.min() < log.pressure_hpa.max() < 696
    assert log.temperature_c[13 * 60 : 16 * 60].mean() > log.temperature_c[1 * 60 : 4 * 60].mean() + 2
