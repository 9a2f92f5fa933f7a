"""What the page's map shows besides values: colour scales, and outlines of areas and events."""

from __future__ import annotations

from typing import Any

import shapely

from station.archive.areas import area_polygons
from station.archive.derived.event_table import read_outlines
from station.archive.netcdf_layout import Series
from station.products.colours import ColourScale, change_scale, points_scale, sigma_scale

MAX_SIGNIFICANCE = 5.0  # sigmas at the end of the colour scale
RATE_SHARE = 0.2  # of the limit of the change [m], for rates [m/d]: about the ratio of their sigmas


def browser_scales(limit_m: float) -> dict[str, dict[str, Any]]:
    """Return the colour scales of the layers."""
    change = _browser_scale(change_scale(limit_m, ""))
    end = MAX_SIGNIFICANCE
    return {
        "change": change,
        "rate": _browser_scale(change_scale(RATE_SHARE * limit_m, "")),
        "significance": {**change, "low": -end, "high": end, "ticks": [-end, -2.0, 0.0, 2.0, end]},
        "sigma": _browser_scale(sigma_scale(limit_m)),
        "coverage": {
            **_browser_scale(points_scale()), "low": 0.0, "high": 1.0, "log": False, "ticks": [0.0, 0.5, 1.0],
        },
    }  # fmt: skip


def _browser_scale(scale: ColourScale) -> dict[str, Any]:
    return {
        "colours": scale.colours.tobytes().hex(),
        "low": scale.low,
        "high": scale.high,
        "log": scale.logarithmic,
        "ticks": list(scale.ticks),
    }


def area_outlines(series: Series) -> list[dict[str, Any]]:
    """Return the name and the outline [m] of each area; raise StoreError if they cannot be read."""
    return [
        {"name": name, "rings": _rings(polygon, series.grid.cell_m)}
        for name, polygon in area_polygons(series).items()
    ]


def event_outlines(series: Series, count: int) -> list[dict[str, Any]]:
    """Return the newest events, newest first, with their outline [m]; raise StoreError if damaged."""
    return [
        {
            "id": event.id,
            "kind": event.kind,
            "after": event.after,
            "begin": event.begin,
            "end": event.end,
            "rings": _rings(outline, 0.0),
        }
        for event, outline in read_outlines(series.folder)[: -count - 1 : -1]
    ]


def _rings(shape: shapely.Geometry, tolerance_m: float) -> list[list[list[float]]]:
    """Return the outer rings of a shape as lists of coordinates, simplified to less than a cell."""
    simple = shapely.simplify(shape, tolerance_m / 2)
    return [
        [[round(east, 1), round(north, 1)] for east, north in shapely.get_coordinates(ring).tolist()]
        for ring in shapely.get_exterior_ring(shapely.get_parts(simple))
    ]
