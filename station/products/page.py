"""The station's page: static files, each replaced as a whole, that work from a folder and from any server."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from station import __version__
from station.archive.layout import Series
from station.archive.store import Named
from station.products.gallery import Gallery, Measured, Style, hang, put, thinned
from station.products.look import Look
from station.products.maps import ASSETS
from station.products.record import AreaRecord, Record, read_areas, read_record
from station.quantities import Floats
from station.science.change import SIGNIFICANT_SIGMAS

STATIC = {  # what each is made of; one style sheet is one round trip
    "page.css": ("uplot.css", "page.css"),
    "page.js": ("page.js",),
    "uplot.js": ("uplot.js",),
    "icon.svg": ("icon.svg",),
}
POINTS = 250  # of a curve; of a longer series every nth, up to the newest
MOST_AREAS = 8  # with a curve, so that the page stays light
TABLE_ROWS = 24
LISTED = 20  # of what waits or is set aside
HONEST = (0.8, 1.25)  # of the spread of change over sigma on ground that does not move
RECENT = 24  # scans by which that is judged


@dataclass(frozen=True)
class Told:
    """What the service says, which is not in the archive."""

    name: str
    institution: str
    written_s: float  # now
    expected_every_s: float
    waiting: list[dict[str, Any]]  # scan, for
    set_aside: list[dict[str, Any]]  # scan, reason, since
    faults: list[str]
    seconds: dict[str, float]  # that a scan took, by its id
    looks: dict[str, Look] = field(default_factory=dict)  # that need not be read, by the file of the epoch


def write_page(
    series: Series,
    folder: Path,
    told: Told,
    width_px: int,
    limit_m: float | None,
    progress: Callable[[], None],
) -> None:
    """Bring the page in `folder` up to what is stored; raise StoreError where that cannot be.

    Maps come first, then the data, then the page that names them.
    """
    record = read_record(series) if series.path.is_file() else None
    all_areas = read_areas(series)
    areas = all_areas[:MOST_AREAS]
    if record is not None:
        areas = [_without_unusable(area, record) for area in areas]
    gallery = Gallery([], None, None, None, (0, 0))
    if record is not None:
        style = Style(told.name or series.station_id, width_px, limit_m)
        gallery = hang(series, folder, _measured(series, record, told.looks), style, progress)
    for name, parts in STATIC.items():
        put(folder / name, b"".join((ASSETS / part).read_bytes() for part in parts))
    data = {
        "written_s": told.written_s,
        "expected_every_s": told.expected_every_s,
        "station": series.station_id,
        "maps": [{"time_s": one.start.timestamp(), "file": one.file} for one in gallery.change],
        "area_time_s": _numbers(areas[0].start_s[_picked(len(areas[0].start_s))], 0) if areas else [],
        "areas": [_area(area) for area in areas],
        "health": _health(record, told) if record is not None else None,
    }
    _script(folder / "data.js", "STATION", data)
    _script(folder / "written.js", "STATION_WRITTEN_S", told.written_s)
    put(folder / "index.html", _rendered(series, told, record, areas, gallery, len(all_areas)).encode())


def _script(path: Path, name: str, value: object) -> None:
    """Write data as a script: a page opened from a folder may load no other kind."""
    body = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    put(path, f"window.{name}={body};\n".encode("ascii"))


def _measured(series: Series, record: Record, looks: dict[str, Look]) -> list[Measured]:
    """Return the epochs that have a reference: the first, and those of which there is a map."""
    rows = Named(series)
    versions, reasons = record.words["reference_version"], record.words["verdict_reason"]
    told = [at for at, version in enumerate(versions) if version]
    if not told:
        return []
    kept = {0, *thinned(record.start_s[told])}
    return [
        Measured(
            rows,
            at,
            datetime.fromtimestamp(float(record.start_s[at]), UTC),
            versions[at],
            "" if record.verdict[at] == "good" else f"{record.verdict[at]}: {reasons[at]}",
            looks.get(record.words["epoch_file"][at]),
        )
        for at in (told[index] for index in sorted(kept))
    ]


def _picked(count: int) -> slice:
    """Return every nth of so many, the newest among them, so that no more than POINTS are left."""
    step = max(1, math.ceil(count / POINTS))
    return slice((count - 1) % step if count else 0, None, step)


def _numbers(values: Floats, digits: int) -> list[float | None]:
    told = (round(float(one), digits) if np.isfinite(one) else None for one in values)
    return [int(one) if one is not None and not digits else one for one in told]


def _without_unusable(area: AreaRecord, record: Record) -> AreaRecord:
    """Return an area's series with gaps where neither change nor sigma can be relied on."""
    bad = record.start_s[[verdict == "unusable" for verdict in record.verdict]]
    gaps = np.isin(area.start_s, bad)
    return replace(area, columns={name: np.where(gaps, np.nan, one) for name, one in area.columns.items()})


def _area(area: AreaRecord) -> dict[str, Any]:
    few = _picked(len(area.start_s))
    return {
        "name": area.name,
        "mean_m": _numbers(area.columns["mean_change"][few], 4),
        "sigma_m": _numbers(area.columns["mean_change_uncertainty"][few], 5),
    }


def _health(record: Record, told: Told) -> dict[str, Any]:
    few = _picked(len(record))
    digits = {"platform_roll": 4, "platform_pitch": 4, "air_temperature": 1, "air_pressure": 1}
    digits |= {"stable_median": 4, "stable_nmad": 4, "stable_z_std": 2}
    shown = record.words["scan_id"][few]
    seconds = np.array([told.seconds.get(one, np.nan) for one in shown], dtype=np.float64)
    return {
        "time_s": _numbers(record.start_s[few], 0),
        **{name: _numbers(record.numbers[name][few], places) for name, places in digits.items()},
        "seconds": _numbers(seconds, 1),
    }


def _rendered(
    series: Series,
    told: Told,
    record: Record | None,
    areas: list[AreaRecord],
    gallery: Gallery,
    area_count: int,
) -> str:
    recent = range(max(0, len(record) - TABLE_ROWS), len(record))[::-1] if record is not None else []
    return PAGE.render(
        id=series.station_id,
        told=told,
        version=__version__,
        gallery=gallery,
        scans=[_scan(record, told, index) for index in recent] if record is not None else [],
        areas=[_latest(area) for area in areas],
        honesty=_honesty(record),
        waiting=told.waiting[:LISTED],
        set_aside=told.set_aside[-LISTED:][::-1],
        listed=LISTED,
        areas_left_out=area_count - len(areas),
    )


def _scan(record: Record, told: Told, index: int) -> dict[str, Any]:
    """One row of the table of scans."""
    scan_id = record.words["scan_id"][index]
    return {
        "id": scan_id,
        "time_s": float(record.start_s[index]),
        "verdict": record.verdict[index],
        "reason": record.words["verdict_reason"][index],
        "seconds": told.seconds.get(scan_id, math.nan),
        **{name: float(column[index]) for name, column in record.numbers.items()},
    }


def _latest(area: AreaRecord) -> dict[str, Any] | None:
    """One row of the table of areas: its newest values."""
    mean_m, sigma_m = (area.columns[key] for key in ("mean_change", "mean_change_uncertainty"))
    known = np.flatnonzero(np.isfinite(mean_m))
    told: dict[str, Any] = {"name": area.name, "size_m2": area.size_m2, "time_s": None}
    if len(known):
        at = known[-1]
        told |= {key: float(column[at]) for key, column in area.columns.items()}
        told |= {"time_s": float(area.start_s[at]), "half95": SIGNIFICANT_SIGMAS * float(sigma_m[at])}
    return told


def _honesty(record: Record | None) -> dict[str, Any] | None:
    """Judge the stated sigma by ground that does not move and no fit has seen; None where there is none."""
    if record is None:
        return None
    z = record.numbers["stable_z_std"]
    z = z[np.isfinite(z)][-RECENT:]
    if not len(z):
        return None
    middle = float(np.median(z))
    low, high = HONEST
    word = "honest" if low <= middle <= high else "too wide" if middle < low else "too narrow"
    return {"z": middle, "word": word, "scans": len(z), "low": low, "high": high}


def _number(value: float | None, digits: int, sign: bool = False) -> str:  # noqa: FBT001, FBT002 - a filter
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:{'+' if sign else ''},.{digits}f}".replace("-", "−").replace(",", "\u202f")


def _utc(moment_s: float) -> str:
    return f"{datetime.fromtimestamp(moment_s, UTC):%Y-%m-%d %H:%M}"


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(ASSETS), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"number": _number, "utc": _utc}
    return environment.get_template("page.html")


PAGE = _template()  # once, before children are forked: compiling it takes as long as drawing a map
