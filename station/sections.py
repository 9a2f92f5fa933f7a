"""The tables of the site file: every key, its valid values and its default.

The commented files in `config/` explain the keys.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from station.quantities import Air, IntensityScale, Scanner
from station.scan_names import ZONE_MARK
from station.scanners import SCANNERS, scanner_model
from station.section_types import (
    Arm,
    NotNegative,
    Place,
    Positive,
    Section,
    Utc,
    Zone,
    on_loopback,
    require_epoch_name,
    require_projected,
    require_suffix,
    require_time_pattern,
    without_required,
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


class ScansSection(Section):
    """Where scans arrive and how they are named."""

    inbox: Path
    name: Annotated[str, AfterValidator(require_time_pattern)] = "%y%m%d_%H%M%S"
    zone: Zone = "UTC"
    frame: Literal["scanner", "map"] = "scanner"
    point_time: Literal["auto", "none"] = "auto"
    intensity: IntensityScale = "auto"
    settle_s: NotNegative = 60.0
    expected_every_s: Positive = 3600.0
    suffix: Annotated[str, AfterValidator(require_suffix)] | None = None
    columns: tuple[str, ...] = ()
    convert: tuple[str, ...] | None = None
    polling: bool = False
    timeout_s: Positive = 1800.0

    @property
    def pattern(self) -> str:
        """The pattern of the names with the time zone of their times (see `scan_names.start_in_name`)."""
        return self.name if self.zone == "UTC" else f"{self.name}{ZONE_MARK}{self.zone}"

    @model_validator(mode="after")
    def _conversion_is_complete(self) -> ScansSection:
        if self.convert is not None and self.suffix is None:
            raise ValueError('convert needs suffix, that of the files to convert, such as ".rxp"')
        missing = [word for word in ("{in}", "{out}") if word not in " ".join(self.convert or (word,))]
        if missing:
            raise ValueError(f"convert lacks {' and '.join(missing)}, which stand for scan and LAZ file")
        return self


class EpochSection(Section):
    """Several files that are one epoch: tiles of a scan, or scans from several positions."""

    name: Annotated[str, AfterValidator(require_epoch_name)]
    files: Annotated[int, Field(ge=1, le=1000)] | None = None
    wait_s: NotNegative = 3600.0


class RegistrationSection(Section):
    """The owner's registration of each scan: a matrix beside it, or already applied to points on the map."""

    suffix: Annotated[str, Field(pattern=r"^[^/]{2,}$")] | None = None
    into: Literal["project", "scanner"] = "project"
    use: Literal["start", "given"] = "start"
    sigma_m: Positive
    sigma_deg: Positive
    wait_s: NotNegative = 900.0


class ScannerSection(Section):
    """The instrument: a known model; each of its values can be overridden."""

    model_config = ConfigDict(json_schema_extra=without_required)

    model: str = "riegl-vz-6000"
    wavelength_um: Annotated[float, Field(ge=0.3, le=2.5)]
    beam_divergence_mrad: Annotated[float, Field(ge=0, le=10)]
    exit_diameter_m: Annotated[float, Field(ge=0, le=0.2)]
    range_sigma_m: Annotated[float, Field(gt=0, le=1)]
    angle_resolution_deg: Annotated[float, Field(ge=0, le=1)]
    inclination_sigma_deg: Annotated[float, Field(gt=0, le=1)]
    inclination_range_deg: Annotated[float, Field(gt=0, le=90)]
    range_max_m: Positive
    beam_origin_m: tuple[Arm, Arm, Arm] = (0.0, 0.0, 0.0)

    @model_validator(mode="before")
    @classmethod
    def _fill_from_model(cls, values: Any) -> Any:  # noqa: ANN401 - any TOML value
        if not isinstance(values, dict) or not isinstance(values.get("model", ""), str):
            return values  # pydantic reports the types
        given = values.get("model", "riegl-vz-6000")
        model = scanner_model(given) or given
        known = SCANNERS.get(model, {})
        missing = set(SCANNERS["riegl-vz-6000"]) - set(values)
        if not known and missing:
            raise ValueError(
                f"unknown scanner {given!r}: choose from {', '.join(SCANNERS)},"
                f" or give {', '.join(sorted(missing))}"
            )
        return {**known, **values, "model": model}

    @property
    def instrument(self) -> Scanner:
        """The scanner, angles in radians."""
        return Scanner(
            model=self.model,
            wavelength_um=self.wavelength_um,
            beam_divergence_rad=self.beam_divergence_mrad * 1e-3,
            exit_diameter_m=self.exit_diameter_m,
            range_sigma_m=self.range_sigma_m,
            angle_resolution_rad=math.radians(self.angle_resolution_deg),
            inclination_sigma_rad=math.radians(self.inclination_sigma_deg),
            inclination_range_rad=math.radians(self.inclination_range_deg),
            range_max_m=self.range_max_m,
            beam_origin_m=self.beam_origin_m,
        )


class SopSection(Section):
    """A scanner orientation and position, and the time from which it is valid."""

    from_: Annotated[Utc, Field(alias="from")]
    file: Path
    scan: str | None = None
    files: str | None = None


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
    """Outer edges of the grid in the map CRS."""

    west: Place
    south: Place
    east: Place
    north: Place


class GridSection(Section):
    """The grid of the products."""

    bounds_m: Bounds
    cell_m: Annotated[float, Field(ge=0.001)] = 1.0
    min_points: Annotated[int, Field(ge=1)] = 1

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


class InclinationSection(Section):
    """The inclination log of each scan, and how it is used."""

    suffix: str = "-incl.txt"
    required: bool = True
    wait_s: NotNegative = 900.0
    filter: Literal["blackman", "none"] = "blackman"
    cutoff_hz: Literal["auto"] | Positive = "auto"
    mode: Literal["relative", "absolute"] = "relative"


class WeatherColumns(Section):
    """Column names of the weather log; those of the dialect where none is given."""

    time: str | Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    temperature_c: str | None = None
    humidity_pct: str | None = None
    pressure_hpa: str | None = None


class WeatherUnits(Section):
    """Units of the weather log that it does not state itself."""

    temperature_c: Literal["C", "F", "K"] | None = None
    humidity_pct: Literal["%", "fraction"] | None = None
    pressure_hpa: Literal["hPa", "kPa", "Pa", "bar", "inHg", "mmHg"] | None = None


WeatherFormat = Literal["toa5", "csv", "smet", "dwd", "meteoswiss", "davis", "hobo", "lufft", "geosphere"]


class WeatherSection(Section):
    """The station's weather log."""

    file: Path
    format: WeatherFormat = "toa5"
    columns: WeatherColumns | None = None
    station: str | None = None
    names: tuple[str, ...] = ()
    units: WeatherUnits | None = None
    time_format: str | None = None
    zone: Zone | None = None
    max_age_s: Positive = 3600.0
    wait_s: NotNegative = 900.0
    utc_offset_h: Annotated[float, Field(ge=-14, le=14)] = 0.0

    @model_validator(mode="after")
    def _columns_are_known(self) -> WeatherSection:
        if self.format in {"toa5", "csv"}:
            given = self.columns.model_dump(exclude_none=True) if self.columns else {}
            missing = [key for key in ("temperature_c", "humidity_pct", "pressure_hpa") if key not in given]
            if missing:
                raise ValueError(f'format = "{self.format}" needs columns.{", columns.".join(missing)}')
        if self.format == "davis" and self.time_format is None:  # day or month first, as the computer was set
            raise ValueError('format = "davis" needs time_format, such as "%d/%m/%y %H:%M"')
        if self.zone is not None and self.utc_offset_h:
            raise ValueError("zone and utc_offset_h both say what the clock of the logger shows: keep one")
        return self


class AirValues(Section):
    """Temperature, pressure and humidity."""

    temperature_c: Annotated[float, Field(ge=-60, le=50)]
    pressure_hpa: Annotated[float, Field(ge=300, le=1100)]
    humidity_pct: Annotated[float, Field(ge=0, le=100)]

    @property
    def air(self) -> Air:
        """The air at the scanner."""
        return Air(self.temperature_c, self.pressure_hpa, self.humidity_pct)


class AirSection(Section):
    """The air that the scanner assumed; without this table there is no correction for the air."""

    scanner_setting: AirValues | Literal["weather"] = AirValues(
        temperature_c=-2.0, pressure_hpa=684.0, humidity_pct=28.0
    )
    scanner_corrects: bool = True


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


class ProductsSection(Section):
    """What is produced from every scan for people and other programs."""

    page: bool = True
    geotiff: bool = False
    quicklook_width_px: Annotated[int, Field(ge=400, le=4000)] = 1200
    change_limit_m: Positive | None = None
    cf_uncertainty: bool = False


class MirrorSection(Section):
    """Descriptions of the series for the cloud and for data servers, renewed by the service."""

    folder: Path
    url: str = ""
    formats: tuple[Literal["references", "ncml", "erddap"], ...] = ("references", "ncml")


class SiteFile(Section):
    """The whole file."""

    station: StationSection
    metadata: MetadataSection = MetadataSection()
    scans: ScansSection
    epoch: EpochSection | None = None
    registration: RegistrationSection | None = None
    scanner: ScannerSection = ScannerSection.model_validate({})
    sop: tuple[SopSection, ...] = ()
    map: MapSection = MapSection()
    grid: GridSection
    inclination: InclinationSection | None = None
    weather: WeatherSection | None = None
    air: AirSection | None = None
    adjustment: AdjustmentSection = AdjustmentSection()
    uncertainty: UncertaintySection = UncertaintySection()
    reference: ReferenceSection = ReferenceSection()
    areas: AreasSection | None = None
    flags: FlagsSection | None = None
    retention: RetentionSection = RetentionSection()
    service: ServiceSection = ServiceSection()
    products: ProductsSection = ProductsSection()
    mirror: MirrorSection | None = None
    alarms: AlarmsSection | None = None

    @model_validator(mode="after")
    def _chain_is_complete(self) -> SiteFile:
        if self.scans.frame == "scanner" and not self.sop:
            self._require_local_map()
        starts = [(sop.from_, sop.files) for sop in self.sop]
        if len(set(starts)) < len(starts):
            raise ValueError("two [[sop]] have the same from: which of them is valid then?")
        if any(sop.files for sop in self.sop) and self.epoch is None:
            raise ValueError("sop.files, for several scan positions, needs [epoch]")
        if self.registration and (self.registration.suffix is None) != (self.scans.frame == "map"):
            raise ValueError(
                'registration.suffix names the matrices beside scans: needed with scans.frame = "scanner",'
                ' and none with "map"'
            )
        if self.registration and self.scans.frame == "map" and self.map.origin is None:
            raise ValueError("registration needs map.origin, from which its rotation and our own are counted")
        if self.map.crs is None and (self.map.pop or self.map.origin):
            raise ValueError("map.pop and map.origin need map.crs, the map they refer to")
        if self.map.pop and self.map.origin and self.scans.frame == "scanner":
            raise ValueError("map.pop and map.origin both place the project frame on the map: keep one")
        if self.alarms and self.alarms.change and not self.areas:
            raise ValueError("alarms.change needs areas: give their file in [areas]")
        return self

    @property
    def row_pattern(self) -> str:
        """The pattern of the names of scans in the journal: of epochs, if several files are one."""
        if self.epoch is None:
            return self.scans.pattern
        return f"{self.epoch.name}{ZONE_MARK}{self.scans.zone}"

    def _require_local_map(self) -> None:
        """Raise ValueError unless scans without an SOP can be on a local map that their logs make level."""
        if self.map.crs is not None:
            raise ValueError(
                "map.crs needs an [[sop]], which transforms the points to that map; without both, the map is"
                " local, with its origin at the scanner"
            )
        if self.registration is not None:
            raise ValueError("registration needs an [[sop]], which says where the scanner stands in general")
        if self.inclination is not None and self.inclination.mode == "relative":
            raise ValueError(
                'without an [[sop]] the log makes the map level: set inclination.mode = "absolute"'
            )
