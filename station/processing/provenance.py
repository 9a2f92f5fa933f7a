"""Provenance of stored epochs compared with the current configuration and inputs of the site.

No scan is opened: the provenance of an epoch is stored in it (`archive.schema`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np

from station.archive.epochs import AIR_VARIABLES, EpochRef
from station.archive.netcdf_layout import Series, decode_text, roundtrip_text
from station.archive.schema import FILL
from station.archive.series.epoch_reader import contiguous_runs, read_source
from station.archive.series.index import list_epochs
from station.archive.tilt_offsets import read_tilt_offset
from station.config import Site
from station.errors import ConfigError, NotReadyError, ScanError
from station.inbox.file_hash import sha256_files
from station.inbox.journal_reader import Entry
from station.inbox.listing import ScanFile
from station.processing.scanner_pose import scanner_height_m, sop_identity_at
from station.processing.scans.scan_air import air_from_log
from station.quantities import Air
from station.readers.flags import read_flags, reasons_for
from station.readers.sop import valid_sop
from station.sections.inputs import WeatherSection

MIN_AIR_CHANGE = 1e-4  # °C, hPa, %; floating-point error of the interpolation in time is smaller


@dataclass(frozen=True)
class ScanProvenance:
    """Inputs of one scan, as used in an epoch or in a reference."""

    scan_id: str
    start_s: float  # seconds since 1970
    end_s: float
    scan_sha256: str
    log_sha256: str
    sop_id: str
    sop_tilt_offset: str
    flag: str
    air: tuple[float, ...]  # () if unknown
    registration_sha256: str = ""

    def to_attrs(self) -> dict[str, str]:
        """Return the fields as text; `from_attrs` reads it."""
        return {key: json.dumps(value) for key, value in asdict(self).items()}

    @classmethod
    def from_attrs(cls, attrs: Mapping[str, str]) -> ScanProvenance:
        """Return the provenance written by `to_attrs`."""
        values = {key: json.loads(value) for key, value in attrs.items()}
        return cls(**{**values, "air": tuple(values["air"])})


@dataclass(frozen=True)
class StoredEpoch:
    """An epoch of the series: its location and its provenance."""

    ref: EpochRef
    provenance: ScanProvenance
    science_hash: str
    reference: str
    verdict_reason: str
    verdict: int


def stored_epochs(series: Series, refs: list[EpochRef] | None = None) -> list[StoredEpoch]:
    """Return the epochs of the series with their provenance; raise StoreError if one is damaged."""
    refs = list_epochs(series) if refs is None else refs
    epochs = []
    for path, file_start, series_start, count in contiguous_runs(refs):
        scalars = read_source(path, file_start, series_start, count).scalars
        texts = {name: decode_text(values) for name, values in scalars.items() if values.dtype.kind == "S"}
        epochs += [_stored_epoch(refs[series_start + index], index, scalars, texts) for index in range(count)]
    return epochs


def _stored_epoch(
    ref: EpochRef, index: int, scalars: Mapping[str, np.ndarray[Any, Any]], texts: Mapping[str, list[str]]
) -> StoredEpoch:
    def text(name: str) -> str:
        return texts[name][index] if name in texts else ""

    air = [float(scalars[name][index]) for name in AIR_VARIABLES if name in scalars]
    is_known = len(air) == len(AIR_VARIABLES) and max(air) < FILL / 2
    start_s, end_s = (float(bound) for bound in scalars["time_bnds"][index])
    provenance = ScanProvenance(
        scan_id=text("scan_id"),
        start_s=start_s,
        end_s=end_s,
        scan_sha256=text("scan_sha256"),
        log_sha256=text("log_sha256"),
        sop_id=text("sop_id"),
        sop_tilt_offset=text("sop_tilt_offset"),
        flag=text("flag"),
        air=tuple(air) if is_known else (),
        registration_sha256=text("registration_sha256"),
    )
    verdict = int(scalars["verdict"][index]) if "verdict" in scalars else 0
    return StoredEpoch(
        ref, provenance, text("science_hash"), text("reference_version"), text("verdict_reason"), verdict
    )


class CurrentConfig:
    """Current configuration of the site, evaluated at the time of any scan."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._flags = read_flags(site.flags.file) if site.flags else []
        self._height_m = cache(lambda sop: scanner_height_m(site, sop))
        self._tilt_offset = cache(lambda sop_id: read_tilt_offset(site, sop_id))

    def changed_settings(self, provenance: ScanProvenance) -> list[str]:
        """Return the settings that differ from those of an epoch."""
        return [
            *(
                ["other SOP"]
                if provenance.sop_id and self._sop_id_at(provenance.start_s) != provenance.sop_id
                else []
            ),
            *(
                ["other tilt offset"]
                if provenance.log_sha256 and self._tilt_offset_changed(provenance)
                else []
            ),
            *(["flag set or removed"] if self.flag(provenance) != provenance.flag else []),
        ]

    def flag(self, provenance: ScanProvenance) -> str:
        """Return the flag on the time of a scan, as stored."""
        return roundtrip_text(reasons_for(self._flags, provenance.start_s, provenance.end_s), "sentence")

    def changed_inputs(
        self, provenance: ScanProvenance, scan: ScanFile | None, entry: Entry | None
    ) -> list[str]:
        """Return which input files of an epoch arrived later or have changed.

        A file that no longer exists is not a reason: reprocessing would degrade the epoch.
        """
        changes = self._changed_weather(provenance)
        if scan is None:
            return changes
        if scan.logs and sha256_files(scan.logs) != provenance.log_sha256:
            changes.append(
                "other inclination log" if provenance.log_sha256 else "inclination log arrived later"
            )
        if scan.matrices and sha256_files(scan.matrices) != provenance.registration_sha256:
            is_late = not provenance.registration_sha256
            changes.append("registration arrived later" if is_late else "other registration")
        is_unchanged = entry is not None and (entry.size, entry.mtime_ns) == (scan.size, scan.mtime_ns)
        known_sha256 = entry.sha256 if entry is not None and is_unchanged and entry.sha256 else None
        if (known_sha256 or sha256_files(scan.paths)) != provenance.scan_sha256:
            changes.append("scan file changed")
        return changes

    def _sop_id_at(self, start_s: float) -> str:
        try:
            sop_id = sop_identity_at(self._site, datetime.fromtimestamp(start_s, UTC))
        except ScanError:
            return ""
        return roundtrip_text(sop_id, "text")

    def _tilt_offset_changed(self, provenance: ScanProvenance) -> bool:
        tilt_offset = self._tilt_offset(provenance.sop_id)
        return tilt_offset is not None and json.dumps(asdict(tilt_offset)) != provenance.sop_tilt_offset

    def _changed_weather(self, provenance: ScanProvenance) -> list[str]:
        if self._site.weather is None or not provenance.sop_id:
            return []
        air = self._air_if_known(self._site.weather, provenance)
        if air is None:
            return []
        if not provenance.air:
            return ["weather arrived later"]
        values = (air.temperature_c, air.pressure_hpa, air.humidity_pct)
        return ["other weather"] if np.abs(np.subtract(values, provenance.air)).max() > MIN_AIR_CHANGE else []

    def _air_if_known(self, section: WeatherSection, provenance: ScanProvenance) -> Air | None:
        """Return the air at the middle of a scan; None if the log has a gap, or it or the SOP is unusable."""
        try:
            sop = valid_sop(self._site.sop, datetime.fromtimestamp(provenance.start_s, UTC))
            return air_from_log(section, (provenance.start_s + provenance.end_s) / 2, self._height_m(sop))
        except (ConfigError, ScanError, NotReadyError):
            return None
