"""Curves of `areas.nc` for alarms and the digest: usable epochs only, from a given time on."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np

from station.archive.netcdf_layout import decode_text
from station.archive.read_errors import read_errors
from station.archive.schema import FILL, VERDICTS
from station.archive.series.epoch_reader import middle
from station.config import Site
from station.quantities import Floats


@dataclass(frozen=True)
class AreaCurve:
    """Mean change of an area against the reference and its one sigma [m], over time [s]; (n,) each."""

    name: str
    time_s: Floats
    change_m: Floats
    sigma_m: Floats


def read_curves(site: Site, from_utc_s: float) -> list[AreaCurve]:
    """Return the curve of each area from `from_utc_s` on; [] without a file.

    Epochs that are unusable or did not observe the area are left out. Raises StoreError if a file cannot be
    read.
    """
    areas, series = (site.station.data / name for name in ("areas.nc", "series.nc"))
    if not (areas.is_file() and series.is_file()):
        return []
    with read_errors(areas):
        with h5py.File(series, "r") as file:
            rows = slice(int(np.searchsorted(middle(file["time_bnds"][:]), from_utc_s)), None)
            series_files = decode_text(file["epoch_file"][rows])
            usable = file["verdict"][rows] != VERDICTS.index("unusable")
        with h5py.File(areas, "r") as file:
            rows = slice(int(np.searchsorted(file["time"][:], from_utc_s)), None)
            time_s = np.asarray(file["time"][rows], dtype=np.float64)
            epoch_files = decode_text(file["epoch_file"][rows])
            names = [name.tobytes().rstrip(b"\0").decode() for name in file["area_name"][:]]
            change_m, sigma_m = (
                np.asarray(file[name][rows], dtype=np.float64)
                for name in ("mean_change", "mean_change_uncertainty")
            )
    usable_files = {name for name, is_usable_file in zip(series_files, usable, strict=True) if is_usable_file}
    is_usable = np.array([name in usable_files for name in epoch_files], dtype=bool)
    curves = []
    for index, name in enumerate(names):
        observed = is_usable & (change_m[:, index] != FILL) & (sigma_m[:, index] != FILL)
        curves.append(AreaCurve(name, time_s[observed], change_m[observed, index], sigma_m[observed, index]))
    return curves


def newest_epoch_s(site: Site) -> float | None:
    """Return the time of the newest epoch in `areas.nc` [s]; None if none can be read."""
    try:
        with h5py.File(site.station.data / "areas.nc", "r") as file:
            return float(file["time"][-1])
    except (OSError, RuntimeError, KeyError, ValueError):
        return None
