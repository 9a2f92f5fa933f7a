"""A station whose grid lies on a level plane turned by 90° has the numbers of one on the map."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import median_abs_deviation

import station
from station.config import read_site
from station.operations.batch import process_scans
from station.simulation.station import simulate, small

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plane") / "station"
    simulate(folder, replace(small(hours=3), lines=60, shots_per_line=90, cell_m=10.0, reference_scans=2))
    text = re.sub(r"(?m)^\[areas\]\nfile = .*\n", "", (folder / "site.toml").read_text())
    (folder / "site.toml").write_text(text.replace('"stable.geojson"', '"auto"'))
    return folder


def processed(folder, name, method, **changes):
    """Return the changes of the scans, sigma and elevation of a station with another site file."""
    shutil.copytree(folder, folder.parent / name)
    text = (folder / "site.toml").read_text().replace('method = "joint"', f'method = "{method}"')
    for key, value in changes.items():
        text = re.sub(rf"(?m)^{key} = .*", value, text)
    (folder.parent / name / "site.toml").write_text(text)
    site = read_site(folder.parent / name / "site.toml")
    assert process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None) == 0
    series = station.open(site.path)
    names = ("elevation_change", "elevation_change_uncertainty", "elevation")
    return site, [series[name].to_numpy()[-1] for name in names]


@pytest.mark.parametrize(
    ("method", "change_sigmas", "sigma_ratio"), [("none", 0.02, 0.01), ("joint", 0.5, 0.2)]
)
def test_a_turned_grid_has_the_same_numbers(folder, method, change_sigmas, sigma_ratio):
    """u points north and v west; hold-out blocks and the patches of an adjustment lie elsewhere."""
    bounds = read_site(folder / "site.toml").grid.bounds_m
    origin = f"[{bounds.west}, {bounds.south}, 1000.0]"
    width_m, height_m = bounds.east - bounds.west, bounds.north - bounds.south
    turned_bounds = (
        f"bounds_m = {{ west = 0.0, south = {-width_m}, east = {height_m}, north = 0.0 }}\n"
        f"plane = {{ origin_m = {origin}, facing_deg = 90.0, dip_deg = 0.0 }}"
    )
    _, (change_m, sigma_m, elevation_m) = processed(folder, f"map-{method}", method)
    site, turned = processed(folder, f"turned-{method}", method, bounds_m=turned_bounds)
    turned_change_m, turned_sigma_m, turned_elevation_m = (np.rot90(raster) for raster in turned)
    assert np.mean(np.isfinite(change_m)) > 0.1
    both = np.isfinite(change_m) & np.isfinite(turned_change_m)
    assert np.mean(both[np.isfinite(change_m)]) > 0.99
    difference = ((turned_change_m - change_m) / sigma_m)[both]
    assert median_abs_deviation(difference, scale="normal") < change_sigmas
    assert np.median(turned_sigma_m[both] / sigma_m[both]) == pytest.approx(1.0, abs=sigma_ratio)
    assert np.median(np.abs(turned_elevation_m + 1000.0 - elevation_m)[both]) < 0.02
    series = station.open(site.path)
    assert "crs" not in series.variables  # the coordinates of the plane are not those of the map
    assert series.attrs["grid_plane_map_crs"] == site.map.crs
