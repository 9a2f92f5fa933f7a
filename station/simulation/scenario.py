"""What a simulated station lives through: one magnitude per error, zero switches it off."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal

from station.errors import ConfigError

NAMES = ("quiet", "drift", "wind", "snowfall", "melt", "avalanche", "poor", "fog", "moved")  # of scenarios

# Everything without_errors() sets to zero: what stands between a shot and the point it should give.
ERRORS = (
    "air", "refraction_sigma", "refraction_azimuth_sigma", "lapse_sigma_k_per_m", "path_temperature_sigma_k",
    "refraction_patch_sigma", "fog_visibility_m",
    "lean_drift_deg", "lean_within_scan_deg", "sway_deg", "wind_sway_deg", "lean_jerk_deg",
    "line_jitter_deg", "mirror_wobble_deg", "heading_deg", "position_m", "moved_hour", "moved_deg", "moved_m",
    "range_bias_m", "range_noise_m", "beam_divergence_mrad", "echo_loss",
    "log_noise_deg", "log_bias_deg", "log_cyclic_deg", "log_cyclic_change", "log_clock_s",
    "melt_m_per_h", "snowfall_m", "avalanche_m",
)  # fmt: skip


@dataclass(frozen=True)
class Scenario:
    """A station, its hours, and the size of everything that goes wrong there.

    Errors are standard deviations unless they say otherwise; angles are degrees, as in a site file.
    """

    seed: int = 1
    start: datetime = datetime(2025, 7, 15, tzinfo=UTC)
    hours: int = 24  # one scan each

    # the place
    size: float = 1.0  # of the valley against the real one; the heights shrink with it
    terrain_step_m: float = 2.0
    roughness_m: float = 0.10
    roughness_length_m: float = 80.0  # shortest wavelength of the roughness
    cell_m: float = 5.0
    extent_m: tuple[float, float, float, float] = (-3700.0, 350.0, 1100.0, 2650.0)  # W S E N, times size

    # the scanner's work
    lines: int = 2700
    shots_per_line: int = 1000
    scan_s: float = 900.0
    azimuth_deg: tuple[float, float] = (97.0, 245.0)  # first and last, about the scanner's z axis from its x
    elevation_deg: tuple[float, float] = (-31.0, 9.0)  # lowest and highest, from the scanner's xy plane
    incidence_max_deg: float = 85.0  # no echo beyond
    range_max_m: float = 6000.0
    reference_scans: int = 8

    # the mount, all of it contained in the SOP
    mount_roll_deg: float = 2.1
    mount_pitch_deg: float = -1.3
    mount_heading_deg: float = -75.0  # of the scanner's x axis, counter-clockwise from east
    mount_position_m: tuple[float, float, float] = (0.42, -0.31, 1.63)  # east, north, up of the mark

    # the air; without it light is as fast as the scanner assumes, nothing bends, and there is no weather log
    air: bool = True
    refraction_sigma: float = 0.07  # of k from scan to scan, about what temperature and pressure tell
    refraction_azimuth_sigma: float = 0.02  # of k over azimuth within a scan
    refraction_patch_sigma: float = 0.0  # of k in patches of azimuth with sharp edges, fresh in each scan
    lapse_sigma_k_per_m: float = 0.0015
    path_temperature_sigma_k: float = 0.7  # of the air over the glacier against the thermometer's
    fog_visibility_m: float = 0.0  # between the hours below; 0 is no fog
    fog_hours: tuple[float, float] = (8.0, 16.0)

    # how the scanner moves
    lean_drift_deg: float = 0.004  # over hours; against the first scan 1.4 times that
    lean_within_scan_deg: float = 0.0018  # over minutes
    sway_deg: float = 0.0010  # over seconds
    wind_sway_deg: float = 0.0  # over seconds within gusts, nothing between them
    lean_jerk_deg: float = 0.0  # of sudden steps, about two a scan, that fade within minutes
    line_jitter_deg: float = 0.0008  # of each line's elevation; no sensor sees it
    mirror_wobble_deg: float = 0.0  # the same, but it comes back every few lines
    heading_deg: float = 0.0010  # of each scan
    position_m: float = 0.002  # of each scan, each axis
    moved_hour: float = 0.0  # from then on the scanner is moved for good; 0 is never
    moved_deg: float = 0.0  # by how much it is tilted then; it is turned by half as much
    moved_m: float = 0.0  # by how much it is shifted then

    # how it measures
    range_bias_m: float = 0.004  # of each scan
    range_noise_m: float = 0.010
    beam_divergence_mrad: float = 0.12
    echo_loss: float = 0.02  # share of shots without an echo

    # its inclination sensor
    log_noise_deg: float = 0.008
    log_bias_deg: float = 0.0015  # of each scan
    log_cyclic_deg: float = 0.035  # amplitude of the wave over one turn
    log_cyclic_change: float = 0.15  # share by which the wave changes from scan to scan
    log_clock_s: float = 2.0  # offset of each scan's log, cut at 5 s

    # how the surface changes
    melt_m_per_h: float = 0.0  # of ice at the end of the tongue; none 450 m (times size) higher
    melt_from_hour: float = 0.0
    snowfall_m: float = 0.0  # in all, between the hours below
    snow_hours: tuple[float, float] = (4.0, 12.0)
    avalanche_m: float = 0.0  # height of the deposit
    avalanche_hour: float = 15.0
    avalanche_size: float = 1.0  # of release and deposit; at 1 the deposit is 300 m long

    # what its owner knows to be stable: rock all round, or only a far ridge and a hut that snow never covers
    stable_ground: Literal["good", "poor"] = "good"

    def __post_init__(self) -> None:
        """Refuse what cannot be simulated."""
        if self.hours < 1 or self.lines < 2 or self.shots_per_line < 2:
            raise ConfigError("a simulated station needs at least 1 hour, 2 lines and 2 shots a line")
        if not 0 < self.scan_s <= 3000:
            raise ConfigError("scan_s must lie above 0 and leave time before the next hour (3000)")
        if self.start.tzinfo is None:
            raise ConfigError("start needs a time zone: datetime(..., tzinfo=UTC)")

    def without_errors(self) -> Scenario:
        """Return the same station with every error and every change switched off."""
        return replace(self, **{name: type(getattr(self, name))(0) for name in ERRORS})

    @property
    def start_utc_s(self) -> float:
        """Start of the first scan, seconds since 1970."""
        return self.start.timestamp()

    @property
    def beam_sigma_rad(self) -> float:
        """Scatter of the echo's true direction in each angle: a quarter of the full 1/e² width."""
        return self.beam_divergence_mrad * 1e-3 / 4

    def scan_start_s(self, scan: int) -> float:
        """Return the start of one scan in seconds since the first began."""
        return 3600.0 * scan

    def scan_start_utc_s(self, scan: int) -> float:
        """Return the start of one scan in seconds since 1970."""
        return self.start_utc_s + self.scan_start_s(scan)

    def hours_at(self, scan: int) -> float:
        """Return the middle of one scan in hours since the series began; its ground stands still then."""
        return scan + self.scan_s / 7200

    @property
    def azimuth_rad(self) -> tuple[float, float]:
        """First and last azimuth of the head."""
        return math.radians(self.azimuth_deg[0]), math.radians(self.azimuth_deg[1])


def demo(hours: int = 24, seed: int = 1) -> Scenario:
    """Give a day of hourly scans with every error, melt on the tongue and an avalanche in hour 15."""
    return Scenario(
        seed=seed,
        hours=hours,
        terrain_step_m=5.0,
        roughness_length_m=120.0,
        cell_m=10.0,
        extent_m=(-2700.0, 350.0, 900.0, 2650.0),
        azimuth_deg=(105.0, 239.0),
        lines=470,
        shots_per_line=530,
        reference_scans=min(8, max(1, hours // 3)),
        melt_m_per_h=0.02,
        avalanche_m=3.0,
    )


def named(name: str, hours: int = 24, seed: int = 1) -> Scenario:
    """Give the demo's valley with every usual error and one thing to see or to withstand.

    Whatever happens does so after the scans of the reference. Raises ConfigError if the name is not in NAMES.
    """
    reference = min(8, max(1, hours // 3))
    usual = replace(demo(hours, seed), melt_m_per_h=0.0, avalanche_m=0.0)
    special: dict[str, dict[str, Any]] = {
        "quiet": {},
        "drift": {
            "lean_drift_deg": 2 * usual.lean_drift_deg,
            "lean_within_scan_deg": 1.5 * usual.lean_within_scan_deg,
            "lean_jerk_deg": 0.002,
        },
        "wind": {"wind_sway_deg": 0.002, "mirror_wobble_deg": 0.0005},
        "snowfall": {"snowfall_m": 0.4, "snow_hours": (hours / 2, float(hours))},
        "melt": {"melt_m_per_h": 0.005, "melt_from_hour": float(reference)},
        "avalanche": {"avalanche_m": 2.0, "avalanche_hour": 2 * hours / 3, "avalanche_size": 0.11},
        "poor": {"stable_ground": "poor"},
        "fog": {"fog_visibility_m": 1500.0, "fog_hours": (hours / 3, 2 * hours / 3)},
        "moved": {"moved_hour": hours / 2, "moved_deg": 0.02, "moved_m": 0.005},
    }
    if name not in special:
        raise ConfigError(f"no scenario is called {name}: choose from {', '.join(NAMES)}")
    return replace(usual, **special[name])


def dense(scenario: Scenario) -> Scenario:
    """Give the same on the whole valley, as finely as the real scanner sees it: 1.4 million echoes a scan."""
    whole = Scenario()
    return replace(
        scenario,
        terrain_step_m=whole.terrain_step_m,
        roughness_length_m=whole.roughness_length_m,
        cell_m=whole.cell_m,
        extent_m=whole.extent_m,
        azimuth_deg=whole.azimuth_deg,
        lines=whole.lines,
        shots_per_line=whole.shots_per_line,
    )


def tiny(hours: int = 3, seed: int = 1) -> Scenario:
    """Give a valley a fifth as large with few points, for tests."""
    return Scenario(
        seed=seed,
        hours=hours,
        size=0.2,
        terrain_step_m=2.0,
        roughness_m=0.03,
        roughness_length_m=40.0,
        cell_m=5.0,
        lines=180,
        shots_per_line=200,
        scan_s=300.0,
        reference_scans=1,
        melt_m_per_h=0.02,
        avalanche_m=1.5,
        avalanche_hour=2.0,
    )
