"""Files that hold epochs: what of each is small is read at once, whole chunks are copied as they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from station.archive.layout import strings
from station.archive.store import Row
from station.archive.variables import VARIABLES
from station.errors import StoreError

Parameters = dict[str, str]  # unit of each shared parameter, by its name

LIGHT = tuple(row for row in VARIABLES if not row.is_heavy)
HEAVY = tuple(row for row in VARIABLES if row.is_heavy)
ORDINARY = ("earliest", "v110")  # bounds of the format of a file that every tool reads
LAYOUT = ("chunks", "dtype", "compression", "compression_opts", "shuffle")


@dataclass(frozen=True)
class Source:
    """A file that holds epochs: which of its rows are wanted, and all of it that is small."""

    path: Path
    first: int  # row of the file
    at: int  # row of the series
    count: int
    words: dict[str, np.ndarray[Any, Any]]  # the wanted rows of every small variable
    shapes: dict[str, tuple[int, ...]]  # of the large variables
    parameters: Parameters


def runs(found: list[Row]) -> list[tuple[Path, int, int, int]]:
    """Group rows that lie in one file in the same order: (path, first row there, first row here, count)."""
    grouped = groupby(enumerate(found), key=lambda pair: (pair[1].path, pair[1].index - pair[0]))
    runs = []
    for (path, shift), group in grouped:
        at = [place for place, _ in group]
        runs.append((path, at[0] + shift, at[0], len(at)))
    return runs


def read_source(path: Path, first: int, at: int, count: int) -> Source:
    """Read what is small of some rows of a file; raise StoreError where it is damaged."""
    try:
        with h5py.File(path, "r") as file:
            names = set(file)
            light = {"time", "time_bnds", *(row.name for row in LIGHT)} & names
            told = [
                strings(_read(file, name)) for name in ("parameter_name", "parameter_unit") if name in names
            ]
            return Source(
                path=path,
                first=first,
                at=at,
                count=count,
                words={name: _rows_of(file, name, first, count) for name in light},
                shapes={row.name: _open(file, row.name).shape for row in HEAVY if row.name in names},
                parameters=dict(zip(*told, strict=True)) if told else {},
            )
    except (OSError, RuntimeError, KeyError) as error:
        raise StoreError(f"{path}: damaged, cannot be read: {error}") from error


def _open(file: Any, name: str) -> Any:  # noqa: ANN401 - h5py has no types
    """Open a variable. Below h5py's comfort, which takes most of the time of hundreds of small files."""
    return h5py.h5d.open(file.id, name.encode())


def _read(file: Any, name: str) -> np.ndarray[Any, Any]:  # noqa: ANN401
    variable = _open(file, name)
    values = np.empty(variable.shape, variable.dtype)
    variable.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def _rows_of(file: Any, name: str, first: int, count: int) -> np.ndarray[Any, Any]:  # noqa: ANN401
    variable = _open(file, name)
    values = np.empty((count, *variable.shape[1:]), variable.dtype)
    if count:
        space = variable.get_space()
        space.select_hyperslab((first, *[0] * (values.ndim - 1)), values.shape)
        variable.read(h5py.h5s.create_simple(values.shape), space, values)
    return values


def is_laid_out_alike(one: Any, other: Any) -> bool:  # noqa: ANN401 - h5py has no types
    """Tell whether two variables store the same values as the same bytes."""
    return all(getattr(one, key) == getattr(other, key) for key in LAYOUT)


def copy_chunks(
    origin: Any,  # noqa: ANN401 - h5py has no types
    first: int,
    made: Any,  # noqa: ANN401
    at: int,
    count: int,
    progress: Callable[[], None] = lambda: None,
) -> None:
    """Copy the chunks that begin in some rows as they are: twenty times faster than decoding them.

    What is of one place comes together, so that a box over time is read in long runs. `progress` is called
    after each place. What was never written has no chunk.
    """
    there: list[tuple[int, ...]] = []

    def note(chunk: Any) -> None:  # noqa: ANN401
        if first <= chunk.chunk_offset[0] < first + count:
            there.append(chunk.chunk_offset)

    origin.id.chunk_iter(note)  # all at once: to ask for one takes as long as there are chunks before it
    for place, corners in groupby(sorted(there, key=_place_and_row), key=itemgetter(slice(1, None))):
        for corner in corners:
            mask, chunk = origin.id.read_direct_chunk(corner)
            made.id.write_direct_chunk((corner[0] - first + at, *place), chunk, mask)
        progress()


def _place_and_row(corner: tuple[int, ...]) -> tuple[int, ...]:
    return (*corner[1:], corner[0])


def take_over(old: Any, file: Any, names: Sequence[str], count: int) -> None:  # noqa: ANN401 - h5py has no types
    """Copy the first epochs of variables that are small per scan from the file before, in whole chunks."""
    for name in names:
        if name in file:
            copy_chunks(old[name], 0, file[name], 0, count)
