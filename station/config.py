"""The site file: read, checked, explained.

One TOML file describes one station. Unknown keys are refused with the nearest right one, all errors are
listed at once, paths are relative to the file.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from station.errors import ConfigError
from station.quantities import Grid, Scanner
from station.sections import Section, SiteFile


class Site(SiteFile):
    """A checked site file whose paths are absolute."""

    path: Path

    @property
    def grid_cells(self) -> Grid:
        """The fixed raster as a quantity."""
        ny, nx = self.grid.shape
        return Grid(self.grid.bounds_m.west, self.grid.bounds_m.north, self.grid.cell_m, nx, ny)

    @property
    def instrument(self) -> Scanner:
        """The scanner as a quantity, angles in radians."""
        return self.scanner.instrument

    @property
    def adjusts(self) -> bool:
        """Whether scans are adjusted to the reference: asked for, and the scanner's place is known."""
        placed = self.scans.frame == "scanner" or self.map.origin is not None
        return self.adjustment.method == "joint" and placed

    @property
    def science_hash(self) -> str:
        """Identify the settings that change numbers of every epoch (16 hex digits).

        What an epoch names itself is left out: its SOP, the air it was measured in, the flag on it.
        """
        told = self.model_dump(
            mode="json",
            include={
                "scans": {"frame", "point_time"},
                "scanner": True,
                "map": {"crs", "origin", "vertical_datum"},
                "grid": True,
                "inclination": {"filter", "cutoff_hz", "mode"},
                "weather": {"max_age_s"},
                "air": True,
                "adjustment": True,
                "uncertainty": True,
                "reference": True,
            },
        )
        if self.map.pop:
            told["pop"] = _sha256(self.map.pop)
        if isinstance(self.adjustment.stable, Path):
            told["adjustment"]["stable"] = _sha256(self.adjustment.stable)
        if isinstance(self.reference.scans, Path):
            told["reference"]["scans"] = _sha256(self.reference.scans)
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_site(folder: Path, like: str) -> Path:
    """Write the commented site file of a known station as `site.toml`; raise ConfigError if one is there."""
    names = {"hef": "hintereisferner", "mammoth": "mammoth"}
    if like not in names:
        raise ConfigError(f"--like {like}: take one of {', '.join(names)}")
    installed = Path(__file__).parent / "sites"
    source = installed if installed.is_dir() else Path(__file__).parents[1] / "config"
    path = folder / "site.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write((source / f"{names[like]}.toml").read_text(encoding="utf-8"))
    except FileExistsError as error:
        raise ConfigError(f"{path}: is there already; nothing is overwritten") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    return path


def read_site(path: str | Path) -> Site:
    """Read and check a site file; raise ConfigError with every fault found, one a line."""
    path = Path(path).absolute()
    if path.is_dir():
        raise ConfigError(f"{path} is a folder: name the site file in it")
    try:
        given = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        site = Site.model_validate({**given, "path": path})
    except ValidationError as error:
        faults = [_explain(fault) for fault in error.errors()]
        raise ConfigError("\n".join([f"{path}: {len(faults)} to mend", *faults])) from error
    site = _absolute(site, path.parent)
    faults = [f"  {key}: no such file: {file}" for key, file in _must_exist(site) if not file.is_file()]
    if faults:
        raise ConfigError("\n".join([f"{path}: {len(faults)} to mend", *faults]))
    return site


def _absolute(site: Site, folder: Path) -> Site:
    """Return the site with every path taken from the folder of its file."""

    def settle(section: Section) -> Section:
        changed: dict[str, Any] = {}
        for key in type(section).model_fields:
            value = getattr(section, key)
            if isinstance(value, Path):
                changed[key] = folder / value.expanduser()
            elif isinstance(value, Section):
                changed[key] = settle(value)
            elif isinstance(value, tuple):
                changed[key] = tuple(settle(one) if isinstance(one, Section) else one for one in value)
        return section.model_copy(update=changed)

    settled = settle(site)
    assert isinstance(settled, Site)  # noqa: S101 - settle keeps the type
    return settled


def _must_exist(site: Site) -> list[tuple[str, Path]]:
    files = [(f"sop[{i}].file", sop.file) for i, sop in enumerate(site.sop)]
    if site.map.pop:
        files.append(("map.pop", site.map.pop))
    if isinstance(site.reference.scans, Path):
        files.append(("reference.scans", site.reference.scans))
    if isinstance(site.adjustment.stable, Path):
        files.append(("adjustment.stable", site.adjustment.stable))
    if site.areas:
        files.append(("areas.file", site.areas.file))
    if site.flags:
        files.append(("flags.file", site.flags.file))
    return files


def _explain(fault: Any) -> str:  # noqa: ANN401 - pydantic's ErrorDetails, a plain dict
    place = ".".join(str(part) for part in fault["loc"] if not _is_union_branch(part))
    if fault["type"] == "extra_forbidden":
        known = _keys_beside(fault["loc"])
        near = difflib.get_close_matches(str(fault["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"known here: {', '.join(known)}"
        return f"  {place}: no such key; {hint}"
    if fault["type"] == "missing":
        return f"  {place}: missing"
    message = fault["msg"].removeprefix("Value error, ")
    shown = "" if isinstance(fault["input"], dict) else f" (given: {fault['input']!r})"
    return f"  {place or 'site file'}: {message}{shown}"


def _is_union_branch(part: object) -> bool:
    """Tell pydantic's own path steps (class names, constraint names) from keys of the file."""
    return isinstance(part, str) and (not part.islower() or "[" in part or part in {"float", "int", "path"})


def _keys_beside(place: tuple[str | int, ...]) -> list[str]:
    model: type[BaseModel] = SiteFile
    for part in place[:-1]:
        field = model.model_fields.get(str(part)) if isinstance(part, str) else None
        found = _models_in(field.annotation) if field else []
        model = found[0] if found else model
    return [field.alias or name for name, field in model.model_fields.items() if name != "path"]


def _models_in(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401 - any type annotation
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models_in(part)]
