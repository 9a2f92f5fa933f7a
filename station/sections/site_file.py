"""The tables of the site file: every key, its valid values and its default.

The commented files in `config/` explain the keys.
"""

from __future__ import annotations

from pydantic import model_validator

from station.scan_names import ZONE_MARK
from station.section_types import (
    Section,
)
from station.sections.inputs import (
    AirSection,
    EpochSection,
    InclinationSection,
    RegistrationSection,
    ScannerSection,
    ScansSection,
    SopSection,
    WeatherSection,
)
from station.sections.product import UPWARD_KINDS, ProductSection, product_key
from station.sections.publish import PublishSection
from station.sections.results import (
    AdjustmentSection,
    AlarmsSection,
    AreasSection,
    FlagsSection,
    GridSection,
    MapSection,
    MetadataSection,
    MirrorSection,
    ProductsSection,
    ReferenceSection,
    RetentionSection,
    ServiceSection,
    StationSection,
    UncertaintySection,
)


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
    product: tuple[ProductSection, ...] = ()
    mirror: MirrorSection | None = None
    publish: PublishSection | None = None
    alarms: AlarmsSection | None = None

    @model_validator(mode="after")
    def _chain_is_complete(self) -> SiteFile:
        if self.scans.frame == "scanner" and not self.sop:
            self._require_local_map()
        starts = [(sop.from_, sop.files) for sop in self.sop]
        if len(set(starts)) < len(starts):
            raise ValueError("two [[sop]] have the same from: which of them is valid then?")
        wavelengths_um = {sop.scanner.wavelength_um for sop in self.sop if sop.scanner is not None}
        if wavelengths_um - {self.scanner.wavelength_um} and self.scans.intensity != "none":
            raise ValueError(
                "scanners of different wavelengths see snow and rock differently: set scans.intensity ="
                ' "none", or give all of them the same wavelength_um'
            )
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
        self._require_products()
        self._require_what_a_plane_has()
        return self

    def _require_what_a_plane_has(self) -> None:
        """Raise ValueError if something that is counted upward is asked for on a plane."""
        if self.grid.plane is None:
            return
        if self.uncertainty.model != "rigorous" or self.uncertainty.store_terms:
            raise ValueError(
                "grid.plane: the published budget and its terms are those of heights: leave out"
                " uncertainty.model and uncertainty.store_terms"
            )
        for product in self.product:
            if product.kind in UPWARD_KINDS:
                raise ValueError(
                    f"grid.plane: product {product.name!r} of kind {product.kind} is counted upward, but"
                    " change on a plane along its normal: use volume_budget, point or profile"
                )

    def _require_products(self) -> None:
        """Raise ValueError if two products have one file, or one has no areas."""
        keys = [product.key for product in self.product]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise ValueError(f"two [[product]] have the name {twice[0]!r}: rename one")
        for product in self.product:
            if product.needs_areas and not self.areas:
                raise ValueError(f"product {product.name!r} needs areas: give their file in [areas]")
        for alarm in self.alarms.product if self.alarms else ():
            if product_key(alarm.product) not in keys:
                raise ValueError(f"alarms.product: no [[product]] has the name {alarm.product!r}")

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
        if self.registration is not None and self.registration.into == "project":
            raise ValueError(
                'registration.into = "project" needs an [[sop]], which says where the scanner stands in'
                ' general: one of the matrices will do. Without one, they lead into = "scanner"'
            )
        levels, mode = self.registration is None, "absolute" if self.registration is None else "relative"
        if self.inclination is not None and self.inclination.mode != mode:
            map_is = "the log makes the map level" if levels else "the map is the frame of the registration"
            raise ValueError(f'without an [[sop]] {map_is}: set inclination.mode = "{mode}"')
