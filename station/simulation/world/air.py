"""The true air: weather over the day, the refractivity along the beam and refraction of the ray."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Air, Floats, WeatherLog
from station.simulation.randomness import RandomFourierSeries, random_fourier, rng_for
from station.simulation.scenario import Mark, Scenario

WAVELENGTH_UM = 1.064  # VZ-6000, Voordendag et al. (2023), section 2.2
SCANNER_SETTING = Air(*Mark.scanner_setting)
LAPSE_K_PER_M = 0.0065  # ICAO standard atmosphere
SCALE_K_PER_M = 9.80665 * 0.0289644 / 8.314462  # g M / R: pressure falls by this over temperature
EARTH_M = 6.371e6
PATCH_DEG = (3.0, 10.0)  # widths of the patches of refraction
PATCH_EDGE_DEG = 0.3  # width of the ramp between two patches
CONTRAST = 3.912  # ln 50: at the visibility, contrast is down to 2 %. Koschmieder (1924)


@dataclass(frozen=True)
class AirOfScan:
    """The air of one scan: at the scanner, over the valley, and its refraction."""

    at_scanner: Air
    path_warmer_k: float  # the air along the beam against the thermometer's
    lapse_k_per_m: float
    coefficient: float  # of refraction, mean over azimuth
    by_azimuth: RandomFourierSeries  # added to it, by the ray's direction [rad, counter-clockwise from east]
    by_patch: Callable[[Floats], Floats] = np.zeros_like  # the same, with sharp edges
    wavelength_um: float = WAVELENGTH_UM
    scanner_setting: Air = SCANNER_SETTING

    def coefficient_at(self, bearing_rad: Floats) -> Floats:
        """Return the coefficient of refraction in each direction, counter-clockwise from east [1]."""
        return np.asarray(self.coefficient + self.by_azimuth(bearing_rad) + self.by_patch(bearing_rad))


@dataclass(frozen=True)
class RefractionPatches:
    """A piecewise constant function of direction, with a ramp from one patch to the next."""

    edge_deg: Floats  # (p - 1,) start of each patch but the first, ascending within 0-360
    value: Floats  # (p,)

    def __call__(self, bearing_rad: Floats) -> Floats:
        """Return the value in each direction."""
        half_deg = PATCH_EDGE_DEG / 2
        knot_deg = np.stack((self.edge_deg - half_deg, self.edge_deg + half_deg), axis=1).ravel()
        ends = np.repeat(self.value, 2)[1:-1]
        return np.asarray(np.interp(np.degrees(bearing_rad) % 360, knot_deg, ends))


def group_refractivity_ppm(
    temperature_c: Floats | float,
    pressure_hpa: Floats | float,
    humidity_pct: float,
    wavelength_um: float = WAVELENGTH_UM,
) -> Floats:
    """Return (n_g - 1) · 1e6 of moist air for the scanner's wavelength.

    Source: IUGG (1999) resolution 3, closed formula; vapour after WMO-No. 8.
    """
    inverse_square = wavelength_um**-2
    standard = 287.6155 + (4.88660 + 0.06800 * inverse_square) * inverse_square
    kelvin = temperature_c + 273.15
    vapour_hpa = humidity_pct / 100 * 6.112 * np.exp(17.62 * temperature_c / (243.12 + temperature_c))
    return np.asarray(standard * (273.15 / kelvin) * (pressure_hpa / 1013.25) - 11.27 * vapour_hpa / kelvin)


def assumed_refractivity_ppm(wavelength_um: float = WAVELENGTH_UM, setting: Air = SCANNER_SETTING) -> float:
    """Return the refractivity with which the scanner converts travel times into ranges [ppm]."""
    air = (setting.temperature_c, setting.pressure_hpa, setting.humidity_pct)
    return float(group_refractivity_ppm(*air, wavelength_um))


def path_refractivity_ppm(air: AirOfScan, rise_m: Floats) -> Floats:
    """Return the mean of (n_g - 1) · 1e6 along a straight ray that rises by `rise_m`.

    Gauss-Legendre with three points through a hydrostatic atmosphere of constant lapse rate.
    """
    points, weights = np.polynomial.legendre.leggauss(3)
    ground_c = air.at_scanner.temperature_c + air.path_warmer_k
    total = np.zeros_like(rise_m)
    for point, weight in zip(points, weights, strict=True):
        height_m = rise_m * (1 + point) / 2
        temperature_c = ground_c - air.lapse_k_per_m * height_m
        mean_k = ground_c + 273.15 - air.lapse_k_per_m * height_m / 2
        pressure_hpa = air.at_scanner.pressure_hpa * np.exp(-SCALE_K_PER_M * height_m / mean_k)
        total += (
            weight
            / 2
            * group_refractivity_ppm(
                temperature_c, pressure_hpa, air.at_scanner.humidity_pct, air.wavelength_um
            )
        )
    return total


def range_ratio(air: AirOfScan | None, rise_m: Floats) -> Floats:
    """Return the measured over the true range [1]; 1 if the air is switched off.

    Source: Voordendag et al. (2023), Eq. 6 and 10: the time of flight times c over the assumed index.
    """
    if air is None:
        return np.ones_like(rise_m)
    assumed_ppm = assumed_refractivity_ppm(air.wavelength_um, air.scanner_setting)
    return (1 + 1e-6 * path_refractivity_ppm(air, rise_m)) / (1 + 1e-6 * assumed_ppm)


def weather(scenario: Scenario, time_utc_s: Floats) -> WeatherLog:
    """Return temperature, pressure and humidity at the scanner at these times, as a log would record them."""
    series_s = time_utc_s - scenario.start_utc_s
    daily = np.cos(2 * np.pi * ((time_utc_s / 3600 - 14.0) / 24))  # warmest at 14 h
    slow = [random_fourier(rng_for(scenario.seed, 40, index), 1.0, 3 * 3600, 60 * 3600) for index in range(3)]
    quick = random_fourier(rng_for(scenario.seed, 40, 3), 0.25, 240, 3600)
    return WeatherLog(
        time_utc_s,
        temperature_c=scenario.mark.temperature_c + 2.5 * daily + 1.2 * slow[0](series_s) + quick(series_s),
        pressure_hpa=scenario.mark.pressure_hpa + 1.8 * slow[1](series_s),
        humidity_pct=np.clip(62.0 - 10.0 * daily + 9.0 * slow[2](series_s), 5.0, 100.0),
    )


def air_of_scan(scenario: Scenario, scan: int) -> AirOfScan | None:
    """Return the air at the middle of one scan, None if the air is switched off."""
    if not scenario.air:
        return None
    rng = rng_for(scenario.seed, 41, scan)
    sample = weather(scenario, np.array([scenario.scan_start_utc_s(scan) + scenario.scan_s / 2]))
    at_scanner = Air(
        float(sample.temperature_c[0]), float(sample.pressure_hpa[0]), float(sample.humidity_pct[0])
    )
    path_warmer_k = scenario.path_temperature_sigma_k * rng.standard_normal()
    lapse_k_per_m = LAPSE_K_PER_M + scenario.lapse_sigma_k_per_m * rng.standard_normal()
    gradient_factor = 503 * at_scanner.pressure_hpa / (at_scanner.temperature_c + 273.15) ** 2
    return AirOfScan(
        at_scanner,
        path_warmer_k,
        lapse_k_per_m,
        # k = 503 p / T² (0.0343 + dT/dz), equations.md, 5.10. The layers near the ground vary it far more
        # than the mean lapse rate does, so its variation has a magnitude of its own.
        gradient_factor * (0.0343 - LAPSE_K_PER_M) + scenario.refraction_sigma * rng.standard_normal(),
        random_fourier(rng, scenario.refraction_azimuth_sigma, np.radians(12), np.radians(90)),
        _refraction_patches(scenario, scan) if scenario.refraction_patch_sigma else np.zeros_like,
        scenario.wavelength_nm / 1000,
        Air(*scenario.mark.scanner_setting),
    )


def _refraction_patches(scenario: Scenario, scan: int) -> RefractionPatches:
    rng = rng_for(scenario.seed, 42, scan)
    edge_deg = np.cumsum(rng.uniform(*PATCH_DEG, int(360 / PATCH_DEG[0])))
    edge_deg = edge_deg[edge_deg < 360 - PATCH_DEG[0]]
    return RefractionPatches(
        edge_deg, scenario.refraction_patch_sigma * rng.standard_normal(len(edge_deg) + 1)
    )


def fog_visibility_m(scenario: Scenario, scan: int) -> float:
    """Return the visibility during one scan [m], infinity without fog."""
    begin, end = scenario.fog_hours
    foggy = scenario.fog_visibility_m > 0 and begin <= scenario.hours_at(scan) < end
    return scenario.fog_visibility_m if foggy else math.inf


def fog_transmission(range_m: Floats, visibility_m: float) -> Floats:
    """Return the share of the light that passes through the fog, there and back [1].

    Source: Koschmieder (1924), extinction 3.912 over visibility, along twice the range.
    """
    return np.asarray(np.exp(-2 * CONTRAST / visibility_m * range_m))


def bending_m(coefficient: Floats, along_m: Floats) -> Floats:
    """Return the drop of a ray below its initial direction after a horizontal distance [m].

    Source: equations.md, 5.10, k R² / (2 R_E).
    """
    return coefficient * along_m**2 / (2 * EARTH_M)
