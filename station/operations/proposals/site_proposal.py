"""`station init --from FOLDER`: a first site file from the scans, logs and matrices that lie in a folder."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj.exceptions import CRSError

from station.errors import ConfigError, StationError
from station.inbox.listing import is_scan
from station.operations.inbox_contents import CONVERTED, MANUAL, epoch_advice, files_below, fitting_pattern
from station.operations.proposals.weather_proposal import weather_lines
from station.operations.riscan_import import file_stem, import_riscan, matrix_text, site_text, write_new
from station.processing.workers import isolation
from station.quantities import Floats
from station.readers.formats.conversion import open_site_scan
from station.readers.formats.riscan import Project, ScanPosition
from station.readers.scan import ScanHeader, suffixes
from station.readers.sop import read_matrix
from station.readers.weather_dialects import recognise_dialect
from station.scan_names import scan_stem, start_in_name
from station.scanners import SCANNERS, missing_values
from station.science.geometry.pose import horizontal_crs
from station.sections.inputs import ScansSection

LOG_SUFFIX = "-incl.txt"
MATRIX_SUFFIXES = (".dat", ".txt", ".sop")
SOP_WORD = re.compile(r"[-_ ]*sop$", re.IGNORECASE)  # at the end of names
MAX_MATRIX_BYTES = 1 << 14
GEOCENTRIC_M = 6e6  # a POP leads to the centre of the Earth
MAX_SCANNER_FRAME_M = 20_000.0  # farther from the origin, points are on a map
MEMORY_GB, TIMEOUT_S = 4.0, 300.0  # to look at one scan


@dataclass(frozen=True)
class _Found:
    """What lies in a folder."""

    scan: Path | None  # the newest; None if there is none
    names: list[str]  # of all scans, with their folders
    pattern: str  # of the names, "" if none of the usual ones fits
    epoch: str  # name of epochs, if several scans have the same start; else ""
    has_logs: bool
    sops: list[Path]
    registration: str  # suffix of matrices beside most of the scans, with their names; "" without
    pop: Path | None
    weather: tuple[Path, str] | None  # and its dialect
    polygons: Path | None

    @property
    def is_converted(self) -> bool:
        """True if a command must convert the scans."""
        return self.scan is not None and self.scan.suffix.lower() in CONVERTED


def propose_site(source: Path, folder: Path) -> list[Path]:
    """Write a site file for what lies in `source` to a folder; return the files written, it first.

    Without an SOP the map is local: its origin is the scanner, and the inclination log makes it level. Raises
    ConfigError if there is no scan, the newest cannot be read, or a file exists already.
    """
    found = _look_into(source)
    projects = [path for path in files_below(source) if path.suffix.lower() == ".rsp"]
    if projects:
        scans = None if found.scan is None else _scan_lines(source, found, "scanner")
        return import_riscan(projects[0], folder, scans, _more_lines(found, None, mode="relative"))
    if found.scan is None:
        raise ConfigError(f"{source}: no scan lies in it, nor in its folders: see {MANUAL}")
    header = None if found.is_converted else _read_header(found.scan)
    on_map = header is not None and float(np.abs(_horizontal_m(header)).min()) > MAX_SCANNER_FRAME_M
    texts: dict[Path, str] = {}
    if on_map and header is not None:
        project = Project(source.resolve().name, None, ())
        more = [*_map_frame_lines(header), *_more_lines(found, header, mode="relative")]
    else:
        project = _project(source.resolve().name, found, header)
        if found.sops:
            texts |= {
                folder / f"{file_stem(position.name)}-SOP.dat": matrix_text(position.sop)
                for position in project.positions
            }
        if project.pop is not None:
            texts[folder / "POP.dat"] = matrix_text(project.pop)
        more = _more_lines(found, header, mode="relative" if found.sops else "absolute")
    scans, has_sop = _scan_lines(source, found, "map" if on_map else "scanner"), on_map or bool(found.sops)
    site = site_text(f"what lies in {source}", project, scans, more, has_sop=has_sop)
    return write_new(folder, {folder / "site.toml": site, **texts})


def _read_header(scan: Path) -> ScanHeader:
    """Return the header of a scan, read in a worker process; raise ConfigError if that is impossible."""
    try:
        return isolation.TaskRunner().run(_header, scan, memory_gb=MEMORY_GB, timeout_s=TIMEOUT_S)
    except StationError as error:
        raise ConfigError(f"{scan}: cannot be read: {error}") from error


def _header(path: Path, _progress: object) -> ScanHeader:
    """Return the header of a scan; runs in a worker process."""
    scans = ScansSection(inbox=path.parent)
    with open_site_scan(path, scans, range_max_m=None, work_folder=path.parent) as reader:
        return reader.header


def _horizontal_m(header: ScanHeader) -> Floats:
    """Return the corners (2, 2) of a scan on the plane [m]."""
    return np.array([header.low_m[:2], header.high_m[:2]])


def _look_into(source: Path) -> _Found:
    files = list(files_below(source))
    scans = [path for path in files if is_scan(path.name, suffixes())]
    scans = scans or [path for path in files if is_scan(path.name, tuple(CONVERTED))]
    depth = min((len(path.relative_to(source).parts) for path in scans), default=0)
    scans = [path for path in scans if len(path.relative_to(source).parts) == depth]
    common = next(iter(Counter(path.suffix.lower() for path in scans).most_common(1)), ("", 0))[0]
    names = {path.relative_to(source).as_posix(): path for path in scans if path.suffix.lower() == common}
    pattern = (fitting_pattern(list(names)) if names else None) or ""
    newest = max(
        names, key=lambda name: (start_in_name(name, pattern) or 0) if pattern else name, default=None
    )
    matrices = {
        path: matrix
        for path in files
        if path.suffix.lower() in MATRIX_SUFFIXES and (matrix := _matrix(path)) is not None
    }
    beside = {path.with_name(scan_stem(path.name)) for path in names.values()}
    suffix = Counter(path.suffix for path in matrices if path.with_suffix("") in beside).most_common(1)
    registration = suffix[0][0] if suffix and 2 * suffix[0][1] > len(beside) > 1 else ""
    pops = [path for path, matrix in matrices.items() if np.linalg.norm(matrix[:3, 3]) > GEOCENTRIC_M]
    sops = [path for path in matrices if path not in pops]
    return _Found(
        scan=None if newest is None else names[newest],
        names=list(names),
        pattern=pattern,
        epoch=epoch_advice(list(names), pattern)[1] if pattern else "",
        has_logs=any(path.name.endswith(LOG_SUFFIX) for path in files),
        sops=sops[-1:] if registration else sops,
        registration=registration,
        pop=pops[-1] if pops else None,
        weather=next(((path, kind) for path in files if (kind := _dialect(path))), None),
        polygons=next((path for path in files if path.suffix.lower() in {".geojson", ".gpkg", ".shp"}), None),
    )


def _matrix(path: Path) -> Floats | None:
    if path.name.endswith(LOG_SUFFIX) or path.stat().st_size > MAX_MATRIX_BYTES:
        return None
    try:
        return read_matrix(path)
    except ConfigError:
        return None


def _dialect(path: Path) -> str:
    """Return the dialect of a weather log by its header, '' if it is none."""
    if path.suffix.lower() not in {".dat", ".csv", ".txt", ".smet"} or not os.access(path, os.R_OK):
        return ""
    if path.name.endswith(LOG_SUFFIX):
        return ""
    with path.open("rb") as file:
        return recognise_dialect(file)


def _scan_lines(source: Path, found: _Found, frame: str) -> list[str]:
    """Return the lines of the table [scans]."""
    assert found.scan is not None  # noqa: S101 - checked by the callers
    lines = [f"inbox = {_quoted(source.resolve())}"]
    if found.pattern:
        lines += [f"name = {_quoted(found.pattern)}", 'zone = "UTC"   # check: of the times in names']
    else:
        lines += [f'name = "%y%m%d_%H%M%S"   # check: names such as {found.scan.name} do not match it']
    if found.is_converted:
        suffix = found.scan.suffix.lower()
        lines += [f'suffix = "{suffix}"', f"convert = {json.dumps(CONVERTED[suffix])}   # check"]
    return [*lines, f'frame = "{frame}"']


def _quoted(value: str | Path) -> str:
    """Return a text as TOML has it."""
    return json.dumps(str(value), ensure_ascii=False)


def _project(name: str, found: _Found, header: ScanHeader | None) -> Project:
    """Return a project of the SOPs, the newest by its name first unless they are of positions."""
    extent_m = 0.0 if header is None else float(np.abs(_horizontal_m(header)).max())
    patterns = _patterns_of_positions(found)
    paths = found.sops if patterns else found.sops[::-1]
    names = [SOP_WORD.sub("", path.stem) or "SOP" for path in paths] or ["SOP"]
    if len({file_stem(sop) for sop in names}) < len(names):
        names = [f"SOP{number}" for number in range(1, len(names) + 1)]
    matrices = [read_matrix(path) for path in paths] or [np.eye(4)]
    positions = tuple(
        ScanPosition(sop, matrix, _model_for(extent_m), None, "", None, extent_m, pattern)
        for sop, matrix, pattern in zip(names, matrices, patterns or [""] * len(names), strict=True)
    )
    return Project(name, read_matrix(found.pop) if found.pop and found.sops else None, positions)


def _patterns_of_positions(found: _Found) -> list[str]:
    """Return the pattern of the scans of each SOP.

    Empty unless an epoch has several files, of which each has the name of one SOP in its own.
    """
    stems = [SOP_WORD.sub("", path.stem) for path in found.sops]
    are_positions = found.epoch and all(sum(stem in name for stem in stems) == 1 for name in found.names)
    return [f"*{stem}*" for stem in stems] if are_positions else []


def _model_for(range_m: float) -> str:
    """Return the RIEGL VZ that reaches no farther than it must: a file does not tell which scanner it is."""
    reaching = [
        name
        for name, values in SCANNERS.items()
        if range_m
        and name.startswith("riegl-vz-")
        and not missing_values(name)
        and values["range_max_m"] >= range_m
    ]
    return min(reaching, key=lambda name: SCANNERS[name]["range_max_m"], default="riegl-vz-6000")


def _map_frame_lines(header: ScanHeader) -> list[str]:
    """Return map and grid of scans that are on a map already."""
    (west_m, south_m, _), (east_m, north_m, _) = header.low_m, header.high_m
    edges = [np.floor(west_m), np.floor(south_m), np.ceil(east_m), np.ceil(north_m)]
    pairs = ", ".join(
        f"{key} = {value:.0f}" for key, value in zip(("west", "south", "east", "north"), edges, strict=True)
    )
    return [
        "[map]",
        f'crs = "{_code(header)}"   # check',
        "# origin = { latitude_deg = …, longitude_deg = …, height_m = … }   # check: of the scanner",
        "",
        "[grid]   # check: the part that you want, and its resolution",
        f"bounds_m = {{ {pairs} }}",
        "cell_m = 1.0",
        "",
    ]


def _code(header: ScanHeader) -> str:
    """Return the EPSG code of the map that a scan declares, else one that `station check` refuses."""
    try:
        code = horizontal_crs(header.crs_wkt).to_epsg() if header.crs_wkt else None
    except CRSError:
        code = None
    return f"EPSG:{code or '…'}"


def _more_lines(found: _Found, header: ScanHeader | None, *, mode: str) -> list[str]:
    """Return the lines of all tables that a project does not tell; `header` is that of a scan, if known."""
    lines: list[str] = []
    from_rxp = found.scan is not None and found.scan.suffix.lower() == ".rxp"
    in_points = from_rxp if header is None else header.has_inclination
    if found.epoch:
        positions = len(_patterns_of_positions(found))
        note = "# check: files with the same start; scan positions need an [[sop]] each, with files"
        lines += ["[epoch]" if positions else f"[epoch]   {note}", f'name = "{found.epoch}"']
        lines += [f"files = {positions}   # check", ""] if positions else [""]
    if found.registration:
        suffix = f'suffix = "{found.registration}"'
        lines += ["[registration]   # check: matrices beside the scans", suffix, 'into = "project"']
        lines += ["sigma_m = 0.005   # check", "sigma_deg = 0.001   # check", ""]
    if found.has_logs or in_points:
        note = "   # check: without an SOP, the log makes the map level" if mode == "absolute" else ""
        source = (
            f'suffix = "{LOG_SUFFIX}"' if found.has_logs else "wait_s = 0   # the points carry roll and pitch"
        )
        lines += ["[inclination]", source, f'mode = "{mode}"{note}', ""]
    if found.weather is not None:
        lines += [*weather_lines(*found.weather), ""]
    if found.polygons is not None:
        lines += ["[areas]", f"file = {_quoted(found.polygons.resolve())}", ""]
    return lines
