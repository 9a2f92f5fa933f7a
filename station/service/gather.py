"""What a scan needs beside its shots: SOP, lean, air; and what was lacking."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer

from station.archive.layout import written_whole
from station.config import Site
from station.errors import ConfigError, NotReadyError, ScanError
from station.pipeline import Pose, Told
from station.quantities import UPRIGHT, Air, Habits, HeadTrack, InclinationLog, Setup, Shared
from station.readers.inclination import in_week_of, read_inclination
from station.readers.scan import ScanReader, open_scan
from station.readers.sop import read_matrix, sop_for
from station.readers.weather import air_at, read_weather
from station.science import inclination, pose, prior, shared
from station.science.air import air_correction, standard_air
from station.science.inclination import LEVEL, Cycle, Lean
from station.sections import Origin, SopSection, WeatherSection

MOST_OF_THE_SCAN = 0.97  # of its time a log covers, unless it is late or short
FEWEST_ROWS = 20  # of a log that is worth filtering
PEGGED_MOST = 0.1  # of a log, at the end of its sensor's range
LATE_S = 4.0  # of a log's clock, and so many sigmas, before it is told
LATE_SIGMAS = 3.0


@dataclass(frozen=True)
class Gathered:
    """Everything known of a scan before its shots are read."""

    setup: Setup
    pose: Pose
    unadjusted: Callable[[], Shared] | None
    told: Told | None
    lean: Lean | None
    air: Air | None
    lacking: tuple[str, ...]
    provenance: dict[str, str]

    @cached_property
    def unknown(self) -> Shared | None:
        """What all points share without an adjustment; worked out where there is none."""
        return self.unadjusted() if self.unadjusted else None


def gather(
    site: Site,
    reader: ScanReader,
    log_path: Path | None,
    start: datetime,
    end: datetime,
    *,
    keep_zero: bool = True,
    wait_for_weather: bool = False,
) -> Gathered:
    """Gather what goes with a scan; raise ScanError or ConfigError where it cannot be placed at all.

    `keep_zero`: a zero of lean found here is kept for the scans to come. `wait_for_weather`: raise
    NotReadyError where there is no weather yet.
    """
    if site.scans.frame == "map":
        position_m = _map_position(site)
        setup, unadjusted, told = setup_of(site, position_m), None, None
        if position_m is not None:  # registered by others: how well, nobody tells
            of = shared.basis(setup.grid, position_m)
            lines = prior.lines_of(of, np.eye(3), None)
            told = Told(of, lines, np.zeros((3, of.line_count)), None, weather_known=False)
            unadjusted = partial(
                prior.covariance_without_adjustment, of, lines, None, LEVEL, Habits(), weather_known=False
            )
        return Gathered(setup, Pose(None, None), unadjusted, told, None, None, (), {})
    sop = sop_for(site.sop, start)
    frame, sop_id = frame_of(site, sop), sop_identity(sop)
    lacking: list[str] = []
    track = reader.head_track() if site.scans.point_time == "auto" else None
    if track is None and site.scans.point_time == "auto":
        lacking.append("no time per point: one mean lean for the whole scan")
    log = _log(site, log_path, track, lacking)
    zero = kept_zero(site, sop_id)
    if zero is None:
        zero = _zero_lean(site, sop, reader, log, track, lacking)
        if zero is not None and keep_zero and zero != LEVEL:  # absolute: nothing that the SOP holds
            write_zero(site, sop_id, zero)
    lean = _lean(site, log, track, zero, lacking)
    air, weather_known = _air(site, start + (end - start) / 2, frame.position_m[2], lacking)
    rotation = frame.to_local[:3, :3]
    axis = (float(rotation[0, 2]), float(rotation[1, 2]), float(rotation[2, 2]))
    setup = setup_of(site, frame.position_m, axis)
    if wait_for_weather and site.weather is not None and not weather_known:
        raise NotReadyError(lacking[-1])
    of = shared.basis(setup.grid, frame.position_m, axis)
    lines = prior.lines_of(of, rotation, track)
    assumed_rad, line_log = np.zeros((3, of.line_count)), None
    if lean is not None:
        assumed_rad = prior.turn_of(lean.tilt, rotation, lines.time_s)
        if track is not None:
            line_log = prior.line_log(of, lines, lean, zero or LEVEL, rotation)
    if site.air is not None:
        setting = site.air.scanner_setting
        assumed = air if setting == "weather" else setting.air
        led = air_correction(
            air, assumed if site.air.scanner_corrects else None, site.instrument.wavelength_um
        )
        frame = frame.after(led.corrected, site.scanner.range_max_m)
    provenance = {"sop_id": sop_id, "lean_zero": json.dumps(asdict(zero)) if zero else ""}
    tilt = lean.tilt if lean is not None else None
    return Gathered(
        setup,
        Pose(frame, tilt),
        partial(
            prior.covariance_without_adjustment,
            of,
            lines,
            lean,
            zero or LEVEL,
            Habits(),
            weather_known=weather_known,
        ),
        Told(of, lines, assumed_rad, line_log, weather_known=weather_known),
        lean,
        air if weather_known else None,
        tuple(lacking),
        provenance,
    )


def setup_of(
    site: Site,
    position_m: tuple[float, float, float] | None,
    axis: tuple[float, float, float] = UPRIGHT,
) -> Setup:
    """Return what stays the same from scan to scan."""
    return Setup(
        scanner=site.instrument,
        grid=site.grid_cells,
        position_m=position_m,
        axis=axis,
        min_points=site.grid.min_points,
        published_budget=site.uncertainty.model == "voordendag2023",
        registration_sigma_m=site.uncertainty.registration_sigma_m,
        store_terms=site.uncertainty.store_terms,
    )


def sop_identity(sop: SopSection) -> str:
    """Return a name that changes with the SOP's content, and with the scan it is said to be solved from."""
    told = sop.file.read_bytes() + (f"\n{sop.scan}".encode() if sop.scan else b"")
    return f"{sop.file.stem}-{hashlib.sha256(told).hexdigest()[:8]}"


def frame_of(site: Site, sop: SopSection) -> pose.Frame:
    """Return the way from the scanner to the map under an SOP; raise ConfigError where there is none."""
    matrix = read_matrix(sop.file)
    reach_m = site.scanner.range_max_m
    if site.map.crs is None:
        return pose.frame_in_local_map(matrix)
    if site.map.pop is not None:
        return pose.frame_by_pop(matrix, read_matrix(site.map.pop), site.map.crs, reach_m)
    if site.map.origin is not None:
        return pose.frame_by_origin(matrix, _degrees(site.map.origin), site.map.crs, reach_m)
    _require_on_map(site.map.crs, matrix[:3, 3].tolist(), sop.file)
    return pose.frame_on_map(matrix, site.map.crs, reach_m)


def _degrees(origin: Origin) -> tuple[float, float, float]:
    return origin.latitude_deg, origin.longitude_deg, origin.height_m


def _require_on_map(crs: str, position_m: list[float], file: Path) -> None:
    """Refuse an SOP that leads nowhere near the map: it most likely leads to a local frame."""
    horizontal = pose.horizontal_crs(crs)
    area = CRS.from_user_input(crs).area_of_use
    to_degrees = Transformer.from_crs(horizontal, horizontal.geodetic_crs, always_xy=True)
    longitude, latitude = to_degrees.transform(position_m[0], position_m[1])
    if area is None:
        return
    inside = area.west - 1 <= longitude <= area.east + 1 and area.south - 1 <= latitude <= area.north + 1
    if not inside:
        raise ConfigError(
            f"{file}: places the scanner at easting {position_m[0]:g}, northing {position_m[1]:g}, outside"
            f" {crs} ({area.name}). If it leads to a local frame, give map.origin or map.pop, or leave"
            " map.crs out"
        )


def _map_position(site: Site) -> tuple[float, float, float] | None:
    if site.map.origin is None or site.map.crs is None:
        return None
    to_map = Transformer.from_crs(pose.GEOGRAPHIC, pose.horizontal_crs(site.map.crs), always_xy=True)
    latitude, longitude, height_m = _degrees(site.map.origin)
    east_m, north_m, up_m = to_map.transform(longitude, latitude, height_m)
    return float(east_m), float(north_m), float(up_m)


def _log(site: Site, path: Path | None, track: HeadTrack | None, lacking: list[str]) -> InclinationLog | None:
    """Return the scan's clean log, or None; what is wrong with it goes to `lacking`."""
    if site.inclination is None:
        return None
    if path is None:
        if site.inclination.required:
            lacking.append("inclination log missing")
        return None
    try:
        log = _clean(site, read_inclination(path), lacking)
    except ScanError as error:
        lacking.append(f"inclination log unusable: {error}")
        return None
    if log is None or track is None:
        return log
    log = in_week_of(log, float(track.time_s[0]))
    return log if _covers(log, track, lacking) else None


def _clean(site: Site, told: InclinationLog, lacking: list[str]) -> InclinationLog | None:
    """Return the good rows of a log, None where too few are or the sensor was out of its range."""
    assert site.inclination is not None  # noqa: S101 - the caller's case
    range_rad = site.instrument.inclination_range_rad
    log, dropped = inclination.clean(told, range_rad)
    pegged = inclination.pegged(told, range_rad)
    if pegged > PEGGED_MOST:
        if site.inclination.required:
            lacking.append(
                f"lean out of the inclination sensor's range of {math.degrees(range_rad):g} degree in"
                f" {pegged:.0%} of its log, which is not used"
            )
        return None
    rows = len(log.time_s)
    if rows < FEWEST_ROWS:
        lacking.append(f"inclination log has {rows} good rows")
        return None
    if dropped > 0.1 * (dropped + rows):
        lacking.append(f"inclination log bad: {dropped} of {dropped + rows} rows dropped")
    return log


def _covers(log: InclinationLog, track: HeadTrack, lacking: list[str]) -> bool:
    """Tell whether a log is of the scan's time at all."""
    first_s, last_s = track.time_s[0], track.time_s[-1]
    covered_s = min(last_s, log.time_s[-1]) - max(first_s, log.time_s[0])
    if covered_s <= 0:
        lacking.append(f"inclination log is of another time: {first_s - log.time_s[0]:+.0f} s off")
        return False
    if covered_s < MOST_OF_THE_SCAN * (last_s - first_s):
        lacking.append(f"inclination log covers {covered_s:.0f} of {last_s - first_s:.0f} s")
    return True


def _lean(
    site: Site,
    log: InclinationLog | None,
    track: HeadTrack | None,
    zero: Cycle | None,
    lacking: list[str],
) -> Lean | None:
    """Return the lean to apply, None where nothing says it."""
    if log is None or zero is None or site.inclination is None:
        return None
    cutoff_hz = None if site.inclination.cutoff_hz == "auto" else site.inclination.cutoff_hz
    if cutoff_hz is None and site.adjustment.method == "joint":
        cutoff_hz = inclination.GENTLE_CUTOFF_HZ
    sigma_rad = site.instrument.inclination_sigma_rad
    filtered = site.inclination.filter == "blackman"
    lean = inclination.relative_lean(log, track, zero, sigma_rad, cutoff_hz, filtered=filtered)
    if lean.gap_s > 2 * lean.memory_s:
        lacking.append(f"inclination log has a gap of {lean.gap_s:.0f} s")
    if abs(lean.offset_s) > max(LATE_S, LATE_SIGMAS * lean.offset_sigma_s):
        lacking.append(
            f"clock of the inclination log {lean.offset_s:+.1f} s off, known to {lean.offset_sigma_s:.1f} s"
        )
    if track is None:
        return inclination.without_time(lean)
    return lean


def _zero_file(site: Site, sop_id: str) -> Path:
    return site.station.data / "lean_zero" / f"{sop_id}.json"


def kept_zero(site: Site, sop_id: str) -> Cycle | None:
    """Return the lean an SOP holds, as found when it was first needed."""
    if site.inclination is None or site.inclination.mode == "absolute":
        return None
    path = _zero_file(site, sop_id)
    if not path.is_file():
        return None
    told = json.loads(path.read_text())
    return Cycle(tuple(told["roll_rad"]), tuple(told["pitch_rad"]))


def write_zero(site: Site, sop_id: str, zero: Cycle) -> None:
    """Keep the lean that an SOP holds."""
    path = _zero_file(site, sop_id)
    with written_whole(path) as beside:
        beside.write_text(json.dumps(asdict(zero)))


def _zero_lean(
    site: Site,
    sop: SopSection,
    reader: ScanReader,
    log: InclinationLog | None,
    track: HeadTrack | None,
    lacking: list[str],
) -> Cycle | None:
    """Return the lean the SOP already holds: that of the scan it was solved from.

    Without `sop.scan` it is this scan, the first processed under the SOP.
    """
    if site.inclination is None:
        return None
    if site.inclination.mode == "absolute":
        return LEVEL
    if sop.scan is not None and sop.scan != reader.path.stem:
        log, track = _log_of(site, sop.scan)
        if log is None:
            lacking.append(f"log of {sop.scan}, the scan of the SOP, not found: lean left uncorrected")
    if log is None:
        return None
    return _fit(log, track, site.instrument.inclination_sigma_rad)


def _log_of(site: Site, stem: str) -> tuple[InclinationLog | None, HeadTrack | None]:
    """Read log and head track of an earlier scan in the inbox."""
    assert site.inclination is not None  # noqa: S101 - the caller's case
    log_path = site.scans.inbox / f"{stem}{site.inclination.suffix}"
    scans = [path for path in site.scans.inbox.glob(f"{stem}.*") if path != log_path]
    if not log_path.is_file() or not scans:
        return None, None
    with open_scan(scans[0], range_max_m=site.scanner.range_max_m) as reader:
        track = reader.head_track()
    log, _ = inclination.clean(read_inclination(log_path), site.instrument.inclination_range_rad)
    return log, track


def _fit(log: InclinationLog, track: HeadTrack | None, sigma_rad: float) -> Cycle:
    if track is not None:
        return inclination.fit_cycle(log, track, sigma_rad)
    return Cycle((float(log.roll_rad.mean()), 0.0, 0.0), (float(log.pitch_rad.mean()), 0.0, 0.0))


def weather_at(given: WeatherSection, moment_s: float) -> Air | None:
    """Return the air that the weather log tells at a moment, None where it has a gap.

    Raises ScanError or NotReadyError where the log cannot be used.
    """
    log = read_weather(
        given.file,
        format=given.format,
        columns=given.columns,
        utc_offset_h=given.utc_offset_h,
        window_utc_s=(moment_s - given.max_age_s, moment_s + given.max_age_s),
    )
    return air_at(log, moment_s, given.max_age_s)


def _air(site: Site, moment: datetime, height_m: float, lacking: list[str]) -> tuple[Air, bool]:
    """Return the air of the scan and whether it was measured."""
    if site.weather is not None:
        given = site.weather
        try:
            air = weather_at(given, moment.timestamp())
        except (ScanError, NotReadyError) as error:  # a scan does not wait for ever for its weather
            lacking.append(f"weather unusable: {error}")
            air = None
        if air is not None:
            return air, True
        age = timedelta(seconds=given.max_age_s)
        lacking.append(f"weather missing within {age} of {moment:%Y-%m-%d %H:%M} UTC")
    if site.air is None or site.air.scanner_setting == "weather":
        return standard_air(height_m), False
    return site.air.scanner_setting.air, False
