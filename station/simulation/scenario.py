"""Scenarios of a simulated station: one magnitude per error, zero switches it off."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal

from station.errors import ConfigError

NAMES = (  # for `named`
    "quiet", "drift", "wind", "snowfall", "melt", "avalanche", "poor", "fog", "moved",
    "rough", "rough-poor", "airborne", "airborne-heavy", "snow-db", "snow-1550", "snow-no-brightness",
    "ice-refraction", "settling", "melt-height", "winter", "summer", "disturbed", "log-cut", "log-missing",
    "log-time", "log-swapped", "breathing",
)  # fmt: skip

SCANNER_MODELS = {905: "livox-avia", 1064: "riegl-vz-6000", 1550: "riegl-vz-4000"}  # by wavelength [nm]

SEASON_S = 120 * 86_400.0
MAX_SCAN_SHARE = 5 / 6  # of the time from scan to scan

# Fields set to zero by without_errors(): every difference between a shot and its ideal point.
ERRORS = (
    "air", "refraction_sigma", "refraction_azimuth_sigma", "lapse_sigma_k_per_m", "path_temperature_sigma_k",
    "refraction_patch_sigma", "refraction_ice_sigma", "ice_layer_k", "fog_visibility_m",
    "tilt_drift_deg", "tilt_within_scan_deg", "sway_deg", "wind_sway_deg", "tilt_jerk_deg",
    "tilt_daily_deg", "tilt_walk_deg", "season_deg",
    "line_jitter_deg", "mirror_wobble_deg", "angle_step_deg", "heading_deg", "position_m", "moved_hour",
    "moved_deg", "moved_m",
    "range_bias_m", "range_noise_m", "beam_divergence_mrad", "echo_loss", "airborne_share", "airborne_clouds",
    "log_noise_deg", "log_bias_deg", "log_cyclic_deg", "log_cyclic_change", "log_clock_s", "log_fault",
    "melt_m_per_h", "thaw_m", "snowfall_m", "avalanche_m", "settling_m_per_h", "winter_m", "summer_melt_m",
    "heave_m", "creep_m", "bar_growth_m", "rockfall_m", "deposits",
)  # fmt: skip


@dataclass(frozen=True)
class Mark:
    """The mark of a station in UTM, and the air there; by default on the ridge above Hintereisferner."""

    latitude_deg: float = 46.7958
    longitude_deg: float = 10.7828
    height_m: float = 3245.0
    epsg: int = 32632
    pressure_hpa: float = 688.0  # on average
    # Temperature [°C], pressure [hPa], humidity [%] set in the scanner: Voordendag et al. (2023), 3.1.2
    scanner_setting: tuple[float, float, float] = (-2.0, 684.0, 28.0)
    temperature_c: float = 2.0  # on average

    @property
    def crs(self) -> str:
        """The map of the station."""
        return f"EPSG:{self.epsg}"

    @property
    def zone(self) -> int:
        """Zone of UTM."""
        return self.epsg % 100


@dataclass(frozen=True)
class Deposit:
    """Debris that comes to rest within an hour of the series: a disc of even depth."""

    hour: float
    east_m: float  # of the mark
    north_m: float
    area_m2: float = 500.0
    depth_m: float = 0.3


@dataclass(frozen=True)
class Scenario:
    """A station, its number of hours, and the magnitude of every error.

    Errors are standard deviations unless stated otherwise; angles are degrees, as in a site file.
    """

    seed: int = 1
    start: datetime = datetime(2025, 7, 15, tzinfo=UTC)
    hours: int = 24
    interval_s: float = 3600.0  # from scan to scan

    # the place
    kind: Literal["valley", "mammoth", "low-cost-snow", "beach", "rockfall"] = (
        "valley"  # landscape, site file
    )
    mark: Mark = Mark()
    size: float = 1.0  # of the valley relative to the real one, heights included
    terrain_step_m: float = 2.0
    roughness_m: float = 0.10
    roughness_length_m: float = 80.0  # shortest wavelength of the roughness
    rough_rock_m: float = 0.0  # relief of the rock between 6 and 400 m of wavelength, times size
    cell_m: float = 5.0
    extent_m: tuple[float, float, float, float] = (-3700.0, 350.0, 1100.0, 2650.0)  # W S E N, times size

    # the scan pattern
    lines: int = 2700
    shots_per_line: int = 1000
    pattern: Literal["lines", "rosette"] = "lines"  # of a mirror, or of two rotating prisms
    scan_s: float = 900.0
    azimuth_deg: tuple[float, float] = (97.0, 245.0)  # first and last, about the scanner's z axis from its x
    elevation_deg: tuple[float, float] = (-31.0, 9.0)  # lowest and highest, from the scanner's xy plane
    incidence_max_deg: float = 85.0  # no echo beyond
    range_max_m: float = 6000.0
    faintest_reflectance: float = 0.0  # that just gives an echo, square to the beam, at range_max_m
    reference_scans: int = 8

    # the mount, all of it contained in the SOP
    mount_roll_deg: float = 2.1
    mount_pitch_deg: float = -1.3
    mount_heading_deg: float = -75.0  # of the scanner's x axis, counter-clockwise from east
    mount_position_m: tuple[float, float, float] = (0.42, -0.31, 1.63)  # east, north, up of the mark

    # the air; without it there is no range error, no refraction and no weather log
    air: bool = True
    refraction_sigma: float = 0.07  # of k from scan to scan, about the value from temperature and pressure
    refraction_azimuth_sigma: float = 0.02  # of k over azimuth within a scan
    refraction_patch_sigma: float = 0.0  # of k in patches of azimuth with sharp edges, new in each scan
    refraction_ice_sigma: float = 0.0  # of k from scan to scan, for the whole path of rays that end on ice
    ice_layer_k: float = 0.0  # added to k at the ice by a layer of cold air, on average
    ice_layer_m: float = 3.0  # height over the ice at which that is down to 1/e
    lapse_sigma_k_per_m: float = 0.0015
    path_temperature_sigma_k: float = 0.7  # of the air over the glacier relative to the thermometer
    fog_visibility_m: float = 0.0  # during fog_hours; 0 is no fog
    fog_hours: tuple[float, float] = (8.0, 16.0)

    # motion of the scanner
    tilt_drift_deg: float = 0.004  # over hours; relative to the first scan 1.4 times as much
    tilt_within_scan_deg: float = 0.0018  # over minutes
    sway_deg: float = 0.0010  # over seconds
    wind_sway_deg: float = 0.0  # over seconds within gusts, zero between them
    tilt_jerk_deg: float = 0.0  # of sudden steps, about two per scan, that decay within minutes
    tilt_daily_deg: float = 0.0  # amplitude of a wave of 24 h
    tilt_walk_deg: float = 0.0  # random walk: standard deviation after a day
    line_jitter_deg: float = 0.0008  # of each line's elevation; not observed by the sensor
    line_jitter_freedom: float = 0.0  # Student's t with these degrees of freedom, above 2; 0 is normal
    mirror_wobble_deg: float = 0.0  # the same, but periodic over a few lines
    heading_deg: float = 0.0010  # of each scan
    position_m: float = 0.002  # of each scan, each axis
    moved_hour: float = 0.0  # start of a permanent displacement; 0 is never
    moved_deg: float = 0.0  # tilt of the displacement; the rotation is half as much
    moved_m: float = 0.0  # shift of the displacement

    # ranging
    range_bias_m: float = 0.004  # of each scan
    range_noise_m: float = 0.010
    beam_divergence_mrad: float = 0.12
    angle_step_deg: float = 0.0  # width of the even distribution of the error of each angle
    echo_loss: float = 0.02  # share of shots without an echo

    # snow, rain, dust and birds: echoes from the air instead of the ground
    airborne_share: float = 0.0  # of all shots
    airborne: Literal["near", "along"] = "near"  # density along the way: inverse to the range, or even
    airborne_clouds: float = 0.0  # share of the scans with a dense cloud within 150 m

    # brightness in the files: linear in 16 bit; the same with RIEGL's extra bytes "Reflectance" in dB; -25 to
    # 5 dB in 16 bit; linear in 8 bit; none
    brightness: Literal["linear", "reflectance", "decibel", "8bit", "none"] = "linear"
    wavelength_nm: Literal[905, 1064, 1550] = 1064
    intensity_reference_m: float = (
        0.0  # raw intensity falls with the square of the range over this; 0: corrected
    )

    # the inclination sensor
    log_noise_deg: float = 0.008
    log_bias_deg: float = 0.0015  # of each scan
    log_cyclic_deg: float = 0.035  # amplitude of the cyclic error over one turn
    log_cyclic_change: float = 0.15  # relative change of the amplitude from scan to scan
    log_clock_s: float = 2.0  # clock offset of each scan's log, clipped at 5 s
    log_fault: Literal["", "cut", "missing", "time", "swapped", "flipped"] = ""
    log_fault_hour: float = 0.0  # of the first scan with that fault

    # surface change
    melt_m_per_h: float = 0.0  # of ice at the end of the tongue; zero 450 m (times size) higher
    melt_from_hour: float = 0.0
    melt_by_day: bool = False  # all of it between 6 and 18 h, as the sun rises and sinks
    thaw_m: float = 0.0  # of snow on the ice, gone below an edge that climbs from the end of the tongue
    thaw_from_hour: float = 0.0
    thaw_climb_m_per_h: float = 30.0  # times size
    snowfall_m: float = 0.0  # in total, during snow_hours
    snow_hours: tuple[float, float] = (4.0, 12.0)
    avalanche_m: float = 0.0  # height of the deposit
    avalanche_hour: float = 15.0
    avalanche_size: float = 1.0  # of release and deposit; at 1 the deposit is 300 m long
    settling_m_per_h: float = 0.0  # of ice at 3 km (times size), in proportion to its distance
    settling_from_hour: float = 0.0
    season_hour: float = 0.0  # four months pass before this hour of the series; 0 is never
    season_deg: float = 0.0  # tilt and rotation of the scanner in these months
    winter_m: float = 0.0  # mean depth of the snow that fell in them, with drifts
    summer_melt_m: float = 0.0  # what melted in them at the end of the tongue; zero 450 m (times size) higher
    heave_m: float = 0.0  # of rock: half of its variance over the day, half random from scan to scan
    creep_m: float = 0.0  # displacement of part of the rock over the whole series
    tide_m: float = 0.0  # amplitude of the tide at a beach
    bar_growth_m: float = 0.0  # height of the bar that grows on a beach over the whole series
    deposits: tuple[Deposit, ...] = ()  # anywhere, also on stable ground
    rockfall_m: float = 0.0  # depth of the largest scar in a rock face
    rockfall_hour: float = 0.0

    # known stable ground: rock all round, or only a far ridge and a hut that snow never covers
    stable_ground: Literal["good", "poor"] = "good"

    def __post_init__(self) -> None:
        """Raise ConfigError for a scenario that cannot be simulated."""
        if self.hours < 1 or self.lines < 2 or self.shots_per_line < 2:
            raise ConfigError("a simulated station needs at least 1 hour, 2 lines and 2 shots per line")
        longest_s = self.interval_s * MAX_SCAN_SHARE
        if not 0 < self.scan_s <= longest_s:
            raise ConfigError(
                f"scan_s must be above 0 and at most {longest_s:g}, to end before the next scan"
            )
        if self.start.tzinfo is None:
            raise ConfigError("start has no time zone: use datetime(..., tzinfo=UTC)")
        if not 0 <= self.airborne_share <= 1 or not 0 <= self.airborne_clouds <= 1:
            raise ConfigError("airborne_share and airborne_clouds are shares: use values from 0 to 1")
        if self.line_jitter_freedom and self.line_jitter_freedom <= 2:
            raise ConfigError("line_jitter_freedom must be above 2, or 0 for a normal distribution")
        if self.wavelength_nm not in SCANNER_MODELS:
            raise ConfigError(f"wavelength_nm must be one of {', '.join(map(str, SCANNER_MODELS))}")

    def without_errors(self) -> Scenario:
        """Return the same station with every error and every change switched off."""
        return replace(self, **{name: type(getattr(self, name))() for name in ERRORS})

    @property
    def map_crs(self) -> str | None:
        """The map of the station; None if it is local, east-north-up at the mark."""
        return None if self.kind == "rockfall" else self.mark.crs

    @property
    def scans(self) -> int:
        """Number of scans."""
        return max(1, round(self.hours * 3600 / self.interval_s))

    @property
    def start_utc_s(self) -> float:
        """Start of the first scan [s since 1970]."""
        return self.start.timestamp()

    @property
    def beam_sigma_rad(self) -> float:
        """Scatter of the echo's true direction in each angle: a quarter of the full 1/e² width."""
        return self.beam_divergence_mrad * 1e-3 / 4

    def scan_start_s(self, scan: int) -> float:
        """Return the start of one scan [s since the start of the first]."""
        return self.interval_s * scan

    def scan_start_utc_s(self, scan: int) -> float:
        """Return the start of one scan [s since 1970]."""
        start_s = self.scan_start_s(scan)
        later = 0 < 3600 * self.season_hour <= start_s
        return self.start_utc_s + start_s + later * SEASON_S

    def hours_at(self, scan: int) -> float:
        """Return the middle of one scan in hours since the series began; the ground is fixed at that time."""
        return scan * self.interval_s / 3600 + self.scan_s / 7200

    @property
    def azimuth_rad(self) -> tuple[float, float]:
        """First and last azimuth of the head."""
        return math.radians(self.azimuth_deg[0]), math.radians(self.azimuth_deg[1])


def demo(hours: int = 24, seed: int = 1) -> Scenario:
    """Return a day of hourly scans with every error, melt on the tongue and an avalanche in hour 15."""
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


DAILY_TILT = {"tilt_daily_deg": 0.005, "tilt_walk_deg": 0.003}
ROUGH = {"rough_rock_m": 7.0, "terrain_step_m": 2.0, **DAILY_TILT}


def named(name: str, hours: int = 24, seed: int = 1) -> Scenario:
    """Return the demo's valley with all usual errors and one special condition.

    Events set in after the scans of the reference; terrain, air, motion and breathing rock are there from the
    start. Raises ConfigError if the name is not in NAMES.
    """
    reference_scans = min(8, max(1, hours // 3))
    after = float(reference_scans)
    base = replace(demo(hours, seed), melt_m_per_h=0.0, avalanche_m=0.0)
    later_hours = max(1.0, hours - after)
    snow = {"snowfall_m": 0.4, "snow_hours": (hours / 2, float(hours))}
    overrides: dict[str, dict[str, Any]] = {
        "quiet": {},
        "drift": {
            "tilt_drift_deg": 2 * base.tilt_drift_deg,
            "tilt_within_scan_deg": 1.5 * base.tilt_within_scan_deg,
            "tilt_jerk_deg": 0.002,
        },
        "wind": {"wind_sway_deg": 0.002, "mirror_wobble_deg": 0.0005},
        "snowfall": snow,
        "melt": {"melt_m_per_h": 0.005, "melt_from_hour": after},
        "avalanche": {"avalanche_m": 2.0, "avalanche_hour": 2 * hours / 3, "avalanche_size": 0.11},
        "poor": {"stable_ground": "poor"},
        "fog": {"fog_visibility_m": 1500.0, "fog_hours": (hours / 3, 2 * hours / 3)},
        "moved": {"moved_hour": (hours + 1) // 2 - 0.5, "moved_deg": 0.02, "moved_m": 0.005},
        "rough": ROUGH,
        "rough-poor": {**ROUGH, "stable_ground": "poor"},
        "airborne": {"airborne_share": 0.001},
        "airborne-heavy": {"airborne_share": 0.01, "airborne_clouds": 0.3},
        "snow-db": {**snow, "brightness": "decibel"},
        "snow-1550": {
            **snow,
            "brightness": "reflectance",
            "wavelength_nm": 1550,
            "beam_divergence_mrad": 0.15,
            "range_max_m": 4000.0,
        },
        "snow-no-brightness": {**snow, "brightness": "none"},
        "ice-refraction": {"refraction_ice_sigma": 0.1},
        "settling": {
            "settling_m_per_h": 0.05 / later_hours,
            "settling_from_hour": after,
            "stable_ground": "poor",
        },
        "melt-height": {
            "melt_m_per_h": 0.05 / later_hours,
            "melt_from_hour": after,
            "stable_ground": "poor",
        },
        "winter": {"winter_m": 2.0, "season_hour": after, "season_deg": 0.05},
        "summer": {"summer_melt_m": 3.0, "season_hour": after, "season_deg": 0.05},
        "disturbed": {
            **DAILY_TILT,
            "tilt_jerk_deg": 0.002,
            "wind_sway_deg": 0.002,
            "mirror_wobble_deg": 0.0005,
            "line_jitter_freedom": 3.0,
            "refraction_patch_sigma": 0.05,
        },
        **{
            f"log-{fault}": {"log_fault": fault, "log_fault_hour": hours / 2}
            for fault in ("cut", "missing", "time", "swapped")
        },
        "breathing": {"heave_m": 0.003, "creep_m": 0.02},
    }
    if name not in overrides:
        raise ConfigError(f"unknown scenario {name}: choose from {', '.join(NAMES)}")
    return replace(base, **overrides[name])


def full_resolution(scenario: Scenario) -> Scenario:
    """Return the same on the whole valley, at the real scanner's resolution: 1.4 million echoes per scan."""
    full = Scenario()
    return replace(
        scenario,
        terrain_step_m=full.terrain_step_m,
        roughness_length_m=full.roughness_length_m,
        cell_m=full.cell_m,
        extent_m=full.extent_m,
        azimuth_deg=full.azimuth_deg,
        lines=full.lines,
        shots_per_line=full.shots_per_line,
    )


def small(hours: int = 3, seed: int = 1) -> Scenario:
    """Return a valley a fifth as large with few points, for tests."""
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
