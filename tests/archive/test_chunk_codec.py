"""Windows of rasters over time, against HDF5's own reading of the same file."""

import h5py
import numpy as np
import pytest
from isal.igzip_lib import IsalError

from station.archive.chunk_codec import ChunkReader

WINDOWS = [
    (slice(0, 50), slice(0, 70)),
    (slice(15, 33), slice(30, 65)),
    (slice(16, 32), slice(64, 70)),
    (slice(49, 50), slice(3, 4)),
]
FILTERS = {
    "as in the store": {"shuffle": True, "compression": "gzip"},
    "no shuffle": {"compression": "gzip"},
    "no filter": {},
}


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS)
@pytest.mark.parametrize("dtype", ["f4", "i4", "i2", "i1"])
def test_windows_are_those_of_hdf5(tmp_path, dtype, filters):
    values = np.random.default_rng(1).integers(-90, 90, (3, 50, 70)).astype(dtype)
    with h5py.File(tmp_path / "a.nc", "w") as file:
        dataset = file.create_dataset(
            "v", values.shape, dtype, chunks=(1, 16, 32), fillvalue=7, maxshape=(None, 50, 70), **filters
        )
        dataset[1:, 16:] = values[1:, 16:]  # other chunks are not in the file
        reader = ChunkReader(dataset)
        for epoch in range(3):
            for window in WINDOWS:
                actual = reader.read(epoch, *window)
                assert actual.dtype == dataset.dtype
                assert np.array_equal(actual, dataset[(epoch, *window)])


def test_chunks_of_several_epochs_are_read_too(tmp_path):
    values = np.arange(4 * 20 * 20, dtype="f4").reshape(4, 20, 20)
    with h5py.File(tmp_path / "a.nc", "w") as file:
        dataset = file.create_dataset("v", data=values, chunks=(2, 8, 8), shuffle=True, compression="gzip")
        assert np.array_equal(ChunkReader(dataset).read(3, slice(5, 17), slice(2, 20)), values[3, 5:17, 2:20])


def test_a_chunk_that_is_cut_off_raises(tmp_path):
    path = tmp_path / "a.nc"
    with h5py.File(path, "w") as file:
        noise = np.random.default_rng(1).normal(size=(1, 64, 64)).astype("f4")
        file.create_dataset("v", data=noise, chunks=(1, 64, 64), shuffle=True, compression="gzip")
        offset = file["v"].id.get_chunk_info(0).byte_offset
    with path.open("r+b") as raw:
        raw.seek(offset + 100)
        raw.write(bytes(5000))
    with h5py.File(path) as file, pytest.raises(IsalError):
        ChunkReader(file["v"]).read(0, slice(0, 64), slice(0, 64))
