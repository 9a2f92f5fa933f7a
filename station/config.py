"""Reading and checking the site file.

One TOML file describes one station. An unknown key is rejected with the closest valid one, all errors are
listed at once, paths are relative to the file.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from datetime import date, datetime, time
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from station._version import __version__
from station.errors import ConfigError
from station.grid_plane import MAP_PLANE, GridPlane
from station.quantities import Grid, Scanner
from station.section_types import Section
from station.sections.inputs import ScannerSection, SopSection
from station.sections.site_file import SiteFile

PLAIN_MESSAGES = {  # instead of those of pydantic, which name Python classes
    "path_type": "give a path in quotes",
    "timezone_aware": "give the time zone: Z at the end for UTC",
    "datetime_from_date_parsing": "give a date and time in UTC, as 2025-07-14T23:00:00Z",
    "datetime_type": "give a date and time in UTC, as 2025-07-14T23:00:00Z",
    "model_type": "give a table of keys",
    "model_attributes_type": "give a table of keys",
}
ALTERNATIVES = {  # to a word, by the fault that pydantic reports for them
    "model_type": "a table of keys",
    "model_attributes_type": "a table of keys",
    "float_parsing": "a number",
    "int_parsing": "a whole number",
}
KINDS = {  # of stations with a commented site file in config/, by the values of --like
    "hef": "hintereisferner",
    "mammoth": "mammoth",
    "low-cost-snow": "low-cost-snow",
    "beach": "beach",
    "rockfall": "rockfall",
}
SCHEMA_NAME = "station-site.schema.json"  # next to the site file, whose first line refers to it


class Site(SiteFile):
    """A checked site file whose paths are absolute."""

    path: Path
    input_faults: tuple[str, ...] = ()  # why optional files cannot be used; see processing/usable_inputs.py

    def last_good(self, key: str) -> Path:
        """Return the path of the last good copy of an optional file: `areas`, `flags` or `stable`."""
        return self.station.data / "last_good" / key

    @property
    def grid_cells(self) -> Grid:
        """The grid of the products."""
        ny, nx = self.grid.shape
        plane = MAP_PLANE if self.grid.plane is None else GridPlane(**self.grid.plane.model_dump())
        return Grid(self.grid.bounds_m.west, self.grid.bounds_m.north, self.grid.cell_m, nx, ny, plane)

    @property
    def grid_crs(self) -> str | None:
        """The CRS of the grid: that of the map; None if it lies on a plane, whose coordinates are its own."""
        return self.map.crs if self.grid.plane is None else None

    @property
    def instrument(self) -> Scanner:
        """The scanner of the table `[scanner]`, angles in radians."""
        return self.scanner.instrument

    def scanner_of(self, sop: SopSection | None) -> ScannerSection:
        """Return the scanner that stands at an SOP: its own, or that of the table `[scanner]`."""
        return self.scanner if sop is None or sop.scanner is None else sop.scanner

    def with_scanner_of(self, sop: SopSection | None) -> Site:
        """Return the site with the scanner that stands at an SOP in the table `[scanner]`."""
        return self.model_copy(update={"scanner": self.scanner_of(sop)})

    @property
    def scanners(self) -> dict[str, ScannerSection]:
        """All scanners by their keys in the site file."""
        own = {f"sop[{i}].scanner": sop.scanner for i, sop in enumerate(self.sop) if sop.scanner is not None}
        return {"scanner": self.scanner} | own

    @property
    def adjusts(self) -> bool:
        """True if scans are adjusted to the reference: requested, and the scanner's position is known."""
        position_known = self.scans.frame == "scanner" or self.map.origin is not None
        return self.adjustment.method == "joint" and position_known

    @property
    def science_hash(self) -> str:
        """Hash of the settings that change the numbers of every epoch (16 hex digits).

        It excludes what each epoch records itself: its SOP, its air, its flag.
        """
        settings = self.model_dump(
            mode="json",
            include={
                "scans": {"frame", "point_time", "intensity"},
                "scanner": True,
                "map": {"crs", "origin", "vertical_datum"},
                "grid": {"bounds_m", "cell_m", "min_points"},
                "inclination": {"filter", "cutoff_hz", "mode"},
                "weather": {"max_age_s"},
                "air": True,
                "adjustment": True,
                "uncertainty": True,
                "reference": True,
            },
        )
        if self.scans.convert or self.scans.columns:  # without them, the hash is that of earlier versions
            settings["scans"] |= self.scans.model_dump(mode="json", include={"columns", "convert"})
        if self.grid.plane:
            settings["grid"]["plane"] = self.grid.plane.model_dump(mode="json")
        if self.registration:
            settings["registration"] = self.registration.model_dump(mode="json", exclude={"suffix", "wait_s"})
        if self.map.pop:
            settings["pop"] = _sha256(self.map.pop)
        if isinstance(self.adjustment.stable, Path):
            settings["adjustment"]["stable"] = _sha256(self.adjustment.stable)
        if isinstance(self.reference.scans, Path):
            settings["reference"]["scans"] = _sha256(self.reference.scans)
        return _hash(settings)

    @property
    def judging_conditions(self) -> str:
        """Version, and hash of the settings, limits and SOP files that decide whether a scan can be used."""
        settings = self.model_dump(
            mode="json",
            include={
                "scans": {"frame", "name", "zone", "columns", "convert", "point_time", "intensity"}
                | {"timeout_s"},
                "service": {"memory_gb"},
                "epoch": {"name", "window_s"},
                "registration": True,
                **dict.fromkeys(
                    ("scanner", "sop", "map", "grid", "inclination", "weather", "air", "adjustment",
                     "uncertainty", "reference"),
                    True,
                ),
            },
        )  # fmt: skip
        files = [*(sop.file for sop in self.sop), *filter(None, [self.map.pop])]
        settings["files"] = [_sha256(file) if file.is_file() else "" for file in files]
        return f"{__version__} {_hash(settings)}"


def _hash(settings: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def site_schema() -> str:
    """Return the JSON Schema of the site file, from which editors complete and check keys.

    In the terms of draft 7, which editors of TOML support (taplo, Even Better TOML).
    """
    schema = {"$schema": "http://json-schema.org/draft-07/schema#", **SiteFile.model_json_schema()}
    schema |= {"title": "Site file of a station", "description": "One TOML file describes one station."}
    text = json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
    return text.replace("$defs", "definitions").replace('"prefixItems"', '"items"')


def write_site(folder: Path, like: str) -> Path:
    """Write the commented site file of a kind of station as `site.toml`, and its JSON Schema for editors.

    Returns the path of the site file; raises ConfigError if it exists.
    """
    if like not in KINDS:
        raise ConfigError(f"--like {like}: choose from {', '.join(KINDS)}")
    installed = Path(__file__).parent / "sites"
    source = installed if installed.is_dir() else Path(__file__).parents[1] / "config"
    path = folder / "site.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(f"#:schema ./{SCHEMA_NAME}\n")
            file.write((source / f"{KINDS[like]}.toml").read_text(encoding="utf-8"))
        (folder / SCHEMA_NAME).write_text(site_schema(), encoding="utf-8")
    except FileExistsError as error:
        raise ConfigError(f"{path}: already exists; nothing is overwritten") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    return path


def read_site(path: str | Path) -> Site:
    """Return a checked site file; raise ConfigError with all faults, one per line."""
    path = Path(path).absolute()
    if path.is_dir():
        raise ConfigError(f"{path} is a folder: give the site file in it")
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        site = Site.model_validate({**document, "path": path, "input_faults": ()})
    except ValidationError as error:
        faults = [_explain(fault) for fault in _merge_branches(error.errors())]
        raise ConfigError("\n".join([f"{path}: {len(faults)} to fix", *faults])) from error
    site = _absolute(site, path.parent)
    faults = [
        *(f"  {key}: {fault}" for key, file in _required_files(site) if (fault := _file_fault(file))),
        *_folder_faults(site),
    ]
    if faults:
        raise ConfigError("\n".join([f"{path}: {len(faults)} to fix", *faults]))
    return site


def _absolute(site: Site, folder: Path) -> Site:
    """Return the site with absolute paths, resolved from the folder of its file."""

    def resolve(section: Section) -> Section:
        changed: dict[str, Any] = {}
        for key in type(section).model_fields:
            value = getattr(section, key)
            if isinstance(value, Path):
                changed[key] = folder / value.expanduser()
            elif isinstance(value, Section):
                changed[key] = resolve(value)
            elif isinstance(value, tuple):
                changed[key] = tuple(resolve(item) if isinstance(item, Section) else item for item in value)
        return section.model_copy(update=changed)

    resolved = resolve(site)
    assert isinstance(resolved, Site)  # noqa: S101 - resolve keeps the type
    return resolved


def _file_fault(file: Path) -> str:
    """Return why a file cannot be used, '' if it can."""
    try:
        with file.open("rb"):
            return ""
    except FileNotFoundError:
        return f"no such file: {file}"
    except OSError as error:
        return f"{file}: cannot be read: {error.strerror}"


def _folder_faults(site: Site) -> list[str]:
    """Return a fault if data folder or mirror are in the inbox, which is not to be changed."""
    inbox, data = site.scans.inbox.resolve(), site.station.data.resolve()
    if inbox.is_relative_to(data) or data.is_relative_to(inbox):
        return [f"  station.data: {data} and the inbox, {inbox}, must be separate folders"]
    if site.mirror and site.mirror.folder.resolve().is_relative_to(inbox):
        return [f"  mirror.folder: {site.mirror.folder} must not be in the inbox"]
    return []


def _required_files(site: Site) -> list[tuple[str, Path]]:
    files = [(f"sop[{i}].file", sop.file) for i, sop in enumerate(site.sop)]
    if site.map.pop:
        files.append(("map.pop", site.map.pop))
    if isinstance(site.reference.scans, Path):
        files.append(("reference.scans", site.reference.scans))
    optional = [
        ("stable", "adjustment.stable", site.adjustment.stable),
        ("areas", "areas.file", site.areas and site.areas.file),
        ("flags", "flags.file", site.flags and site.flags.file),
    ]
    return files + [
        (name, path)
        for key, name, path in optional
        if isinstance(path, Path) and not site.last_good(key).is_file()
    ]


def _explain(fault: Any) -> str:  # noqa: ANN401 - pydantic's ErrorDetails, a plain dict
    location = ".".join(str(part) for part in fault["loc"] if not _is_union_branch(part))
    if fault["type"] == "extra_forbidden":
        valid_keys = _sibling_keys(fault["loc"])
        closest = difflib.get_close_matches(str(fault["loc"][-1]), valid_keys, n=1, cutoff=0.5)
        hint = f"did you mean {closest[0]!r}?" if closest else f"valid keys: {', '.join(valid_keys)}"
        return f"  {location}: no such key; {hint}"
    if fault["type"] == "missing":
        return f"  {location}: missing"
    message = PLAIN_MESSAGES.get(fault["type"], fault["msg"].removeprefix("Value error, "))
    message = message.replace("Input should", "should")
    given = fault["input"]
    given_text = "" if isinstance(given, (dict, BaseModel)) else f" (given: {_as_toml(given)})"
    return f"  {location or 'site file'}: {message}{given_text}"


def _as_toml(value: object) -> str:
    """Return a value much as it stands in the site file."""
    if isinstance(value, (datetime, date, time)):
        return value.isoformat()
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _merge_branches(faults: list[Any]) -> list[Any]:
    """Return the faults with one for each key: a key with several types reports a fault for each of them."""
    best: dict[tuple[object, ...], Any] = {}
    alternatives: dict[tuple[object, ...], str] = {}
    for fault in faults:
        location = tuple(part for part in fault["loc"] if not _is_union_branch(part))
        if fault["type"] in ALTERNATIVES:
            alternatives[location] = ALTERNATIVES[fault["type"]]
        if location not in best or fault["type"] == "literal_error":
            best[location] = fault
    for location, fault in best.items():
        if fault["type"] == "literal_error" and location in alternatives:
            best[location] = {**fault, "msg": f"{fault['msg']} or {alternatives[location]}"}
    nested = {location[:n] for location in best for n in range(len(location))}
    return [fault for location, fault in best.items() if not location or location not in nested]


def _is_union_branch(part: object) -> bool:
    """Return True for path steps of pydantic (class and constraint names), False for keys of the file."""
    return isinstance(part, str) and (
        not part.islower()
        or "[" in part
        or part.startswith("constrained-")
        or part in {"float", "int", "path"}
    )


def _sibling_keys(location: tuple[str | int, ...]) -> list[str]:
    model: type[BaseModel] = SiteFile
    for part in location[:-1]:
        field = model.model_fields.get(str(part)) if isinstance(part, str) else None
        models = _models_in(field.annotation) if field else []
        model = models[0] if models else model
    return [field.alias or name for name, field in model.model_fields.items() if name != "path"]


def _models_in(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401 - any type annotation
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models_in(part)]
