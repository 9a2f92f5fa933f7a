"""The table `[[product]]` of the site file: a quantity that the owner thinks in, by name."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from station.section_types import NotNegative, Place, Positive, Section, Utc

Kind = Literal[
    "point",
    "snow_depth",
    "surface_mass_balance",
    "melt",
    "volume_budget",
    "volume_between",
    "profile",
    "contour",
]
_PLACE, _BASE = {"areas", "at", "radius_m", "observations"}, {"surface"}
_OFFSET, _DENSITY = {"offset_m", "offset_sigma_m"}, {"density_kg_m3", "density_sigma_kg_m3"}
KEYS: dict[str, tuple[set[str], set[str]]] = {  # required and optional, of each kind
    "point": ({"at"}, {"radius_m", "observations"}),
    "snow_depth": ({"surface"}, _PLACE | _OFFSET),
    "surface_mass_balance": ({"density_kg_m3"}, _PLACE | _BASE | _DENSITY),
    "melt": ({"density_kg_m3"}, _PLACE | _BASE | _DENSITY),
    "volume_budget": (set(), {"areas"} | _BASE),
    "volume_between": ({"low"}, {"areas", "high"}),
    "profile": ({"line"}, set()),
    "contour": ({"line", "height_m"}, _BASE | {"count", "spacing_m", "observations"}),
}

UPWARD_KINDS = ("snow_depth", "surface_mass_balance", "melt")  # counted from below


def product_key(name: str) -> str:
    """Return the name of a product's file: in lower case, with _ for blanks."""
    return re.sub(r"[ -]+", "_", name.strip().lower())


class SurfaceTime(Section):
    """A time in which the station measured the surface that a product counts from."""

    from_: Annotated[Utc, Field(alias="from")]
    to: Utc


class ProductSection(Section):
    """A quantity by name: its kind, where it is measured, and what it is counted from."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9 _-]{0,63}$")]
    kind: Kind
    areas: tuple[str, ...] = ()  # empty: all
    at: tuple[Place, Place] | None = None
    radius_m: NotNegative = 0.0
    line: Annotated[tuple[tuple[Place, Place], ...], Field(min_length=2)] | None = None
    count: Annotated[int, Field(ge=2, le=200)] | None = None  # of parallel lines
    spacing_m: Positive | None = None  # between them, to the right of the first
    height_m: float | Literal["crest"] | None = None
    low: float | Path | None = None
    high: float | Path | None = None
    surface: Path | SurfaceTime | None = None
    offset_m: float = 0.0
    offset_sigma_m: NotNegative = 0.0
    density_kg_m3: Positive | None = None
    density_sigma_kg_m3: NotNegative = 0.0
    observations: Path | None = None

    @model_validator(mode="after")
    def _has_the_keys_of_its_kind(self) -> ProductSection:
        required, optional = KEYS[self.kind]
        given = self.model_fields_set - {"name", "kind"}
        if missing := sorted(required - given):
            raise ValueError(f'kind = "{self.kind}" needs {", ".join(missing)}')
        if unused := sorted(given - required - optional):
            valid = ", ".join(sorted(required | optional))
            raise ValueError(f'kind = "{self.kind}" has no {", ".join(unused)}; its keys: {valid}')
        if self.at is not None and self.areas:
            raise ValueError("areas and at both say where: keep one")
        if isinstance(self.surface, SurfaceTime) and self.surface.to <= self.surface.from_:
            raise ValueError("surface: to must be after from")
        if (self.count is None) != (self.spacing_m is None):
            raise ValueError("count and spacing_m belong together: give both")
        if self.count is not None and self.line is not None and self.line[0] == self.line[-1]:
            raise ValueError("line ends where it begins: it has no right side for parallel lines")
        if self.radius_m and self.at is None:
            raise ValueError("radius_m is that around at: give at = [easting, northing]")
        return self

    @property
    def key(self) -> str:
        """The name of the product's file."""
        return product_key(self.name)

    @property
    def lines(self) -> dict[str, tuple[tuple[float, float], ...]]:
        """The line, or with `count` the parallel lines to its right by their distance from it."""
        if self.line is None or self.count is None or self.spacing_m is None:
            return {} if self.line is None else {self.name: self.line}
        (first_m, *_, last_m), offsets_m = self.line, [k * self.spacing_m for k in range(self.count)]
        length_m = math.dist(first_m, last_m)
        right = (last_m[1] - first_m[1]) / length_m, (first_m[0] - last_m[0]) / length_m
        return {
            f"{offset_m:g} m": tuple((x + offset_m * right[0], y + offset_m * right[1]) for x, y in self.line)
            for offset_m in offsets_m
        }

    @property
    def needs_areas(self) -> bool:
        """True if the product is measured in the areas of the site."""
        return "areas" in KEYS[self.kind][1] and self.at is None

    @property
    def rasters(self) -> dict[str, Path]:
        """The given surfaces by key."""
        given = {"surface": self.surface, "low": self.low, "high": self.high}
        return {key: path for key, path in given.items() if isinstance(path, Path)}

    @property
    def levels(self) -> dict[str, float]:
        """The given heights by key [m]."""
        given = {"low": self.low, "high": self.high}
        return {key: level for key, level in given.items() if isinstance(level, float)}
