"""The known laser scanner models, by the value of `scanner.model`."""

from __future__ import annotations

# Published values: Voordendag et al. (2023), section 2.2 (VZ-6000); Hartzell et al. (2015), Table 1
# (VZ-4000, LMS-Z390i). The papers give no range noise and no aperture for the VZ-6000, and nothing for the
# VZ-400i: these values, and the ranges of the inclination sensors, are from the manufacturer's data sheets
# (RIEGL: 10 mm and 3 mm precision; 0.35 mrad, 1.55 µm).
SCANNERS: dict[str, dict[str, float]] = {
    "riegl-vz-6000": {
        "wavelength_um": 1.064,
        "beam_divergence_mrad": 0.12,
        "exit_diameter_m": 0.0,
        "range_sigma_m": 0.010,
        "angle_resolution_deg": 0.0005,
        "inclination_sigma_deg": 0.008,
        "inclination_range_deg": 10.0,
        "range_max_m": 6000.0,
    },
    "riegl-vz-4000": {
        "wavelength_um": 1.55,
        "beam_divergence_mrad": 0.15,
        "exit_diameter_m": 0.018,
        "range_sigma_m": 0.010,
        "angle_resolution_deg": 0.0005,
        "inclination_sigma_deg": 0.008,
        "inclination_range_deg": 10.0,
        "range_max_m": 4000.0,
    },
    "riegl-vz-400i": {
        "wavelength_um": 1.55,
        "beam_divergence_mrad": 0.35,
        "exit_diameter_m": 0.007,
        "range_sigma_m": 0.003,
        "angle_resolution_deg": 0.0005,
        "inclination_sigma_deg": 0.008,
        "inclination_range_deg": 10.0,
        "range_max_m": 800.0,
    },
    "riegl-lms-z390i": {
        "wavelength_um": 1.55,
        "beam_divergence_mrad": 0.30,
        "exit_diameter_m": 0.0085,
        "range_sigma_m": 0.004,
        "angle_resolution_deg": 0.001,
        "inclination_sigma_deg": 0.008,
        "inclination_range_deg": 10.0,
        "range_max_m": 400.0,
    },
}
