"""Scenarios of stations of other kinds than the valley: those of the site files in `config/`."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

from station.simulation.scenario import Mark, Scenario

SEA_AIR = (15.0, 1013.25, 50.0)  # of the ICAO standard atmosphere


def low_cost_snow(hours: int = 24, seed: int = 1) -> Scenario:
    """Return a Livox Avia before a snow slope, every ten minutes; 0.4 m of snow fall after the reference."""
    reference_scans = min(12, 2 * hours)
    return Scenario(
        seed=seed,
        start=datetime(2026, 1, 15, tzinfo=UTC),
        hours=hours,
        interval_s=600.0,
        kind="low-cost-snow",
        mark=Mark(46.8297, 9.8092, 2540.0, 32632, 745.0),
        terrain_step_m=1.0,
        roughness_m=0.05,
        roughness_length_m=8.0,
        cell_m=2.0,
        extent_m=(-130.0, 60.0, 130.0, 300.0),
        lines=60,
        shots_per_line=4000,
        pattern="rosette",
        scan_s=60.0,
        azimuth_deg=(55.0, 125.0),
        elevation_deg=(-33.0, 37.0),
        range_max_m=450.0,
        faintest_reflectance=0.56,  # 0.1 at 190 m
        reference_scans=reference_scans,
        mount_roll_deg=0.0,
        mount_pitch_deg=0.0,
        mount_heading_deg=0.0,
        mount_position_m=(0.0, 0.0, 6.0),
        tilt_drift_deg=0.01,
        heading_deg=0.005,
        line_jitter_deg=0.0,
        range_noise_m=0.020,
        beam_divergence_mrad=3.5,
        angle_step_deg=0.35,
        brightness="8bit",
        wavelength_nm=905,
        log_fault="missing",
        snowfall_m=0.4,
        snow_hours=(reference_scans / 6, max(float(hours), reference_scans / 6 + 1)),
    )


def mammoth(hours: int = 24, seed: int = 1) -> Scenario:
    """Return a VZ-400i, tilted by 31°, before a snow slope, every 15 minutes; 0.4 m of snow fall."""
    reference_scans = min(8, 2 * hours)
    return Scenario(
        seed=seed,
        start=datetime(2021, 1, 15, tzinfo=UTC),
        hours=hours,
        interval_s=900.0,
        kind="mammoth",
        mark=Mark(37.6433, -119.0292, 2950.0, 26911, 710.0, (12.0, 720.0, 50.0)),
        terrain_step_m=0.5,
        roughness_m=0.05,
        roughness_length_m=8.0,
        cell_m=1.0,
        extent_m=(-80.0, 60.0, 80.0, 190.0),
        lines=500,
        shots_per_line=500,
        scan_s=120.0,
        azimuth_deg=(40.0, 140.0),
        elevation_deg=(-50.0, 50.0),
        range_max_m=800.0,
        reference_scans=reference_scans,
        mount_roll_deg=25.0,
        mount_pitch_deg=-18.5,
        mount_heading_deg=0.0,
        mount_position_m=(0.0, 0.0, 4.0),
        range_noise_m=0.003,
        beam_divergence_mrad=0.35,
        wavelength_nm=1550,
        snowfall_m=0.4,
        snow_hours=(reference_scans / 4, max(float(hours), reference_scans / 4 + 1)),
    )


def beach(hours: int = 24, seed: int = 1) -> Scenario:
    """Return a VZ-2000 above a beach, every hour, on which a bar grows by 0.3 m after the reference."""
    return Scenario(
        seed=seed,
        start=datetime(2025, 10, 15, tzinfo=UTC),
        hours=hours,
        kind="beach",
        mark=Mark(52.0705, 4.2195, 85.0, 32631, 1003.0, SEA_AIR, temperature_c=12.0),
        terrain_step_m=1.0,
        roughness_m=0.03,
        roughness_length_m=10.0,
        cell_m=2.0,
        extent_m=(-330.0, -200.0, -30.0, 200.0),
        lines=600,
        shots_per_line=500,
        scan_s=400.0,
        azimuth_deg=(105.0, 255.0),
        elevation_deg=(-48.0, -4.0),
        incidence_max_deg=88.0,
        range_max_m=2000.0,
        faintest_reflectance=0.6,
        reference_scans=min(13, max(1, hours // 2)),
        mount_heading_deg=0.0,
        mount_position_m=(0.0, 0.0, 3.0),
        range_noise_m=0.005,
        beam_divergence_mrad=0.3,
        brightness="reflectance",
        wavelength_nm=1550,
        tide_m=0.9,
        bar_growth_m=0.3,
    )


def rockfall(hours: int = 24, seed: int = 1) -> Scenario:
    """Return a VZ-400i before a vertical rock face, every hour; blocks fall halfway after the reference."""
    reference_scans = min(8, max(1, hours // 2))
    return Scenario(
        seed=seed,
        start=datetime(2026, 4, 10, tzinfo=UTC),
        hours=hours,
        kind="rockfall",
        mark=Mark(46.3320, 9.6420, 1150.0, 32632, 882.0, (12.0, 882.0, 50.0)),
        terrain_step_m=0.5,
        roughness_m=0.15,
        roughness_length_m=4.0,
        cell_m=0.5,
        extent_m=(-110.0, -60.0, 110.0, 70.0),
        lines=760,
        shots_per_line=620,
        scan_s=300.0,
        azimuth_deg=(42.0, 90.0),
        elevation_deg=(-9.0, 25.0),
        range_max_m=800.0,
        reference_scans=reference_scans,
        mount_heading_deg=0.0,
        mount_position_m=(0.0, 0.0, 1.6),
        range_noise_m=0.003,
        beam_divergence_mrad=0.35,
        brightness="reflectance",
        wavelength_nm=1550,
        rockfall_m=1.0,
        rockfall_hour=(reference_scans + hours) / 2,
    )


KINDS: dict[str, Callable[[int, int], Scenario]] = {
    "mammoth": mammoth,
    "low-cost-snow": low_cost_snow,
    "beach": beach,
    "rockfall": rockfall,
}
