"""Tables of the site file on what the station reads: scans, SOPs, logs and weather."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from station.quantities import Air, IntensityScale, Scanner
from station.scan_names import ZONE_MARK
from station.scanners import SCANNERS, missing_values, scanner_model
from station.section_types import (
    Arm,
    NotNegative,
    Positive,
    Section,
    Utc,
    Zone,
    require_epoch_name,
    require_suffix,
    require_time_pattern,
    without_required,
)

DAY_S = 86_400


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
    window_s: Annotated[int, Field(ge=1, le=86_400)] | None = None
    files: Annotated[int, Field(ge=1, le=1000)] | None = None
    wait_s: NotNegative = 3600.0

    @model_validator(mode="after")
    def _windows_are_named(self) -> EpochSection:
        if self.window_s is None:
            return self
        if DAY_S % self.window_s:
            raise ValueError("window_s must divide a day: 600 for ten minutes, 10800 for three hours")
        midnight = datetime(2025, 7, 15, tzinfo=UTC)
        names = {
            (midnight + timedelta(seconds=s)).strftime(self.name) for s in range(0, DAY_S, self.window_s)
        }
        if len(names) < DAY_S // self.window_s:
            raise ValueError("epoch.name must tell all windows of a day apart, as %Y%m%d_%H%M does")
        return self


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
        missing = ", ".join(key for key in missing_values(model) if key not in values)
        if missing and model not in SCANNERS:
            raise ValueError(
                f"unknown scanner {given!r}: choose from {', '.join(SCANNERS)}, or give {missing}"
            )
        if missing:
            raise ValueError(f"not all of {model} is known: give {missing} of its data sheet")
        return {**SCANNERS.get(model, {}), **values, "model": model}

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
    scanner: ScannerSection | None = None


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
