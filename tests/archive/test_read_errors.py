"""A damaged file raises StoreError with its name, whatever byte is damaged."""

from __future__ import annotations

import h5py
import netCDF4
import numpy as np
import pytest

from station.archive.netcdf_layout import decode_text
from station.archive.read_errors import read_errors
from station.archive.series.epoch_reader import read_source
from station.errors import StoreError


def read(path):
    with read_errors(path), h5py.File(path, "r") as file:
        return file["time_bnds"][:].sum(), decode_text(file["epoch_file"][:])


def test_every_flipped_byte_is_read_or_raises_store_error(tmp_path):
    """h5py reports some of them as OSError, others as KeyError or RuntimeError."""
    path = tmp_path / "series.nc"
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("time", 3)
        file.createDimension("text", 64)
        file.createVariable("time_bnds", "f8", ("time",), fletcher32=True)[:] = np.arange(3)
        file.createVariable("epoch_file", "S1", ("time", "text"), zlib=True)[:] = np.full((3, 64), b"a")
    assert read(path) == (3.0, ["a" * 64] * 3)
    whole, causes = path.read_bytes(), set()
    for position in range(0, len(whole), 41):
        content = bytearray(whole)
        content[position] ^= 0xFF
        path.write_bytes(content)
        try:
            read(path)
        except StoreError as error:
            causes.add(type(error.__cause__))
    assert {OSError, KeyError} <= causes


def test_error_of_the_store_is_not_changed(tmp_path):
    with pytest.raises(StoreError, match=r"^no space left$"), read_errors(tmp_path / "series.nc"):
        raise StoreError("no space left")


def test_file_with_a_lost_parameter_name_raises_store_error(tmp_path):
    """As a damaged chunk of names does, which is then read as empty."""
    path = tmp_path / "epoch.nc"
    with netCDF4.Dataset(path, "w") as file:
        for dim, size in (("time", 1), ("bnds", 2), ("parameter", 2), ("parameter_1", 1), ("text", 64)):
            file.createDimension(dim, size)
        file.createVariable("time_bnds", "f8", ("time", "bnds"))[:] = [[0.0, 720.0]]
        file.createVariable("parameter_unit", "S1", ("parameter", "text"))[:] = np.full((2, 64), b"m")
        file.createVariable("parameter_name", "S1", ("parameter_1", "text"))[:] = np.full((1, 64), b"a")
    with pytest.raises(StoreError, match=r"epoch\.nc: cannot be read: zip"):
        read_source(path, 0, 0, 1)
