"""The small store of the archive's tests."""

import pytest
from support.epochs import GRID, make_epoch, write_surface

from station.archive.netcdf_layout import Series


@pytest.fixture
def series(tmp_path):
    """Return a store without a geoid, with metadata as a site file gives them."""
    metadata = (("license", "CC-BY-4.0"), ("creator_name", "A. Nother"))
    series = Series(tmp_path / "data", "hef", GRID, "EPSG:32632", "", "Hintereisferner", "Tests", metadata)
    write_surface(series)
    return series


@pytest.fixture
def epoch():
    return make_epoch
