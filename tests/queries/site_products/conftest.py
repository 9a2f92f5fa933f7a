"""A store whose products count from the mean of three scans."""

import pytest
from support.series import open_with_processing
from support.surface_store import write_store


@pytest.fixture(scope="package")
def series(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("surface"))


@pytest.fixture(scope="package")
def stored(series):
    """Rasters and covariances of the store, in memory."""
    with open_with_processing(series.folder) as ds:
        return ds.load()
