"""How `series.nc` was made, noted beside it: the next epoch is added without opening those before.

Only a memory: where it is gone or anything is not as noted, the series is made from its files anew.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from station import __version__
from station.archive.layout import Series
from station.archive.sources import Parameters, Source, read_source
from station.archive.store import Named, listing, stored
from station.archive.variables import VARIABLES

NOTE = ".series.json"


@dataclass(frozen=True)
class Made:
    """What a `series.nc` was made of."""

    sources: list[Source]  # without their words
    parameters: Parameters
    last_s: float  # time of the last epoch
    newest_start_s: float  # of any epoch

    @property
    def count(self) -> int:
        """Return how many epochs it has."""
        return sum(source.count for source in self.sources)


def note(series: Series, made: Made) -> None:
    """Remember what the `series.nc` just written was made of; where there is no room, it is forgotten."""
    path = series.folder / NOTE
    told = {
        "of": _frame(series),
        "series": _stamp(series.path),
        "files": sorted(listing(series)),
        "parameters": made.parameters,
        "last_s": made.last_s,
        "newest_start_s": made.newest_start_s,
        "sources": [
            {
                "name": str(one.path.relative_to(series.folder)),
                "stamp": _stamp(one.path),
                "rows": [one.first, one.at, one.count],
                "shapes": one.shapes,
                "parameters": None if one.parameters == made.parameters else one.parameters,
            }
            for one in made.sources
        ],
    }
    beside = path.with_name(f"{NOTE}.part")
    with suppress(OSError):
        beside.write_text(json.dumps(told), encoding="utf-8")
        beside.replace(path)


def newer(series: Series) -> tuple[Made, list[Source]] | None:
    """Return what `series.nc` was made of and the epochs stored since, if these all come after those.

    None where anything else has happened to the files of the store. Raises StoreError where a new epoch is
    damaged.
    """
    told = _noted(series)
    if told is None:
        return None
    sources = [_source(series, one, told["parameters"]) for one in told["sources"]]
    made = Made(sources, told["parameters"], told["last_s"], told["newest_start_s"])
    came = [stored(series.folder / name) for name in listing(series) - set(told["files"])]
    epochs = sorted((one for one in came if one is not None), key=lambda one: one.start)
    if len(epochs) < len(came):  # a joined file
        return None
    start_s, last_s = made.newest_start_s, made.last_s
    fresh: list[Source] = []
    for one in epochs:
        source = read_source(one.path, 0, made.count + len(fresh), 1)
        time_s = float(source.words["time"][0])
        known = all(made.parameters.get(name) == unit for name, unit in source.parameters.items())
        if one.start.timestamp() <= start_s or time_s <= last_s or not known:
            return None
        start_s, last_s = one.start.timestamp(), time_s
        fresh.append(source)
    return Made(sources, made.parameters, last_s, start_s), fresh


def settled(series: Series) -> Named | None:
    """Return the epochs of the series if the store is just as when `series.nc` was made; else None."""
    told = _noted(series)
    return Named(series) if told is not None and listing(series) == set(told["files"]) else None


def _noted(series: Series) -> dict[str, Any] | None:
    """Return the note if it is of this `series.nc` and of files that are as they were."""
    try:
        told: dict[str, Any] = json.loads((series.folder / NOTE).read_text(encoding="utf-8"))
        same = told["of"] == _frame(series) and told["series"] == _stamp(series.path)
        same = same and all(_stamp(series.folder / one["name"]) == one["stamp"] for one in told["sources"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return told if same else None


def _source(series: Series, told: dict[str, Any], parameters: Parameters) -> Source:
    own = told["parameters"]
    first, at, count = told["rows"]
    return Source(
        series.folder / told["name"],
        first,
        at,
        count,
        words={},
        shapes={name: tuple(shape) for name, shape in told["shapes"].items()},
        parameters=parameters if own is None else own,
    )


def _frame(series: Series) -> str:
    """Identify what a series says whatever its epochs are."""
    told = [__version__, series.station_id, series.grid, series.crs, series.vertical_datum, series.name]
    return hashlib.sha256(repr([*told, series.institution, VARIABLES]).encode()).hexdigest()


def _stamp(path: Path) -> list[int]:
    """Return what changes when a file is written or replaced."""
    status = path.stat()
    return [status.st_ino, status.st_size, status.st_mtime_ns]
