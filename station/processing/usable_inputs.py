"""Optional input files that a person may break at any time: the last good version stays in use.

Areas, flags and stable ground are copied to `<data>/last_good/` whenever they can be used. While one cannot,
its copy takes its place, so that scans are measured and stored as before; the fault is reported.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from station.archive.atomic_files import atomic_write
from station.config import Site
from station.errors import NotReadyError, ScanError, StationError, StoreError
from station.processing.scanner_pose import scanner_height_m
from station.processing.scans.scan_air import air_from_log
from station.readers.flags import read_flags
from station.readers.polygons import LAYER_SUFFIXES, read_polygons, to_geojson
from station.readers.regular_file import open_regular
from station.readers.sop import valid_sop

T = TypeVar("T")
Check = Callable[[Path], object]  # raises StationError if a file cannot be used
Serialise = Callable[[Any], bytes]  # the content of a file's copy, from what its check returns

MAX_BYTES = 1 << 26  # of an optional file; a polygon of a million corners has half of it


def with_usable_inputs(task: Callable[..., T], site: Site, *args: object) -> T:
    """Return the result of a task on the site with usable inputs; it runs in a worker process."""
    return task(usable_site(site, save=True), *args)


def usable_site(site: Site, *, save: bool = False) -> Site:
    """Return the site with the last good copy in place of each optional file that cannot be used.

    Without a copy, the file is left out: no areas, no flags, or stable ground found automatically.
    `input_faults` of the result says why. With `save`, files that can be used are copied.
    """
    faults: list[str] = []

    def usable(key: str, path: Path, check: Check) -> Path | None:
        copy = site.last_good(key)
        try:
            _check_and_save(path, copy, check, save=save, serialise=to_text(path))
        except StationError as fault:
            exists = copy.is_file()
            faults.append(f"{fault}: {'its last good version is used' if exists else 'it is not used'}")
            return copy if exists else None
        return path

    def check_polygons(path: Path) -> object:
        return read_polygons(path, site.grid_crs)

    def to_text(path: Path) -> Serialise | None:
        """A layer consists of several files, or is known by its suffix: its copy is a GeoJSON."""
        if path.suffix.lower() not in LAYER_SUFFIXES:
            return None
        return lambda polygons: to_geojson(polygons, site.grid_crs).encode()

    changes: dict[str, object] = {}
    if site.areas:
        file = usable("areas", site.areas.file, check_polygons)
        changes["areas"] = site.areas.model_copy(update={"file": file}) if file else None
    if site.flags:
        file = usable("flags", site.flags.file, read_flags)
        changes["flags"] = site.flags.model_copy(update={"file": file}) if file else None
    if isinstance(site.adjustment.stable, Path):
        file = usable("stable", site.adjustment.stable, check_polygons)
        changes["adjustment"] = site.adjustment.model_copy(update={"stable": file or "auto"})
    return site.model_copy(update={**changes, "input_faults": tuple(faults)})


def weather_fault(site: Site) -> str:
    """Return why the weather log cannot be used at present, '' if it can; a gap in it is no fault."""
    if site.weather is None:
        return ""
    try:
        height_m = scanner_height_m(site, valid_sop(site.sop, datetime.now(UTC))) if site.sop else None
    except StationError:  # of the SOP: reported with the scan
        height_m = None
    try:
        air_from_log(site.weather, time.time(), height_m)
    except (ScanError, NotReadyError) as error:
        return f"weather log unusable: {error}"
    return ""


def _check_and_save(path: Path, copy: Path, check: Check, *, save: bool, serialise: Serialise | None) -> None:
    """Raise StationError if a file cannot be used; else, with `save`, bring its copy up to date."""
    try:
        with open_regular(path) as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise StationError(f"{path}: larger than {MAX_BYTES >> 20} MB")
        if copy.is_file() and copy.read_bytes() == content:
            return
        checked = check(path)
        if serialise is not None:
            content = serialise(checked)
            save = save and not (copy.is_file() and copy.read_bytes() == content)
    except OSError as error:
        raise StationError(f"{path}: cannot be read: {error.strerror}") from error
    except MemoryError as error:
        raise StationError(f"{path}: needs too much memory") from error
    if save:
        with suppress(StoreError), atomic_write(copy) as tmp_path:  # a full disk is reported elsewhere
            tmp_path.write_bytes(content)
            check(tmp_path)  # the file itself may have changed since it was read
