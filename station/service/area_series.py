"""The curves of `areas.nc` as alarms and the digest need them: usable epochs only, from some time on."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np

from station.archive.layout import strings
from station.archive.variables import FILL, VERDICTS
from station.config import Site
from station.errors import StoreError
from station.quantities import Floats


@dataclass(frozen=True)
class Curve:
    """Mean change of one area against the reference and its one sigma [m], over time [s]; (n,) each."""

    name: str
    time_s: Floats
    change_m: Floats
    sigma_m: Floats


def read_curves(site: Site, from_utc_s: float) -> list[Curve]:
    """Return the curve of each area, without epochs that are unusable or do not see it; [] without a file.

    Raises StoreError where a file cannot be read.
    """
    areas, series = (site.station.data / name for name in ("areas.nc", "series.nc"))
    if not (areas.is_file() and series.is_file()):
        return []
    try:
        with h5py.File(series, "r") as file:
            newest = slice(int(np.searchsorted(file["time"][:], from_utc_s)), None)
            files = strings(file["epoch_file"][newest])
            usable = file["verdict"][newest] != VERDICTS.index("unusable")
        with h5py.File(areas, "r") as file:
            newest = slice(int(np.searchsorted(file["time"][:], from_utc_s)), None)
            time_s = np.asarray(file["time"][newest], dtype=np.float64)
            named = strings(file["epoch_file"][newest])
            names = [name.tobytes().rstrip(b"\0").decode() for name in file["area_name"][:]]
            change_m, sigma_m = (
                np.asarray(file[name][newest], dtype=np.float64)
                for name in ("mean_change", "mean_change_uncertainty")
            )
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise StoreError(f"{areas}: cannot be read with series.nc: {error}") from error
    good = {name for name, is_good in zip(files, usable, strict=True) if is_good}
    chosen = np.array([name in good for name in named], dtype=bool)
    curves = []
    for index, name in enumerate(names):
        seen = chosen & (change_m[:, index] != FILL) & (sigma_m[:, index] != FILL)
        curves.append(Curve(name, time_s[seen], change_m[seen, index], sigma_m[seen, index]))
    return curves


def newest_epoch_s(site: Site) -> float | None:
    """Return the time of the newest epoch in `areas.nc`; None where there is none that can be read."""
    try:
        with h5py.File(site.station.data / "areas.nc", "r") as file:
            return float(file["time"][-1])
    except (OSError, RuntimeError, KeyError, ValueError):
        return None
