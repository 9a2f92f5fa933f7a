"""The small store of the archive's tests."""

import pytest
from support.epochs import GRID, make_epoch, write_surface
from support.series import copied

from station.archive.netcdf_layout import Series


@pytest.fixture
def series(tmp_path):
    return new_store(tmp_path / "data")


@pytest.fixture(scope="module")
def base_store(tmp_path_factory):
    """A store without epochs, for those that a module writes once."""
    return new_store(tmp_path_factory.mktemp("base") / "data")


def new_store(folder):
    """Return a store without a geoid, with metadata as a site file gives them."""
    metadata = (("license", "CC-BY-4.0"), ("creator_name", "A. Nother"))
    series = Series(folder, "hef", GRID, "EPSG:32632", "", "Hintereisferner", "Tests", metadata)
    write_surface(series)
    return series


@pytest.fixture
def epoch():
    return make_epoch


@pytest.fixture
def stored(filled, tmp_path):
    """Return a copy of the store that a module filled."""
    return copied(filled, tmp_path / "data")
