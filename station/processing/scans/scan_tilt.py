"""The tilt of a scan, from its inclination log and that of the scan of its SOP."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from station.archive.tilt_offsets import read_tilt_offset, stored_tilt_offsets, write_tilt_offset
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.processing.scanner_pose import sop_identity
from station.processing.scans.open_scans import PositionScan, open_files
from station.processing.scans.scan_files import find_in_inbox
from station.quantities import AzimuthTrack, Floats, InclinationLog
from station.readers.inclination import align_gps_week, read_inclination
from station.readers.scan import ScanReader
from station.scan_names import scan_stem
from station.science.geometry import inclination
from station.science.geometry.cyclic_error import (
    NO_CYCLIC_ERROR,
    OFFSET_PRIOR_S,
    CyclicError,
    fit_cyclic_error,
)
from station.science.geometry.inclination import TiltRecord
from station.sections.inputs import SopSection

MIN_LOG_COVERAGE = 0.97  # of the scan duration that a complete log covers
MIN_LOG_ROWS = 20  # a shorter log is not filtered
MIN_ABSOLUTE_LOG_S = 60.0  # of a scan whose static tilt is known from its log alone
MAX_SATURATED = 0.1  # of the rows of a log, at the limit of the sensor's range
# Clock offset of a log, and its significance, that lead to a warning: more than clocks usually differ by.
MIN_CLOCK_OFFSET_S = 2 * OFFSET_PRIOR_S
MIN_CLOCK_OFFSET_SIGMAS = 3.0


def log_of_scan(
    site: Site,
    paths: Sequence[Path],
    reader: ScanReader,
    track: AzimuthTrack | None,
    rotation: Floats,
    warnings: list[str],
) -> InclinationLog | None:
    """Return the cleaned inclination log of a scan, or None; append what is wrong with it to `warnings`.

    `rotation` (3, 3) of the SOP contains the tilt of the mount, which shows whether the axes are right.
    """
    if site.inclination is None:
        return None
    try:
        raw = _raw_log(site, paths, reader)
        if raw is None:
            if site.inclination.required:
                warnings.append("inclination log missing")
            return None
        log = _clean_log(site, raw, rotation, warnings)
    except ScanError as error:
        warnings.append(f"inclination log unusable: {error}")
        return None
    if log is None:
        return None
    if track is None:
        return log
    log = align_gps_week(log, float(track.time_s[0]))
    return log if _overlaps(site, log, track, warnings) else None


def static_tilt_faults(site: Site, log: InclinationLog | None) -> tuple[str, ...]:
    """Return a message if the tilt of the mount itself is unknown: an absolute log is its only source."""
    if log is not None or site.inclination is None or site.inclination.mode == "relative":
        return ()
    message = (
        'tilt of the scanner unknown: with inclination.mode = "absolute" the SOP does not contain it, and'
        " there is no inclination log of at least a minute of the scan"
    )
    return (message,)


def sop_tilt_offset(
    site: Site,
    position: PositionScan,
    log: InclinationLog | None,
    track: AzimuthTrack | None,
    warnings: list[str],
    *,
    waiting_before: str,
    save: bool,
) -> CyclicError | None:
    """Return the tilt that the SOP of a position contains, None if it is unknown; with `save` it is kept.

    Raises NotReadyError if an earlier scan, `waiting_before`, has to define it first.
    """
    sop_id = sop_identity(position.sop)
    tilt_offset = read_tilt_offset(site, sop_id)
    if tilt_offset is not None:
        return tilt_offset
    tilt_offset = stored_tilt_offsets(site).get(sop_id)
    if tilt_offset is None:
        tilt_offset = _find_tilt_offset(site, position, log, track, warnings, waiting_before)
    # That of an absolute sensor is zero and need not be saved.
    if save and tilt_offset is not None and tilt_offset != NO_CYCLIC_ERROR:
        write_tilt_offset(site, sop_id, tilt_offset)
    return tilt_offset


def _find_tilt_offset(
    site: Site,
    position: PositionScan,
    log: InclinationLog | None,
    track: AzimuthTrack | None,
    warnings: list[str],
    waiting_before: str,
) -> CyclicError | None:
    """Return the tilt offset contained in an SOP: the tilt of the scan from which the SOP was determined.

    Without `sop.scan`, that is the scan at hand, the first one under the SOP. Raises NotReadyError if an
    earlier one, `waiting_before`, is still to be processed.
    """
    sop = position.sop
    if site.inclination is None:
        return None
    if site.inclination.mode == "absolute":
        return NO_CYCLIC_ERROR
    if (sop is None or sop.scan is None) and waiting_before:
        raise NotReadyError(
            f"waits for {waiting_before}: the first scan under an SOP defines its tilt offset"
        )
    if sop is not None and sop.scan not in {None, position.scan, scan_stem(position.scan)}:
        try:
            log, track = _load_earlier_log(site, sop)
            problem = "not found" if log is None else ""
        except ScanError as error:
            log, track, problem = None, None, f"not usable: {error}"
        if problem:
            warnings.append(f"log of {sop.scan}, the scan of the SOP, {problem}: tilt not corrected")
    if log is None:
        return None
    return _fit_tilt_offset(log, track, site.instrument.inclination_sigma_rad)


def tilt_of_scan(
    site: Site,
    log: InclinationLog | None,
    track: AzimuthTrack | None,
    tilt_offset: CyclicError | None,
    warnings: list[str],
) -> TiltRecord | None:
    """Return the tilt to apply, None if it is unknown."""
    if log is None or tilt_offset is None or site.inclination is None:
        return None
    cutoff_hz = None if site.inclination.cutoff_hz == "auto" else site.inclination.cutoff_hz
    if cutoff_hz is None and site.adjustment.method == "joint":
        cutoff_hz = inclination.JOINT_CUTOFF_HZ
    sigma_rad = site.instrument.inclination_sigma_rad
    filtered = site.inclination.filter == "blackman"
    tilt_record = inclination.relative_tilt(log, track, tilt_offset, sigma_rad, cutoff_hz, filtered=filtered)
    gap_s = float(np.ptp(tilt_record.gaps_s, axis=1).max(initial=0.0))
    if gap_s > 2 * tilt_record.correlation_time_s:
        warnings.append(f"inclination log has a gap of {gap_s:,.0f} s")
    warnings += clock_warnings(tilt_record)
    if track is None:
        return inclination.mean_tilt(tilt_record)
    return tilt_record


def clock_warnings(tilt_record: TiltRecord) -> list[str]:
    """Return a message if the clock of a log was off by more than is usual; its times are corrected."""
    offset_s, sigma_s = tilt_record.offset_s, tilt_record.offset_sigma_s
    if abs(offset_s) <= max(MIN_CLOCK_OFFSET_S, MIN_CLOCK_OFFSET_SIGMAS * sigma_s):
        return []
    return [f"clock of the inclination log {offset_s:+z.1f} s off, sigma {sigma_s:.1f} s"]


def own_tilt_offset(site: Site, log: InclinationLog | None, track: AzimuthTrack | None) -> CyclicError | None:
    """Return the tilt of the scan itself, None without a log."""
    return None if log is None else _fit_tilt_offset(log, track, site.instrument.inclination_sigma_rad)


def _raw_log(site: Site, paths: Sequence[Path], reader: ScanReader) -> InclinationLog | None:
    """Return the log of files, in order of their times, else the one that the points carry; None without."""
    paths = paths or _converted_log(site, reader)
    return inclination.joined([read_inclination(path) for path in paths]) if paths else reader.inclination()


def _converted_log(site: Site, reader: ScanReader) -> tuple[Path, ...]:
    """Return the inclination log that the command which converted a scan wrote next to it; () without."""
    if site.scans.convert is None or site.inclination is None:
        return ()
    path = reader.path.with_name(scan_stem(reader.path) + site.inclination.suffix)
    return (path,) if path.is_file() else ()


def _clean_log(
    site: Site, raw: InclinationLog, rotation: Floats, warnings: list[str]
) -> InclinationLog | None:
    """Return the valid rows of a log; None if they are too few, saturated, or of wrong axes."""
    assert site.inclination is not None  # noqa: S101 - checked by the caller
    range_rad = site.instrument.inclination_range_rad
    log, dropped = inclination.clean(raw, range_rad)
    saturated = inclination.saturated_fraction(raw, range_rad)
    if saturated > MAX_SATURATED:
        if site.inclination.required:
            warnings.append(
                f"tilt out of the inclination sensor's range of {math.degrees(range_rad):g} degree in"
                f" {saturated:.0%} of its log, which is not used"
            )
        return None
    rows = len(log.time_s)
    if rows < MIN_LOG_ROWS:
        warnings.append(f"inclination log has {rows} valid rows")
        return None
    if dropped > 0.1 * (dropped + rows):
        warnings.append(f"inclination log bad: {dropped} of {dropped + rows} rows rejected")
    if wrong := inclination.wrong_times(raw):
        warnings.append(f"inclination log has {wrong} row{'s' * (wrong > 1)} with a wrong time, left out")
    wrong_axes = inclination.axes_warnings(log, rotation)
    warnings += [f"{message}: it is not used" for message in wrong_axes]
    return None if wrong_axes else log


def _overlaps(site: Site, log: InclinationLog, track: AzimuthTrack, warnings: list[str]) -> bool:
    """Return True if a log can be used for a scan by its times; warn if it does not cover the whole scan."""
    first_s, last_s = float(track.time_s[0]), float(track.time_s[-1])
    late_s, early_s = log.time_s[0] - first_s, last_s - log.time_s[-1]
    duration_s = last_s - first_s
    if max(late_s, early_s) >= duration_s:
        side = "begins {:,.0f} s after" if late_s >= duration_s else "ends {:,.0f} s before"
        side = side.format(max(late_s, early_s) - duration_s)
        warnings.append(f"inclination log is of another time: it {side} the scan")
        return False
    overlap_s = duration_s - max(late_s, 0.0) - max(early_s, 0.0)
    if overlap_s < MIN_LOG_COVERAGE * duration_s:
        lacking = [f"begins {late_s:,.0f} s after the start"] if late_s > 0 else []
        lacking += [f"ends {early_s:,.0f} s before the end"] if early_s > 0 else []
        warnings.append(f"inclination log {' and '.join(lacking)} of the scan")
    is_absolute = site.inclination is not None and site.inclination.mode == "absolute"
    return not is_absolute or overlap_s >= min(MIN_ABSOLUTE_LOG_S, MIN_LOG_COVERAGE * duration_s)


def _load_earlier_log(site: Site, sop: SopSection) -> tuple[InclinationLog | None, AzimuthTrack | None]:
    """Return log and azimuth track of the scan of an SOP in the inbox, (None, None) if they are missing.

    `sop.scan` is its name without suffix, with or without its folders.
    """
    scan = find_in_inbox(site, sop.scan or "")
    files = [
        file
        for file in (scan.files if scan else ())
        if sop.files is None or fnmatchcase(file.name, sop.files)
    ]
    logs = list(dict.fromkeys(file.log for file in files if file.log is not None))
    if not files:
        return None, None
    with open_files(site, files) as reader:
        track, raw = reader.azimuth_track(), _raw_log(site, logs, reader)
    if raw is None:
        return None, None
    log, _ = inclination.clean(raw, site.instrument.inclination_range_rad)
    if track is not None and len(log.time_s):
        log = align_gps_week(log, float(track.time_s[0]))
    return log, track


def _fit_tilt_offset(log: InclinationLog, track: AzimuthTrack | None, sigma_rad: float) -> CyclicError:
    if track is not None:
        return fit_cyclic_error(log, track, sigma_rad)
    return CyclicError((float(log.roll_rad.mean()), 0.0, 0.0), (float(log.pitch_rad.mean()), 0.0, 0.0))
