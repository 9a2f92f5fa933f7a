"""The site file that is written from a RiSCAN project can be used as it is."""

import numpy as np
import pytest
from pyproj import Transformer

from station.config import read_site
from station.errors import ConfigError
from station.operations.riscan_import import import_riscan
from station.processing.scanner_pose import scanner_to_map


def test_the_site_of_a_real_project(shared_data, tmp_path):
    paths = import_riscan(shared_data / "riegl/project.rsp", tmp_path)
    assert [path.name for path in paths] == ["site.toml", "SP01-SOP.dat", "SP02-SOP.dat", "POP.dat"]
    (tmp_path / "inbox").mkdir()
    site = read_site(paths[0])
    assert site.scanner.model == "riegl-vz-1000"
    assert [sop.scan for sop in site.sop] == ["151120_150227", "151120_155528"]
    assert site.map.crs == "EPSG:32615"  # Houston
    position_m = scanner_to_map(site, site.sop[1]).position_m
    sop, pop = (np.loadtxt(tmp_path / name) for name in ("SP02-SOP.dat", "POP.dat"))
    to_map = Transformer.from_crs("EPSG:4978", "EPSG:32615", always_xy=True)
    assert position_m == pytest.approx(to_map.transform(*(pop @ sop)[:3, 3]), abs=0.001)
    bounds = site.grid.bounds_m
    assert bounds.west < position_m[0] < bounds.east
    assert bounds.south < position_m[1] < bounds.north
    with pytest.raises(ConfigError, match="already exists"):
        import_riscan(shared_data / "riegl/project.rsp", tmp_path)
