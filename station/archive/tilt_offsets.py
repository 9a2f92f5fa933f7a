"""The tilt contained in each SOP, saved when the first scan under it is processed.

Every epoch contains it too, so that a file that is lost or damaged is restored from the archive.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from station.archive.atomic_files import atomic_write
from station.archive.checksums import read_checked_json, to_checked_json
from station.archive.netcdf_layout import Series, decode_text
from station.archive.series.epoch_reader import contiguous_runs, read_source
from station.archive.series.index import list_epochs
from station.config import Site
from station.science.geometry.cyclic_error import NO_CYCLIC_ERROR, CyclicError

FOLDER = "sop_tilt_offset"


def read_tilt_offset(site: Site, sop_id: str) -> CyclicError | None:
    """Return the saved tilt offset of an SOP; None if there is none, or it is damaged."""
    if site.inclination is None or site.inclination.mode == "absolute":
        return None
    content = read_checked_json(_path(site.station.data, sop_id))
    return None if content is None else _from_json(content)


def write_tilt_offset(site: Site, sop_id: str, tilt_offset: CyclicError) -> None:
    """Save the tilt offset of an SOP."""
    with atomic_write(_path(site.station.data, sop_id)) as tmp_path:
        tmp_path.write_text(to_checked_json(asdict(tilt_offset)))


def stored_tilt_offsets(site: Site) -> dict[str, CyclicError]:
    """Return the tilt offset in the first epoch of each SOP; raise StoreError if an epoch is damaged."""
    if site.inclination is None or site.inclination.mode == "absolute":
        return {}
    series = Series(site.station.data, site.station.id, site.grid_cells, site.grid_crs)
    first: dict[str, CyclicError] = {}
    for run in contiguous_runs(list_epochs(series)):
        scalars = read_source(*run).scalars
        if {"sop_id", "sop_tilt_offset"} <= scalars.keys():
            columns = (decode_text(scalars[name]) for name in ("sop_id", "sop_tilt_offset"))
            for sop_id, text in zip(*columns, strict=True):
                tilt_offset = _from_json(json.loads(text)) if text else NO_CYCLIC_ERROR
                if tilt_offset != NO_CYCLIC_ERROR:  # that of an absolute sensor
                    first.setdefault(sop_id, tilt_offset)
    return first


def damaged_tilt_offsets(data: Path) -> list[Path]:
    """Return the files of tilt offsets that are damaged."""
    return [path for path in sorted((data / FOLDER).glob("*.json")) if read_checked_json(path) is None]


def _path(data: Path, sop_id: str) -> Path:
    return data / FOLDER / f"{sop_id}.json"


def _from_json(content: dict[str, list[float]]) -> CyclicError:
    """Return a tilt offset from its fields; JSON has lists for tuples."""
    roll_rad, pitch_rad = ((x[0], x[1], x[2]) for x in (content["roll_rad"], content["pitch_rad"]))
    return CyclicError(roll_rad, pitch_rad)
