"""The known laser scanner models, by the value of `scanner.model`.

A value that no source was found for is missing; the site file must give it. Of some models no value has one.
"""

from __future__ import annotations

import re

KEYS = (
    "wavelength_um",
    "beam_divergence_mrad",
    "exit_diameter_m",
    "range_sigma_m",
    "angle_resolution_deg",
    "inclination_sigma_deg",
    "inclination_range_deg",
    "range_max_m",
)
FWHM_TO_1_E2 = 1.699  # width of a Gaussian beam at 1/e² by that at half maximum: sqrt(2 / ln 2)
MAKERS = re.compile(
    "riegl|lms|leica|scanstation|zf|zollerfro?e?hlich|imager|livox|teledyne|optech"
)  # words that names have or lack
# Aperture, encoders and inclination sensor of all RIEGL VZ: those of the VZ-400i, from its data sheet.
_RIEGL_VZ = {
    "wavelength_um": 1.55,
    "exit_diameter_m": 0.007,
    "angle_resolution_deg": 0.0005,
    "inclination_sigma_deg": 0.008,
    "inclination_range_deg": 10.0,
}
# HELIOS++ (Winiwarter et al., 2022), scanners_tls.xml: 0.52 by 4.89 mrad, as wide as a round beam of 3.5 mrad
# in the mean square. Directions are known to 0.1° (one sigma), as with an encoder of 0.35° a step.
_LIVOX = {
    "wavelength_um": 0.905,
    "beam_divergence_mrad": 3.5,
    "exit_diameter_m": 0.0,
    "range_sigma_m": 0.020,
    "angle_resolution_deg": 0.35,
    "inclination_sigma_deg": 0.1,  # without a sensor
    "inclination_range_deg": 10.0,
}
# Data sheet of the ScanStation P30 and P40: less than 0.23 mrad and 3.5 mm, at half maximum.
_LEICA_P = {
    "beam_divergence_mrad": round(0.23 * FWHM_TO_1_E2, 2),
    "exit_diameter_m": round(0.0035 * FWHM_TO_1_E2, 4),
}
# Manual and data sheets of the BLK360: 830 nm, 0.4 mrad and 2.25 mm at half maximum.
_LEICA_BLK = {
    "wavelength_um": 0.83,
    "beam_divergence_mrad": round(0.4 * FWHM_TO_1_E2, 2),
    "exit_diameter_m": round(0.00225 * FWHM_TO_1_E2, 4),
}
# RIEGL VZ-400, VZ-600i and VZ-1000: beam and noise from HELIOS++, whose accuracy stands for the noise of a
# shot, which is less. Ranges of these three: the maker's, not checked against data sheets. (Echoes from
# beyond the range are taken for a corrupt file, so it is the largest of any mode.)
SCANNERS: dict[str, dict[str, float]] = {
    # Voordendag et al. (2023), section 2.2; RIEGL's data sheet: 10 mm precision, inclination sensor.
    "riegl-vz-6000": _RIEGL_VZ
    | {
        "wavelength_um": 1.064,
        "beam_divergence_mrad": 0.12,
        "exit_diameter_m": 0.0,
        "range_sigma_m": 0.010,
        "range_max_m": 6000.0,
    },
    # Hartzell et al. (2015), Table 1.
    "riegl-vz-4000": _RIEGL_VZ
    | {"beam_divergence_mrad": 0.15, "exit_diameter_m": 0.018, "range_sigma_m": 0.010, "range_max_m": 4000.0},
    # RIEGL's data sheet: 3 mm precision, 0.35 mrad, 1.55 µm.
    "riegl-vz-400i": _RIEGL_VZ | {"beam_divergence_mrad": 0.35, "range_sigma_m": 0.003, "range_max_m": 800.0},
    # Hartzell et al. (2015), Table 1.
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
    "riegl-vz-400": _RIEGL_VZ | {"beam_divergence_mrad": 0.30, "range_sigma_m": 0.005, "range_max_m": 600.0},
    "riegl-vz-600i": _RIEGL_VZ
    | {"beam_divergence_mrad": 0.35, "range_sigma_m": 0.005, "range_max_m": 1000.0},
    "riegl-vz-1000": _RIEGL_VZ
    | {"beam_divergence_mrad": 0.30, "range_sigma_m": 0.008, "range_max_m": 1400.0},
    "riegl-vz-2000": _RIEGL_VZ,  # 1550 nm: Vos et al. (2022), Kijkduin
    "riegl-vz-2000i": _RIEGL_VZ,
    # Ranges: Okła, ed. (2010), Geomatyka w Lasach Państwowych, 14.5.2; the first also by the maker's page.
    "riegl-lms-z420i": {"range_max_m": 1000.0},
    "riegl-lms-z620": {"range_max_m": 2000.0},
    "riegl-lms-z210ii": {"range_max_m": 650.0},
    "leica-scanstation-p30": _LEICA_P,
    "leica-scanstation-p40": _LEICA_P,
    "leica-scanstation-p20": {},
    "leica-scanstation-p50": {},
    "leica-blk360": _LEICA_BLK,
    "leica-blk360-g2": _LEICA_BLK | {"range_max_m": 45.0},
    # Pesci et al. (2011): 0.17 mrad; 12.7 mm at the exit.
    "optech-ilris-3d": {"beam_divergence_mrad": 0.17, "exit_diameter_m": 0.0127},
    "optech-polaris": {},
    "livox-mid-40": _LIVOX | {"range_max_m": 260.0},
    "livox-mid-70": _LIVOX | {"range_max_m": 260.0},
    "livox-hap": _LIVOX | {"range_max_m": 150.0},  # its manual (2022), table 1.2.1: at 10 % of reflectance
    "livox-horizon": {"range_max_m": 260.0},  # the maker's wiki, page of products
    "livox-tele-15": {},
    "livox-avia": _LIVOX | {"range_max_m": 450.0},  # HELIOS++, scanners_livox_avia.xml; range: published code
    # Half-angle of 0.3 mrad and 1.5 µm from published code that cites the data sheet; noise of 0.25 mm and
    # 0.004° as in HDMapping (MapsHD); its aperture and its tilt sensor are not known.
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
    plain = _without_maker(name)
    return next((model for model in SCANNERS if plain == _without_maker(model)), None)


def missing_values(model: str) -> tuple[str, ...]:
    """Return the keys of a scanner that the table does not know; all of them for an unknown model."""
    return tuple(key for key in KEYS if key not in SCANNERS.get(model, {}))


def _without_maker(name: str) -> str:
    return MAKERS.sub("", re.sub(r"[^a-z0-9]", "", name.lower()))
