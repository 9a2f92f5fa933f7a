"""Small variables of a file of epochs, through h5py's low-level API.

netCDF asks for the length of the unlimited dimension with each access, and looks at all variables for that: a
hundred of them would take as long as the rasters of a small grid.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from station.archive.netcdf_layout import decode_text
from station.archive.schema import FILL

Array = np.ndarray[Any, Any]


def open_variable(file: Any, name: str) -> Any:  # noqa: ANN401 - h5py has no types
    """Return the HDF5 dataset of a variable."""
    return h5py.h5d.open(file.id, name.encode())


def read_variable(file: Any, name: str) -> Array:  # noqa: ANN401
    """Return all values of a variable."""
    variable = open_variable(file, name)
    values = np.empty(variable.shape, variable.dtype)
    variable.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def read_epochs(file: Any, name: str, start: int, count: int) -> Array:  # noqa: ANN401
    """Return the values (count, …) of some epochs."""
    variable = open_variable(file, name)
    values = np.empty((count, *variable.shape[1:]), variable.dtype)
    if count:
        space = variable.get_space()
        space.select_hyperslab((start, *[0] * (values.ndim - 1)), values.shape)
        variable.read(h5py.h5s.create_simple(values.shape), space, values)
    return values


def write_epochs(file: Any, values: Mapping[str, Array], start: int = 0) -> None:  # noqa: ANN401
    """Write the values (n, …) of variables over time, from the epoch `start` on, which end with them."""
    for name, values_of_name in values.items():
        variable = open_variable(file, name)
        array = np.ascontiguousarray(values_of_name, variable.dtype)
        variable.set_extent((start + len(array), *array.shape[1:]))
        space = variable.get_space()
        space.select_hyperslab((start, *[0] * (array.ndim - 1)), array.shape)
        variable.write(h5py.h5s.create_simple(array.shape), space, array, variable.get_type())


def text_attribute(file: Any, name: str, default: str | None = None) -> str:  # noqa: ANN401
    """Return a global attribute, which netCDF stores as bytes; raise KeyError without it and a default."""
    value = file.attrs[name] if default is None else file.attrs.get(name, default)
    if isinstance(value, h5py.Empty):
        return ""
    return value.decode() if isinstance(value, bytes) else str(value)


def read_number(file: Any, name: str, index: int) -> float:  # noqa: ANN401
    """Return a number of an epoch; NaN where it has none."""
    value = float(read_epochs(file, name, index, 1)[0])
    return value if value < FILL / 2 else math.nan


def read_text(file: Any, name: str, index: int) -> str:  # noqa: ANN401
    """Return a text of an epoch."""
    return decode_text(read_epochs(file, name, index, 1))[0]
