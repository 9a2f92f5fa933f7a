"""Effects of air on the laser pulse: refractivity, range correction and refraction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Air, Floats

LAPSE_K_PER_M = 0.0065  # ICAO standard atmosphere, troposphere
HYDROSTATIC_K_PER_M = 0.0341632  # g M / R of dry air, ICAO standard atmosphere
EARTH_RADIUS_M = 6_371_000.0  # IUGG mean radius
KELVIN = 273.15  # 0 °C
LIGHT_M_PER_S = 299_792_458.0  # in vacuum, SI


def vapour_pressure(temperature_c: Floats | float, humidity_pct: Floats | float) -> Floats:
    """Partial pressure of water vapour [hPa].

    Source: WMO-No. 8 (2018), annex 4.B, saturation over water; the papers give none.
    """
    saturation = 6.112 * np.exp(17.62 * np.asarray(temperature_c) / (243.12 + np.asarray(temperature_c)))
    return np.asarray(humidity_pct) / 100.0 * saturation


def standard_group_refractivity(wavelength_um: float) -> float:
    """Group refractivity of air at 0 °C, 1013.25 hPa, 0.0375 % CO2 [ppm].

    Source: Voordendag et al. (2023), Eq. 7, with the wavelength in µm (IUGG 1999).
    """
    return 287.6155 + 4.88660 / wavelength_um**2 + 0.06800 / wavelength_um**4


def group_refractivity(
    temperature_c: Floats | float,
    pressure_hpa: Floats | float,
    vapour_hpa: Floats | float,
    wavelength_um: float,
) -> Floats:
    """Group refractivity of moist air [ppm]; the index is 1 + 1e-6 of it (Eq. 9).

    Source: Voordendag et al. (2023), Eq. 8 (the closed formula of IUGG 1999).
    """
    kelvin = np.asarray(temperature_c) + KELVIN
    dry = KELVIN / 1013.25 * standard_group_refractivity(wavelength_um) * np.asarray(pressure_hpa) / kelvin
    return np.asarray(dry - 11.27 * np.asarray(vapour_hpa) / kelvin)


def range_from_time(echo_s: Floats | float, refractivity_ppm: Floats | float) -> Floats:
    """Range [m] of an echo from its two-way travel time [s], at a constant group refractivity [ppm].

    The scanner does this step itself, with the air it is configured for.
    Source: Voordendag et al. (2023), Eq. 6, with the index of Eq. 9.
    """
    return np.asarray(LIGHT_M_PER_S / (1 + 1e-6 * np.asarray(refractivity_ppm)) * np.asarray(echo_s) / 2)


def refractivity_above(air: Air, rise_m: Floats, wavelength_um: float) -> Floats:
    """Group refractivity `rise_m` above the scanner (negative: below) [ppm].

    Hydrostatic, at the standard lapse rate and constant mixing ratio.
    Source: equations.md, 5.9 (the papers treat the height dependence as noise; it is deterministic).
    """
    temperature_c = air.temperature_c - LAPSE_K_PER_M * rise_m
    thinning = (1 - LAPSE_K_PER_M * rise_m / (air.temperature_c + KELVIN)) ** (
        HYDROSTATIC_K_PER_M / LAPSE_K_PER_M
    )
    vapour_hpa = vapour_pressure(air.temperature_c, air.humidity_pct) * thinning
    return group_refractivity(temperature_c, air.pressure_hpa * thinning, vapour_hpa, wavelength_um)


def path_mean_refractivity(air: Air, rise_m: Floats, wavelength_um: float) -> Floats:
    """Mean group refractivity along a straight path from the scanner to `rise_m` above it [ppm].

    Simpson's rule in height. Source: Voordendag et al. (2023), Eq. 10.
    """
    rise_m = np.asarray(rise_m, dtype=np.float64)
    ends = refractivity_above(air, 0 * rise_m, wavelength_um) + refractivity_above(air, rise_m, wavelength_um)
    return np.asarray((ends + 4 * refractivity_above(air, rise_m / 2, wavelength_um)) / 6)


def standard_air(height_m: float) -> Air:
    """Air of the ICAO standard atmosphere at a height [m], at 50 % humidity, if none was measured."""
    sea_level = Air(15.0, 1013.25, 50.0)
    thinning = (1 - LAPSE_K_PER_M * height_m / (15.0 + KELVIN)) ** (HYDROSTATIC_K_PER_M / LAPSE_K_PER_M)
    return Air(15.0 - LAPSE_K_PER_M * height_m, sea_level.pressure_hpa * thinning, sea_level.humidity_pct)


@dataclass(frozen=True)
class AirCorrection:
    """Correction for the air that the scanner itself did not account for.

    `range_ppm` are the coefficients of a quadratic in the height of the target above the scanner [km],
    constant first: the correction to add to a range [ppm].
    """

    range_ppm: tuple[float, float, float]
    refraction_coefficient: float

    def range_scale(self, rise_m: Floats) -> Floats:
        """Factor from measured to true ranges [1]."""
        constant, linear, square = self.range_ppm
        rise_km = rise_m * 1e-3
        return 1.0 + 1e-6 * (constant + rise_km * (linear + rise_km * square))

    def apply(self, apparent_m: Floats) -> Floats:
        """Return true offsets (3, n) of targets from apparent ones: east, north, up from the scanner [m]."""
        true_m = apparent_m * self.range_scale(apparent_m[2])
        true_m[2] -= refraction_height_error(true_m[0] ** 2 + true_m[1] ** 2, self.refraction_coefficient)
        return np.asarray(true_m)


def air_correction(air: Air, assumed: Air | None, wavelength_um: float) -> AirCorrection:
    """Return the correction of ranges measured for an assumed air to ranges through the real air.

    `assumed` None: the scanner used the speed of light in vacuum.
    Source: Voordendag et al. (2023), Eq. 10: ΔR = ∫ (n0 - n_g) ds, to be added.
    """
    rise_m = np.linspace(-2000.0, 1000.0, 31)
    n0_ppm = 0.0
    if assumed is not None:
        vapour_hpa = vapour_pressure(assumed.temperature_c, assumed.humidity_pct)
        n0_ppm = float(
            group_refractivity(assumed.temperature_c, assumed.pressure_hpa, vapour_hpa, wavelength_um)
        )
    correction_ppm = n0_ppm - path_mean_refractivity(air, rise_m, wavelength_um)
    constant, linear, square = np.polynomial.polynomial.polyfit(rise_m * 1e-3, correction_ppm, 2)
    return AirCorrection(
        (float(constant), float(linear), float(square)),
        refraction_coefficient(air.temperature_c, air.pressure_hpa, -LAPSE_K_PER_M),
    )


def refraction_coefficient(temperature_c: float, pressure_hpa: float, gradient_k_per_m: float) -> float:
    """Coefficient of refraction k: the Earth's radius over the radius of curvature of the ray [1].

    Source: equations.md, 5.10 (after Brunner 1984): k = 503 p / T² (0.0343 + dT/dz).
    """
    return 503.0 * pressure_hpa / (temperature_c + KELVIN) ** 2 * (0.0343 + gradient_k_per_m)


def refraction_height_error(horizontal_m2: Floats, coefficient: float) -> Floats:
    """Height by which a target appears too high due to refraction [m], from its squared distance [m²].

    The angle of Voordendag et al. (2023), Eq. 11, times the range, for a constant gradient along the path;
    the paper neglects it: 0.12 m at 3421 m for k = 0.13. Source: equations.md, 5.10, k R² / 2 R_E.
    """
    return coefficient / (2 * EARTH_RADIUS_M) * horizontal_m2
