"""Tables of the site file on what the station computes, stores and reports."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from station.section_types import (
    NotNegative,
    Place,
    Positive,
    Section,
    on_loopback,
    require_projected,
)


class StationSection(Section):
    """Identity of the station; written to the metadata of all its files."""

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}$")]
    data: Path
    name: str = ""
    institution: str = ""


class MetadataSection(Section):
    """Who made the data, and how they may be used and cited: global attributes (ACDD 1.3) of all files."""

    summary: str = ""
    keywords: tuple[str, ...] = ()
    license: str = ""
    creator_name: str = ""
    creator_email: str = ""
    creator_orcid: Annotated[str, Field(pattern=r"^(\d{4}-\d{4}-\d{4}-\d{3}[\dX])?$")] = ""
    publisher_name: str = ""
    publisher_email: str = ""
    publisher_url: str = ""
    project: str = ""
    acknowledgement: str = ""
    naming_authority: str = ""
    references: str = ""
    comment: str = ""
    doi: Annotated[str, Field(pattern=r"^(10\.\d{4,9}/\S+)?$")] = ""

    @property
    def attributes(self) -> dict[str, str]:
        """Global attributes of what is given, by their names in the convention."""
        given = self.model_dump(exclude={"keywords", "creator_orcid", "doi"}, exclude_defaults=True)
        if self.keywords:
            given["keywords"] = ", ".join(self.keywords)
        if self.creator_orcid:
            given["creator_url"] = f"https://orcid.org/{self.creator_orcid}"
        if self.doi:
            given |= {"id": self.doi, "metadata_link": f"https://doi.org/{self.doi}"}
        return given


class Origin(Section):
    """A point on the ellipsoid of WGS84."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)]
    longitude_deg: Annotated[float, Field(ge=-180, le=360)]
    height_m: float


class MapSection(Section):
    """The map of the products, and how the project frame is placed on it; without a CRS it is local."""

    crs: Annotated[str, AfterValidator(require_projected)] | None = None
    origin: Origin | None = None
    pop: Path | None = None
    vertical_datum: str = ""


class Bounds(Section):
    """Outer edges of the grid in the map CRS, or from the origin of its plane: left, down, right and up."""

    west: Place
    south: Place
    east: Place
    north: Place


class PlaneSection(Section):
    """A plane through a point of the map, on which the grid lies: that of a rock face."""

    origin_m: tuple[Place, Place, Place]
    facing_deg: Annotated[float, Field(ge=0, le=360)]
    dip_deg: Annotated[float, Field(ge=0, le=180)] = 90.0


class GridSection(Section):
    """The grid of the products."""

    bounds_m: Bounds
    cell_m: Annotated[float, Field(ge=0.001)] = 1.0
    min_points: Annotated[int, Field(ge=1)] = 1
    plane: PlaneSection | None = None

    @model_validator(mode="after")
    def _whole_cells(self) -> GridSection:
        bounds = self.bounds_m
        for low, high, axis in (("west", "east", "columns"), ("south", "north", "rows")):
            cells = (getattr(bounds, high) - getattr(bounds, low)) / self.cell_m
            if cells < 1:
                raise ValueError(f"bounds_m.{high} must be at least one cell_m beyond bounds_m.{low}")
            if abs(cells - round(cells)) > 1e-6:
                raise ValueError(
                    f"bounds_m.{low} to bounds_m.{high} is {cells:g} {axis} of cell_m = {self.cell_m:g}:"
                    " make it a whole number"
                )
        if self.shape[0] * self.shape[1] > 100_000_000:
            raise ValueError(f"{self.shape} cells are too many: increase cell_m or reduce bounds_m")
        return self

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        bounds, cell_m = self.bounds_m, self.cell_m
        return (round((bounds.north - bounds.south) / cell_m), round((bounds.east - bounds.west) / cell_m))


class AdjustmentSection(Section):
    """How the pose of each scan is estimated, and from which stable ground: detected, or from a GeoJSON."""

    method: Literal["none", "joint"] = "joint"
    stable: Literal["auto"] | Path = "auto"


class UncertaintySection(Section):
    """Which error budget is computed, and whether its terms are stored."""

    model: Literal["rigorous", "voordendag2023"] = "rigorous"
    registration_sigma_m: NotNegative = 0.0  # published budget only
    store_terms: bool = False


class ReferenceSection(Section):
    """The reference surface: the mean of the first usable scans, or a GeoTIFF."""

    scans: Annotated[int, Field(ge=1, le=200)] | Path = 8


class AreasSection(Section):
    """Named polygons; each has a time series of mean and volume change."""

    file: Path


class FlagsSection(Section):
    """A manual list of time intervals whose epochs must not be used."""

    file: Path


class RetentionSection(Section):
    """What happens to raw scans once they are stored and verified."""

    raw: Literal["leave", "move", "delete"] = "leave"
    keep_days: NotNegative = 30.0
    archive: Path | None = None

    @model_validator(mode="after")
    def _require_archive(self) -> RetentionSection:
        if self.raw == "move" and self.archive is None:
            raise ValueError('raw = "move" needs archive, the folder to move scans to')
        return self


class ServiceSection(Section):
    """The running service."""

    memory_gb: Annotated[float, Field(ge=0.5, le=1024)] = 5.0
    metrics: Annotated[str, AfterValidator(on_loopback)] | None = None
    metrics_file: Path | None = None


Target = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]


class ChangeAlarm(Section):
    """The change of areas that raises an alarm."""

    areas: tuple[str, ...] = ()  # empty: all areas
    within_h: Positive = 6.0
    least_m: NotNegative = 0.0
    scans: Annotated[int, Field(ge=1, le=24)] = 2
    false_alarms_per_year: Positive = 1.0


class EventAlarm(Section):
    """The events anywhere on the grid that raise an alarm."""

    kinds: tuple[Literal["loss", "gain", "paired", "melt_front", "snowfall"], ...] = (
        "loss",
        "gain",
        "paired",
    )
    least_m3: NotNegative = 0.0


class ProductAlarm(Section):
    """The value of a product that raises an alarm: beyond a level by more than its 95 % interval."""

    product: str
    quantity: str
    above: float | None = None
    below: float | None = None
    scans: Annotated[int, Field(ge=1, le=24)] = 2

    @model_validator(mode="after")
    def _has_a_level(self) -> ProductAlarm:
        if self.above is None and self.below is None:
            raise ValueError("give above or below, the level that raises the alarm")
        return self


class AlarmsSection(Section):
    """The alarm rules, and the targets (names of credentials) that are notified. 0 disables a rule."""

    targets: tuple[Target, ...] = ()
    digest: Target | None = None
    repeat_h: Positive = 24.0
    no_scan_h: NotNegative = 3.0
    stalled_h: NotNegative = 1.0
    disk_gb: NotNegative = 2.0
    set_aside_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    z_std: NotNegative = 1.5
    moved: bool = True
    change: ChangeAlarm | None = None
    events: EventAlarm | None = None
    product: tuple[ProductAlarm, ...] = ()


class ProductsSection(Section):
    """What is produced from every scan for people and other programs."""

    page: bool = True
    language: Literal["en", "de"] = "en"
    geotiff: bool = False
    quicklook_width_px: Annotated[int, Field(ge=400, le=4000)] = 1200
    change_limit_m: Positive | None = None
    cf_uncertainty: bool = False
    levels: bool = False


class MirrorSection(Section):
    """Descriptions of the series for the cloud and for data servers, renewed by the service."""

    folder: Path
    url: str = ""
    formats: tuple[Literal["references", "ncml", "erddap"], ...] = ("references", "ncml")
