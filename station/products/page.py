"""The station's page: static files, each replaced atomically, that work from a folder and any server."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from station._version import __version__
from station.archive.areas import FILE_NAME as AREAS
from station.archive.derived.event_table import FILE_NAME as EVENTS
from station.archive.derived.event_table import read_events
from station.archive.derived.product_files import ProductSeries, read_products
from station.archive.netcdf_layout import Series
from station.archive.series.index import SeriesIndex
from station.errors import StoreError
from station.products.epoch_table import AreaSeries, EpochTable, read_epoch_table
from station.products.gallery import (
    Gallery,
    MeasuredEpoch,
    Style,
    replace_if_changed,
    retention_indices,
    update_gallery,
)
from station.products.maps import ASSETS, map_box
from station.products.overview import Overview
from station.products.viewer.block_codes import CurveEpoch
from station.products.viewer.block_curves import curve_tiers, update_curves
from station.products.viewer.level_tiles import LevelMaps
from station.products.viewer.overlays import area_outlines, browser_scales, event_outlines
from station.products.viewer.value_tiles import describe_levels, value_codes
from station.products.web.page_areas import newest_value, usable_area_series
from station.products.web.page_health import (
    calibration_by_range,
    log_entries,
    reasons,
    summary_of_sigma,
    timeline,
)
from station.products.web.page_products import product_curves, product_profiles, product_values
from station.products.web.page_text import PAGE_TEXT, PageText, format_number, format_utc
from station.quantities import Floats
from station.science.geometry.robust_statistics import NORMAL_95

STATIC = {  # the parts of each file; what the first words do not need is loaded by page.js after them
    "page.css": ("page.css",),
    "explore.css": ("uplot.css", "explore.css"),
    "page.js": ("page.js",),
    "explore.js": (
        "tiles.js",
        "covariance.js",
        "curves.js",
        "map.js",
        "values.js",
        "layers.js",
        "controls.js",
        "drawing.js",
        "explore.js",
    ),
    "uplot.js": ("uplot.js",),
    "icon.svg": ("icon.svg",),
}
MAX_CURVE_POINTS = 240  # of a curve; of a longer series every nth, the newest included
MAX_AREAS = 8  # with a curve, so that the page stays small
TABLE_ROWS = 24
MAX_EVENTS = 20  # newest events in the table
MAX_LISTED = 20  # scans that wait or were set aside


@dataclass(frozen=True)
class PageContext:
    """The state of the service, which is not in the archive."""

    name: str
    institution: str
    written_s: float  # now
    expected_every_s: float
    waiting: list[dict[str, Any]]  # keys scan, for
    set_aside: list[dict[str, Any]]  # keys scan, reason, since
    faults: list[str]
    durations_s: dict[str, float]  # processing time by scan id
    language: str = "en"
    alarms: list[dict[str, Any]] = field(default_factory=list)  # active; keys text, since_s
    alarm_log: list[tuple[float, str]] = field(default_factory=list)  # time [s] and message
    measured_again: list[tuple[float, int, float, float]] = field(default_factory=list)  # see `log_entries`
    overviews: dict[str, Overview] = field(default_factory=dict)  # those in memory already, by epoch file


def write_page(
    series: Series,
    folder: Path,
    context: PageContext,
    width_px: int,
    limit_m: float | None,
    progress: Callable[[], None],
) -> None:
    """Update the page in `folder` to the stored epochs; raise StoreError if that fails.

    The maps are written first, then the data, then the page that refers to them.
    """
    table = read_epoch_table(series) if series.path.is_file() else None
    all_areas = usable_area_series(series, table) if table is not None else []
    areas, products = all_areas[:MAX_AREAS], read_products(series.folder)
    text = PageText.of(context.language, on_map=series.grid.plane.is_map)
    gallery, curves = Gallery([], LevelMaps(), None, (0, 0), {}), None
    if table is not None:
        style = Style(context.name or series.station_id, width_px, limit_m)
        measured = _measured_epochs(series, table, context.overviews)
        gallery = update_gallery(series, folder, measured, style, progress)
        curves = _update_curves(series, folder, table, progress)
        context = replace(context, faults=[*context.faults, *gallery.levels.faults])
    for name, parts in STATIC.items():
        replace_if_changed(folder / name, b"".join((ASSETS / part).read_bytes() for part in parts))
    for name in (AREAS, EVENTS):
        _offer(series.folder / name, folder / name)
    data = {
        "written_s": context.written_s,
        "expected_every_s": context.expected_every_s,
        "station": series.station_id,
        "text": text.script,
        "maps": [
            {
                "time_s": image.start.timestamp(),
                "file": image.file,
                "version": image.version,
                "values": Path(image.epoch_file).stem,
                "finest": image.finest,
                "level": gallery.levels.at(image.start.timestamp(), image.version),
            }
            for image in gallery.change
        ],
        "level_times": {level.name: level.time_s for level in gallery.levels.maps},
        "frames": _frames(gallery, width_px),
        "values": value_codes(),
        "scales": browser_scales(gallery.limit_m) if gallery.limit_m else {},
        "picture_px": gallery.size[0],
        "outlines": {"areas": area_outlines(series), "events": event_outlines(series, MAX_EVENTS)},
        "curves": curves,
        "area_time_s": _json_numbers(areas[0].start_s[_decimate(len(areas[0].start_s))], 0) if areas else [],
        "areas": [_area_curve(area) for area in areas],
        "products": [_product_curve(curve) for curve in product_curves(products, text.page)[:MAX_AREAS]],
        "profiles": [
            _product_profile(profile) for profile in product_profiles(products, text.page)[:MAX_AREAS]
        ],
        "health": _health_curves(table, context) if table is not None else None,
    }
    _write_script(folder / "data.js", "STATION", data)
    _write_script(folder / "written.js", "STATION_WRITTEN_S", context.written_s)
    _write_summary(series, folder, context, table, gallery)
    replace_if_changed(
        folder / "index.html",
        _render(series, folder, context, table, areas, gallery, len(all_areas), products).encode(),
    )


def _offer(source: Path, path: Path) -> None:
    """Offer a file of the store for download: as a hard link, for files of the store are only ever replaced.

    Where the file system has no hard links it is copied. Raises StoreError if that fails.
    """
    tmp_path = path.with_name(f".{path.name}.part")
    try:
        if not source.is_file():
            path.unlink(missing_ok=True)
        elif not (path.is_file() and path.samefile(source)):
            tmp_path.unlink(missing_ok=True)
            try:
                os.link(source, tmp_path)
            except OSError:
                shutil.copyfile(source, tmp_path)
            tmp_path.replace(path)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error}") from error


def _write_script(path: Path, name: str, value: object) -> None:
    """Write data as a script, the only kind that a page opened from a folder may load."""
    body = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    replace_if_changed(path, f"window.{name}={body};\n".encode("ascii"))


def _write_summary(
    series: Series, folder: Path, context: PageContext, table: EpochTable | None, gallery: Gallery
) -> None:
    """Write what the page of several stations shows of this one."""
    summary: dict[str, Any] = {"written_s": context.written_s, "expected_every_s": context.expected_every_s}
    if table is not None and len(table):
        verdict = table.verdict[-1]
        summary |= {"scan_s": float(table.start_s[-1]), "verdict": verdict}
        summary |= {"reason": table.texts["verdict_reason"][-1]}
        summary |= {"verdict_word": PAGE_TEXT[context.language][verdict]}
    if gallery.change:
        summary |= {"map": gallery.change[-1].file, "map_s": gallery.change[-1].start.timestamp()}
    if alarms := sorted(context.alarms, key=lambda alarm: float(alarm["since_s"])):
        summary |= {"alarm": alarms[-1]["text"]}
    elif context.faults:
        summary |= {"alarm": context.faults[0]}
    _write_script(folder / "summary.js", f"STATIONS[{json.dumps(series.station_id)}]", summary)


def _measured_epochs(
    series: Series, table: EpochTable, overviews: dict[str, Overview]
) -> list[MeasuredEpoch]:
    """Return the epochs that have a reference: the first, and those whose map is kept."""
    epochs = SeriesIndex(series)
    versions, reasons = table.texts["reference_version"], table.texts["verdict_reason"]
    with_reference = [position for position, version in enumerate(versions) if version]
    if not with_reference:
        return []
    retained = {0, *retention_indices(table.start_s[with_reference])}
    return [
        MeasuredEpoch(
            epochs,
            position,
            datetime.fromtimestamp(float(table.start_s[position]), UTC),
            versions[position],
            "" if table.verdict[position] == "good" else f"{table.verdict[position]}: {reasons[position]}",
            overviews.get(table.texts["epoch_file"][position]),
        )
        for position in (with_reference[index] for index in sorted(retained))
    ]


def _update_curves(
    series: Series,
    folder: Path,
    table: EpochTable,
    progress: Callable[[], None],
) -> dict[str, object] | None:
    """Update the curves of blocks to the epochs of the newest reference; None if there is none."""
    versions = table.texts["reference_version"]
    newest = [position for position, version in enumerate(versions) if version and version == versions[-1]]
    if not newest:
        return None
    index, start_s = SeriesIndex(series), table.start_s[newest]
    retained = retention_indices(start_s)
    tiers = {
        name: [
            CurveEpoch(
                index[newest[item]],
                float(start_s[item]),
                table.verdict[newest[item]] != "unusable",
                item in retained,
            )
            for item in items
        ]
        for name, items in curve_tiers(start_s, retained).items()
    }
    return update_curves(series, folder, tiers, progress)


def _frames(gallery: Gallery, width_px: int) -> dict[str, Any]:
    """Return where the map is in its images, and its extent [m], by version of the reference."""
    frames = {}
    for version in sorted({image.version for image in gallery.change}):
        base = gallery.bases[version]
        grid = base.grid
        extent = {"west": grid.west_m, "east": grid.west_m + grid.nx * grid.cell_m, "north": grid.north_m}
        extent["south"] = grid.north_m - grid.ny * grid.cell_m
        box = [round(share, 6) for share in map_box(base, width_px)]
        means = int(base.factor > 1)  # the first level of means
        frames[version] = {"box": box, "extent": extent, "levels": describe_levels(base), "means": means}
    return frames


def _decimate(count: int) -> slice:
    """Return a slice of every nth of `count` values, the newest included; at most MAX_CURVE_POINTS."""
    step = max(1, math.ceil(count / MAX_CURVE_POINTS))
    return slice((count - 1) % step if count else 0, None, step)


def _json_numbers(values: Floats, digits: int) -> list[float | None]:
    rounded = (round(float(value), digits) + 0.0 if np.isfinite(value) else None for value in values)
    return [int(value) if value is not None and not digits else value for value in rounded]


def _area_curve(area: AreaSeries) -> dict[str, Any]:
    kept = _decimate(len(area.start_s))
    return {
        "name": area.name,
        "mean_m": _json_numbers(area.columns["mean_change"][kept], 4),
        "sigma_m": _json_numbers(area.columns["mean_change_uncertainty"][kept], 5),
    }


def _product_curve(curve: dict[str, Any]) -> dict[str, Any]:
    kept = _decimate(len(curve["time_s"]))
    digits = {"time_s": 0, "values": curve["digits"] + 1, "sigma": curve["digits"] + 2}
    return curve | {key: _json_numbers(curve[key][kept], places) for key, places in digits.items()}


def _product_profile(profile: dict[str, Any]) -> dict[str, Any]:
    step = slice(None, None, math.ceil(len(profile["distance_m"]) / MAX_CURVE_POINTS))
    digits = {"distance_m": 2, "values": profile["digits"], "sigma": profile["digits"] + 1}
    return profile | {key: _json_numbers(profile[key][step], places) for key, places in digits.items()}


def _health_curves(table: EpochTable, context: PageContext) -> dict[str, Any]:
    kept = _decimate(len(table))
    digits = {"platform_roll": 4, "platform_pitch": 4, "air_temperature": 1, "air_pressure": 1}
    digits |= {"stable_median": 4, "stable_nmad": 4, "stable_z_std": 2}
    scan_ids = table.texts["scan_id"][kept]
    seconds = np.array([context.durations_s.get(scan_id, np.nan) for scan_id in scan_ids], dtype=np.float64)
    return {
        "time_s": _json_numbers(table.start_s[kept], 0),
        **{name: _json_numbers(table.scalars[name][kept], places) for name, places in digits.items()},
        "seconds": _json_numbers(seconds, 1),
    }


def _render(
    series: Series,
    folder: Path,
    context: PageContext,
    table: EpochTable | None,
    areas: list[AreaSeries],
    gallery: Gallery,
    area_count: int,
    products: list[ProductSeries],
) -> str:
    events, texts = read_events(series.folder), PageText.of(context.language, on_map=series.grid.plane.is_map)
    text = texts.page
    by_range = calibration_by_range(series, table, folder, text) if table is not None else []
    recent = range(max(0, len(table) - TABLE_ROWS), len(table))[::-1] if table is not None else []
    return PAGE.render(
        id=series.station_id,
        context=context,
        version=__version__,
        gallery=gallery,
        scans=[_scan_row(table, context, index) for index in recent] if table is not None else [],
        areas=[newest_value(area) for area in areas],
        products=product_values(products, text),
        has_profiles=any(product.kind == "profile" for product in products),
        t=text,
        viewer=texts.viewer,
        language=context.language,
        calibration=summary_of_sigma(table, by_range),
        by_range=by_range,
        days=timeline(table, context.expected_every_s, context.written_s) if table is not None else [],
        reasons=reasons(table) if table is not None else [],
        log=log_entries(series, context.measured_again, context.alarm_log, text),
        waiting=context.waiting[:MAX_LISTED],
        set_aside=context.set_aside[-MAX_LISTED:][::-1],
        max_listed=MAX_LISTED,
        areas_left_out=area_count - len(areas),
        events=events[: -MAX_EVENTS - 1 : -1],
        events_left_out=max(0, len(events) - MAX_EVENTS),
        half_95=NORMAL_95,
    )


def _scan_row(table: EpochTable, context: PageContext, index: int) -> dict[str, Any]:
    """Return a row of the table of scans."""
    scan_id = table.texts["scan_id"][index]
    return {
        "id": scan_id,
        "time_s": float(table.start_s[index]),
        "verdict": table.verdict[index],
        "reason": table.texts["verdict_reason"][index],
        "seconds": context.durations_s.get(scan_id, math.nan),
        **{name: float(column[index]) for name, column in table.scalars.items()},
    }


def environment() -> jinja2.Environment:
    """Return the environment of the templates."""
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(ASSETS), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    templates.filters |= {"number": format_number, "utc": format_utc}
    return templates


PAGE = environment().get_template(
    "page.html"
)  # compiled once, before worker processes are forked: it takes as long as drawing a map
