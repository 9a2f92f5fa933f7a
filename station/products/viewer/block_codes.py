"""Values of the blocks of an epoch as integers, for the curves of the page, kept beside its tiles."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.errors import StoreError
from station.products.viewer.near_blocks import sigma_ratio
from station.products.viewer.tiles import Array, replace_file
from station.quantities import Floats, Ints
from station.queries.block_sums import Sums
from station.queries.blocks import BlockQueries, SurfaceBlocks
from station.science.analysis.calibration import group_means

QUANTUM_M = 0.001  # of the change
SIGMA_MIN_M, SIGMA_STEP = 1e-5, 0.02  # code of a sigma: 1 + ln(sigma / minimum) / step
MAX_COVERAGE = 255  # code of a block that was observed completely, unless it has fewer cells
MAX_CHANGE = 2**21  # code of a change of 1 km; a difference of two has 3 bytes
FORMAT = 6  # of the codes: others are computed again
COMMON_BLOCKS = (5, 12)  # along the sides of tiles, of which codes have the errors that scans have in common
MAX_READ = 24  # epochs read at once; a store older than the page is read over several calls
DTYPES = {"change": np.int32, "random": np.uint16, "systematic": np.uint16, "coverage": np.uint8}


@dataclass(frozen=True)
class CurveEpoch:
    """An epoch of the curves."""

    ref: EpochRef
    start_s: float
    is_usable: bool
    has_map: bool = True


def sigma_code(sigma_m: Floats) -> Ints:
    """Return codes of sigmas [m], to 1 %; 0 for no error."""
    with np.errstate(divide="ignore"):
        code = 1 + np.log(np.maximum(sigma_m, 0) / SIGMA_MIN_M) / SIGMA_STEP
    return np.clip(np.round(np.nan_to_num(code, neginf=0)), 0, 65535).astype(np.int64)


def max_coverage(cells: int) -> int:
    """Return the code of a block of `cells` × `cells` that was observed completely."""
    return min(cells**2, MAX_COVERAGE)


class BlockCodes:
    """The codes of epochs of one reference, those of its known blocks (n,) row by row."""

    def __init__(self, series: Series, folder: Path, queries: BlockQueries, newest: EpochRef) -> None:
        self._series, self._queries, self._newest = series, queries, newest
        self.newest_blocks = queries.read(newest)
        self.version = self.newest_blocks.cells.reference.version
        self.surface: SurfaceBlocks = queries.surface(newest, self.newest_blocks.rock > 0.5)
        self.count = int(np.count_nonzero(self.surface.known))
        self.max_coverage = max_coverage(queries.cells)
        self._folder, self.cache = folder, folder / f"{self.version}_{FORMAT}"

    def keep(self, epochs: Sequence[CurveEpoch], progress: Callable[[], None]) -> set[str]:
        """Keep the codes of epochs, and no others; return the file names of those that are there now.

        Of those that are missing, at most MAX_READ are read, the newest first.
        """
        names = {epoch.ref.epoch_file for epoch in epochs}
        self._delete_others(names)
        known = {path.name.removesuffix(".npz") for path in self.cache.glob("*.npz")}
        missing = [epoch for epoch in reversed(epochs) if epoch.ref.epoch_file not in known]
        for epoch in missing[:MAX_READ]:
            self._compute(epoch)
            known.add(epoch.ref.epoch_file)
            progress()
        return known

    def _delete_others(self, names: set[str]) -> None:
        """Delete what was kept of other epochs and other references."""
        for path in self._folder.glob("*/"):
            if path != self.cache:
                shutil.rmtree(path, ignore_errors=True)
        for path in self.cache.glob("*.npz"):
            if path.name.removesuffix(".npz") not in names:
                path.unlink(missing_ok=True)

    def read(self, epoch: CurveEpoch) -> Sums:
        """Return the codes of an epoch; those that are damaged are computed again."""
        codes = load_codes(self._path(epoch), self.count)
        return self._compute(epoch) if codes is None else codes

    def _path(self, epoch: CurveEpoch) -> Path:
        return self.cache / f"{epoch.ref.epoch_file}.npz"

    def _compute(self, epoch: CurveEpoch) -> Sums:
        is_newest = epoch.ref == self._newest
        blocks = self.newest_blocks if is_newest else self._queries.read(epoch.ref)
        systematic_m2 = np.zeros(blocks.count.shape)
        if blocks.jacobian is not None and blocks.shared is not None:
            systematic_m2[blocks.observed] = blocks.jacobian.variance(blocks.shared)
        coverage = blocks.count / self._queries.cells**2
        values = {
            "change": np.round(blocks.change_m / QUANTUM_M),
            # As if the whole block were observed: this changes less from scan to scan.
            "random": sigma_code(np.sqrt(blocks.random_m2 * coverage)),
            "systematic": sigma_code(np.sqrt(systematic_m2)),
            "coverage": np.ceil(coverage * self.max_coverage),
        }
        codes = {
            name: np.clip(raster, -MAX_CHANGE, MAX_CHANGE)[self.surface.known].astype(DTYPES[name])
            for name, raster in values.items()
        }
        errors = blocks.cells.shared and blocks.cells.shared.change_errors
        if errors and blocks.cells.adjusted:
            codes["pattern"] = errors.polar_change
            for size in COMMON_BLOCKS:
                gradient = self._gradient(size)
                if gradient.shape[1] == len(errors.modes):
                    common_m = np.linalg.norm(gradient @ errors.modes, axis=1)
                    codes[f"common_{size}"] = sigma_code(common_m).astype(np.uint16)
        save_codes(self._path(epoch), codes)
        return codes

    def pattern(self, epoch: CurveEpoch) -> Floats | None:
        """Return the pattern of the change of an epoch, which common errors depend on; None if unknown."""
        return self.read(epoch).get("pattern")

    def _gradient(self, size: int) -> Array:
        """Return the derivatives (tiles, p) of the mean of each tile of blocks, once for a reference."""
        path = self.cache / f"tiles_{size}.npy"
        with suppress(OSError, ValueError, EOFError):
            return np.asarray(np.load(path))
        if self.surface.jacobian is None:
            return np.zeros((0, 0), np.float32)
        row, column = np.nonzero(self.surface.known)
        _, tile = np.unique(row // size * self.surface.known.shape[1] + column // size, return_inverse=True)
        means = group_means(tile) @ self.surface.jacobian.to_sparse()
        gradient = np.asarray(means.toarray(), np.float32)
        buffer = io.BytesIO()
        np.save(buffer, gradient)
        with suppress(StoreError, OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, buffer.getvalue())
        return gradient

    @cached_property
    def near_ratio(self) -> Floats:
        """Return the systematic sigma (n,) of each block in sigmas of its middle, once for a reference."""
        path, jacobian = self.cache / "near.bin", self.surface.jacobian
        with suppress(OSError, ValueError):
            ratio = np.fromfile(path)
            if len(ratio) == self.count:
                return ratio
        shared = self.newest_blocks.shared
        if jacobian is None or shared is None:
            return np.ones(self.count)
        offset_m = self.surface.observation.offset_m
        ratio = sigma_ratio(jacobian, shared, offset_m, self._series.grid.cell_m, self._queries.cells)
        with suppress(StoreError, OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, ratio.tobytes())
        return ratio


def load_codes(path: Path, count: int) -> Sums | None:
    """Return kept codes; None if there are none, or if they are damaged."""
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            codes = {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return codes if all(len(codes.get(name, ())) == count for name in DTYPES) else None


def save_codes(path: Path, codes: Sums) -> None:
    """Keep codes; skipped without an error if that fails."""
    tmp_path = path.with_name(f".{path.name}.part")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tmp_path.open("wb") as file:
            np.savez(file, **codes)  # type: ignore[arg-type]
        tmp_path.replace(path)
