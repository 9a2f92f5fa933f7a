"""Level and rate of the blocks of the page at the end of each day, as integers for its curves.

They are means over the cells of a block, in which systematic errors do not average out. The codes of a day
are kept beside the tiles under the name of its file, which never changes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from station.archive.derived.level_files import is_day, level_files, level_raster
from station.archive.netcdf_layout import Series
from station.archive.raster_io import Array
from station.archive.read_errors import read_errors
from station.errors import StoreError
from station.products.viewer.block_codes import (
    MAX_CHANGE,
    QUANTUM_M,
    load_codes,
    max_coverage,
    save_codes,
    sigma_code,
)
from station.products.viewer.level_tiles import read_head
from station.quantities import Bools, Floats
from station.queries.block_sums import Sums

MAX_DAYS = 60  # newest days of a curve
MAX_READ = 4  # files read at once; a store older than the page is read over several calls
RATE_QUANTUM_M = 0.0001  # of the rate, per day


class LevelCodes:
    """The codes of days of one reference, those of its known blocks (n,) row by row."""

    def __init__(self, series: Series, folder: Path, version: str, known: Bools, cells: int) -> None:
        """Keep them in `folder`; `known` (by, bx) are blocks of `cells` × `cells`."""
        self._series, self._folder, self._version = series, folder, version
        self._known, self._cells = known, cells

    def keep(self, progress: Callable[[], None]) -> list[str]:
        """Keep the codes of the newest days, and no others; return the names of those there, in order.

        A day whose file is damaged is left out until the file is computed again.
        """
        paths = [path for path in level_files(self._series) if is_day(path)][-MAX_DAYS:]
        kept = {path.stem for path in self._folder.glob("*.npz")}
        for name in kept - {path.stem for path in paths}:
            self._path(name).unlink(missing_ok=True)
        names, read_count = list[str](), 0
        for path in reversed(paths):
            if path.stem not in kept:
                if read_count == MAX_READ:
                    continue
                read_count += 1
                try:
                    head = read_head(path)
                    if head.version != self._version:
                        break  # as have all days before
                    self._compute(path, head.time_s)
                except StoreError:
                    continue
                progress()
            names.append(path.stem)
        return names[::-1]

    def read(self, name: str) -> tuple[float, Sums] | None:
        """Return the time [s] and the codes of a day; None if they are damaged, to be computed again."""
        count = int(np.count_nonzero(self._known))
        codes = load_codes(self._path(name), count)
        if codes is None:
            self._path(name).unlink(missing_ok=True)
            return None
        return float(codes.pop("time_s")[0]), codes

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.npz"

    def _compute(self, path: Path, time_s: float) -> None:
        count, level_m, *level_sigma_m = self._block_means(path, "level")
        _, rate_m, *rate_sigma_m = self._block_means(path, "rate")
        coverage = count / self._cells**2
        # The random sigmas as if the whole block were known, as those of epochs.
        random, rate_random = (
            sigma_code(sigma[0] * np.sqrt(coverage)) for sigma in (level_sigma_m, rate_sigma_m)
        )
        values = {
            "change": np.round(level_m / QUANTUM_M),
            "random": random,
            "systematic": sigma_code(level_sigma_m[1]),
            "coverage": np.ceil(coverage * max_coverage(self._cells)),
            "rate": np.round(rate_m / RATE_QUANTUM_M),
            "rate_random": rate_random,
            "rate_systematic": sigma_code(rate_sigma_m[1]),
        }
        save_codes(
            self._path(path.stem),
            {name: np.clip(codes, -MAX_CHANGE, MAX_CHANGE).astype(np.int32) for name, codes in values.items()}
            | {"time_s": np.array([time_s])},
        )

    def _block_means(self, path: Path, quantity: str) -> tuple[Floats, ...]:
        """Return count, mean, random and systematic sigma of the cells of each known block (n,)."""
        value = _read(path, quantity)
        count = self._sums(np.isfinite(value))
        cells = np.maximum(count, 1)
        mean = self._sums(np.nan_to_num(value)) / cells
        random_m2 = self._sums(np.nan_to_num(_read(path, f"{quantity}_random_uncertainty")) ** 2)
        systematic = self._sums(np.nan_to_num(_read(path, f"{quantity}_systematic_uncertainty")))
        return count, mean, np.sqrt(random_m2) / cells, systematic / cells

    def _sums(self, values: Array) -> Floats:
        """Return the sums (n,) of the values of cells (ny, nx) over each known block."""
        rows = np.add.reduceat(values, np.arange(0, values.shape[0], self._cells), axis=0, dtype=np.float32)
        return np.add.reduceat(rows, np.arange(0, values.shape[1], self._cells), axis=1)[self._known]


def _read(path: Path, name: str) -> Array:
    with read_errors(path):
        return np.asarray(level_raster(path, name))
