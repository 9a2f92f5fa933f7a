"""`station import riscan`: a first site file, SOPs and POP from a RiSCAN PRO project."""

from __future__ import annotations

import math
import re
from pathlib import Path

from pyproj import Transformer

from station.config import SCHEMA_NAME, site_schema
from station.errors import ConfigError
from station.quantities import Floats
from station.readers.formats.riscan import Project, ScanPosition, read_project
from station.scanners import SCANNERS, missing_values, scanner_model
from station.science.geometry import pose

DEFAULT_EXTENT_M = 100.0  # of the grid, if the project does not tell how far its scans reach
CELLS = 500  # along the grid, at least
MAX_NAME = 32  # characters of a station's id
SCANS = [
    'inbox = "inbox"                       # check: where the scans arrive',
    'name = "%y%m%d_%H%M%S"                # start of the scan, in the time of the scanner\'s clock',
    'zone = "UTC"                          # check: the zone of that clock, such as "Europe/Vienna"',
]
UTM_NORTH, UTM_SOUTH = 32600, 32700  # EPSG, plus the zone


def import_riscan(
    project_path: Path, folder: Path, scans: list[str] | None = None, more: list[str] | None = None
) -> list[Path]:
    """Write site file, SOPs and POP of a project to a folder; return their paths, the site file first.

    `scans` and `more` are lines for `site_text`, of what is known besides the project. Raises ConfigError if
    the project cannot be read or a file exists: nothing is overwritten.
    """
    project = read_project(project_path)
    matrices = {f"{file_stem(position.name)}-SOP.dat": position.sop for position in project.positions}
    if len(matrices) < len(project.positions):
        raise ConfigError(f"{project_path}: two scan positions have the same name: rename one")
    if project.pop is not None:
        matrices["POP.dat"] = project.pop
    text = site_text(f"the RiSCAN project {project.name}", project, scans or SCANS, more)
    texts = {folder / "site.toml": text}
    texts |= {folder / name: matrix_text(matrix) for name, matrix in matrices.items()}
    return write_new(folder, texts)


def write_new(folder: Path, texts: dict[Path, str]) -> list[Path]:
    """Write files and the schema of the site file to a folder; raise ConfigError if one exists."""
    existing = [path for path in texts if path.exists()]
    if existing:
        raise ConfigError(f"{existing[0]}: already exists; nothing is overwritten")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / SCHEMA_NAME).write_text(site_schema(), encoding="utf-8")
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from error
    return list(texts)


def file_stem(name: str) -> str:
    """Return a name that can be part of a file name."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name) or "position"


def matrix_text(matrix: Floats) -> str:
    """Return a matrix as four rows of numbers."""
    return "\n".join(" ".join(f"{value:.15g}" for value in row) for row in matrix) + "\n"


def site_text(
    source: str, project: Project, scans: list[str], more: list[str] | None = None, *, has_sop: bool = True
) -> str:
    """Return a site file; `scans` are the lines of its table, `more` those of tables after the others.

    Without SOPs, those of the project are not written, and the map is around its scanner.
    What the project cannot tell is marked with `check:`.
    """
    ident = file_stem(project.name)[:MAX_NAME].strip("_-") or "station"
    return "\n".join(
        [
            f"#:schema ./{SCHEMA_NAME}",
            f"# From {source}. Mind the lines with `check:`; then station check.",
            "",
            "[station]",
            f'id = "{ident}"',
            'data = "data"',
            "",
            "[scans]",
            *scans,
            "",
            *_scanner_lines(project),
            *(_sop_lines(project) if has_sop else []),
            *_map_lines(project, has_sop=has_sop),
            *_air_lines(project),
            *(more or []),
        ]
    )


def _scanner_lines(project: Project) -> list[str]:
    name = next((position.instrument for position in project.positions if position.instrument), "")
    model = scanner_model(name) if project.positions else "riegl-vz-6000"
    lines = ["[scanner]", f'model = "{model or name or "unknown"}"              # check']
    missing = missing_values(model or "")
    if missing:
        lines += ["# check: of its data sheet; these are the values of a VZ-400i"]
    return [*lines, *(f"{key} = {SCANNERS['riegl-vz-400i'][key]:g}" for key in missing), ""]


def _sop_lines(project: Project) -> list[str]:
    """Return the SOPs by the start of their first scans; those without a date begin in 2000."""
    lines, starts = [], set()
    for position in project.positions:
        start = f"{position.start_utc:%Y-%m-%dT%H:%M:%SZ}" if position.start_utc else "2000-01-01T00:00:00Z"
        mark = "# " if start in starts and not position.files else ""  # two must not begin together
        starts.add(start)
        lines += [
            f"{mark}[[sop]]{'' if position.start_utc else '   # check: from when it holds'}",
            f"{mark}from = {start}",
            f'{mark}file = "{file_stem(position.name)}-SOP.dat"',
        ]
        lines += [f'{mark}scan = "{position.first_scan}"'] if position.first_scan else []
        lines += [f'files = "{position.files}"'] if position.files else []
        lines += [""]
    return lines


def _map_lines(project: Project, *, has_sop: bool) -> list[str]:
    """Return map and grid: around the scanner of the newest position, if any, as far as its scans reach."""
    if not project.positions:
        return []
    dated = [position for position in project.positions if position.start_utc]
    position = dated[-1] if dated else project.positions[0]  # the SOP that is valid now
    east_m, north_m = (float(value) for value in position.sop[:2, 3])
    frame = "POP: the map is the frame of the SOP" if has_sop else "SOP: the map is local, around the scanner"
    lines = [f"# check: there is no {frame}, see docs/how-to/sop.md"]
    if project.pop is not None:
        crs, east_m, north_m = _utm_position(project.pop, position)
        crs_line = f'crs = "{crs}"                    # check: or the CRS of your maps'
        lines = ["[map]", crs_line, 'pop = "POP.dat"']
    half_m = position.extent_m or DEFAULT_EXTENT_M
    power = 10.0 ** math.floor(math.log10(2 * half_m / CELLS))
    cell_m = max(next(power * step for step in (5, 2, 1) if power * step * CELLS <= 2 * half_m), 0.01)
    edge_m = CELLS / 2 * cell_m * math.ceil(half_m / (CELLS / 2 * cell_m))
    west_m, south_m = (round((value - edge_m) / cell_m) * cell_m for value in (east_m, north_m))
    bounds = {"west": west_m, "south": south_m, "east": west_m + 2 * edge_m, "north": south_m + 2 * edge_m}
    pairs = ", ".join(f"{key} = {value:.2f}" for key, value in bounds.items())
    return [
        *lines,
        "",
        "[grid]                                # check: the part that you want, and its resolution",
        f"bounds_m = {{ {pairs} }}",
        f"cell_m = {cell_m:g}",
        "",
    ]


def _utm_position(pop: Floats, position: ScanPosition) -> tuple[str, float, float]:
    """Return the UTM zone in which a scanner stands, and its easting and northing [m]."""
    geocentric_m = (pop @ position.sop)[:3, 3].tolist()
    to_degrees = Transformer.from_crs(pose.GEOCENTRIC, pose.GEOGRAPHIC, always_xy=True)
    longitude, latitude, _ = to_degrees.transform(*geocentric_m)
    zone = int((longitude + 180.0) // 6.0) % 60 + 1
    crs = f"EPSG:{(UTM_NORTH if latitude >= 0 else UTM_SOUTH) + zone}"
    east_m, north_m, _ = Transformer.from_crs(pose.GEOCENTRIC, crs, always_xy=True).transform(*geocentric_m)
    return crs, float(east_m), float(north_m)


def _air_lines(project: Project) -> list[str]:
    air = next((position.air for position in project.positions if position.air), None)
    if air is None:
        return []
    values = {
        "temperature_c": air.temperature_c,
        "pressure_hpa": air.pressure_hpa,
        "humidity_pct": air.humidity_pct,
    }
    pairs = ", ".join(f"{key} = {value:.1f}" for key, value in values.items())
    return [
        "[air]",
        f"scanner_setting = {{ {pairs} }}",
        "scanner_corrects = true               # check: the scanner applied the atmosphere above",
        "",
    ]
