"""The known laser scanner models, by the value of `scanner.model`."""

from __future__ import annotations

import re

# Published values: Voordendag et al. (2023), section 2.2 (VZ-6000); Hartzell et al. (2015), Table 1
# (VZ-4000, LMS-Z390i). The papers give no range noise and no aperture for the VZ-6000, and nothing for the
# VZ-400i: these values, and the ranges of the inclination sensors, are from the manufacturer's data sheets
# (RIEGL: 10 mm and 3 mm precision; 0.35 mrad, 1.55 µm).
# VZ-400, VZ-600i, VZ-1000 and Livox: beam and noise from the definitions of HELIOS++ (Winiwarter et al.,
# 2022, scanners_tls.xml), made from the data sheets; its accuracy stands for the noise of a shot, which is
# less. Aperture, encoders and inclination sensor of these RIEGL are those of the VZ-400i; ranges are the
# makers'. The beam of the Livox is 0.52 by 4.89 mrad, as wide as a round one of 3.5 mrad in the mean square.
# Its direction is known to 0.1° (one sigma), as with an encoder of 0.35° a step; it has no tilt sensor.
# Livox HAP: its manual (2022), table 1.2.1; 150 m are at 10 % of reflectance. Z+F 5016: 1.5 µm and a
# half-angle of 0.3 mrad from published code that cites the data sheet; noise of 0.25 mm and 0.004° as in
# HDMapping (MapsHD); its aperture and its tilt sensor are not known.
# Not checked against data sheets: ranges and 1.55 µm of the VZ-400, VZ-600i and VZ-1000.
LIVOX_MID = {
    "wavelength_um": 0.905,
    "beam_divergence_mrad": 3.5,
    "exit_diameter_m": 0.0,
    "range_sigma_m": 0.020,
    "angle_resolution_deg": 0.35,
    "inclination_sigma_deg": 0.1,
    "inclination_range_deg": 10.0,
    "range_max_m": 260.0,
}
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
    "riegl-vz-400": {
        "wavelength_um": 1.55,
        "beam_divergence_mrad": 0.30,
        "exit_diameter_m": 0.007,
        "range_sigma_m": 0.005,
        "angle_resolution_deg": 0.0005,
        "inclination_sigma_deg": 0.008,
        "inclination_range_deg": 10.0,
        "range_max_m": 600.0,
    },
    "riegl-vz-600i": {
        "wavelength_um": 1.55,
        "beam_divergence_mrad": 0.35,
        "exit_diameter_m": 0.007,
        "range_sigma_m": 0.005,
        "angle_resolution_deg": 0.0005,
        "inclination_sigma_deg": 0.008,
        "inclination_range_deg": 10.0,
        "range_max_m": 1000.0,
    },
    "riegl-vz-1000": {
        "wavelength_um": 1.55,
        "beam_divergence_mrad": 0.30,
        "exit_diameter_m": 0.007,
        "range_sigma_m": 0.008,
        "angle_resolution_deg": 0.0005,
        "inclination_sigma_deg": 0.008,
        "inclination_range_deg": 10.0,
        "range_max_m": 1400.0,
    },
    "livox-mid-40": LIVOX_MID,
    "livox-mid-70": LIVOX_MID,
    "livox-hap": LIVOX_MID | {"range_max_m": 150.0},
    "zf-imager-5016": {
        "wavelength_um": 1.5,
        "beam_divergence_mrad": 0.6,
        "exit_diameter_m": 0.0,
        "range_sigma_m": 0.00025,
        "angle_resolution_deg": 0.0139,
        "inclination_sigma_deg": 0.1,
        "inclination_range_deg": 10.0,
        "range_max_m": 360.0,
    },
}


def scanner_model(name: str) -> str | None:
    """Return the known model that a name such as `VZ-6000` or `Riegl VZ 6000` means; None without one."""
    plain = _letters_and_digits(name)
    for model in SCANNERS:
        if plain in {_letters_and_digits(model), _letters_and_digits(model.partition("-")[2])}:
            return model
    return None


def _letters_and_digits(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())
