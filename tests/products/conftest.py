"""A small archive with a reference: known change per cell, and names that look like markup."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.archive import epochs
from station.archive.areas import update_areas
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.config import read_site
from station.quantities import Grid, Measurement, Quality, Reference
from station.queries.aggregates import Aggregates
from station.readers.polygons import cells_inside, read_polygons
from station.science.gridding.significance import significant

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=60, ny=45)
START_S = 1_763_683_200.0  # 2025-11-21 00:00 UTC
EVIL = "<img src=x onerror=alert(1)>"
RISE, FALL, UNOBSERVED = np.s_[5:15, 5:20], np.s_[20:35, 30:50], np.s_[38:42, 10:50]
SITE = """
[station]
id = "hef"
name = "{evil}"
data = "data"
[scans]
inbox = "inbox"
frame = "map"
[map]
crs = "EPSG:32632"
[grid]
bounds_m = {{ west = 632000, south = 5185550, east = 632600, north = 5186000 }}
cell_m = 10.0
[areas]
file = "areas.geojson"
"""


def box(name, west, south, east, north):
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {
        "type": "Feature",
        "properties": {"name": name},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }


def make_epoch(hour, *, grid=GRID, scan_id=None, reference="1"):
    """An epoch: rises by 5 cm per hour in one box, falls in another, noise elsewhere."""
    rng = np.random.default_rng(hour)
    random_m = rng.uniform(0.01, 0.03, grid.shape)
    change_m = random_m * rng.normal(size=grid.shape)
    change_m[RISE] += 0.05 * (hour + 1)
    change_m[FALL] -= 0.05 * (hour + 1)
    observed = rng.uniform(size=grid.shape) < 0.95
    observed[UNOBSERVED] = False
    observed[:, -5:] = False
    change_m = np.where(observed, change_m, np.nan).astype(np.float32)
    random_m = np.where(observed, random_m, np.nan).astype(np.float32)
    sigma_m = np.hypot(random_m, np.float32(0.01))
    count = np.where(observed, 4, 0).astype(np.int32)
    quality = np.where(significant(change_m, sigma_m), Quality.CHANGE_SIGNIFICANT, 0).astype(np.uint8)
    elevation_m = np.where(observed, 2800.0, np.nan)
    measurement = Measurement.from_rasters(
        grid,
        quality,
        elevation_m=elevation_m,
        change_m=change_m,
        uncertainty_m=sigma_m,
        systematic_uncertainty_m=np.where(observed, np.float32(0.01), np.float32(np.nan)),
        spread_m=random_m,
        count=count,
    )
    return epochs.Epoch(
        start_s=START_S + 3600 * hour,
        end_s=START_S + 3600 * hour + 900,
        scan_id=scan_id or f"251121_{hour % 24:02d}0000",
        measurement=measurement,
        shared=None,
        verdict="good" if hour % 2 else "degraded",
        verdict_reason="" if hour % 2 else f"no weather {EVIL}",
        scalars={
            "platform_roll": 0.1 + hour / 100, "platform_pitch": -0.2, "air_temperature": -3.5,
            "coverage": 0.8, "air_pressure": 690.0, "point_total": 1234.0,
            "stable_median": 0.001, "stable_nmad": 0.02,
            "stable_z_std": 1.02,
        },
        provenance={"reference_version": reference, "adjustment": "joint"},
    )  # fmt: skip


def make_reference(grid=GRID, version="1"):
    row, column = np.indices(grid.shape)
    elevation_m = 2800 + 2.0 * row + 20 * np.sin(column / 6)
    elevation_m[:, -2:] = np.nan  # without elevation
    return replace(
        Reference.from_elevation(grid, version, elevation_m),
        random_variance_m2=np.where(np.isfinite(elevation_m), np.float32(0.005**2), np.float32(np.nan)),
    )


def fill(series, site, hours):
    for hour in hours:
        scan_id = EVIL if hour == 3 else None
        epochs.write_epoch(series, make_epoch(hour, scan_id=scan_id))
    build_series(series)
    areas = {
        name: cells_inside(polygon, GRID)
        for name, polygon in read_polygons(site.areas.file, site.map.crs).items()
    }
    update_areas(series, areas, Aggregates(series), lambda: None)


@pytest.fixture(scope="session")
def stored(tmp_path_factory):
    """A folder with a site file and an archive of six epochs."""
    folder = tmp_path_factory.mktemp("stored")
    (folder / "inbox").mkdir()
    (folder / "site.toml").write_text(SITE.format(evil=EVIL))
    boxes = [box("rises", 632050, 5185850, 632200, 5185950), box(EVIL, 632300, 5185650, 632500, 5185800)]
    (folder / "areas.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": boxes}))
    site = read_site(folder / "site.toml")
    series = Series(site.station.data, "hef", GRID, "EPSG:32632", name=EVIL)
    write_reference(series, make_reference())
    fill(series, site, range(6))
    return folder


@pytest.fixture
def site(stored, tmp_path):
    """A site with a private copy of the archive."""
    shutil.copytree(stored, tmp_path, dirs_exist_ok=True)
    return read_site(tmp_path / "site.toml")


@pytest.fixture
def series(site):
    return Series(site.station.data, "hef", GRID, "EPSG:32632", name=EVIL)


@pytest.fixture(scope="session")
def small():
    """The constants and functions that the archive was built with."""
    return SimpleNamespace(
        GRID=GRID, EVIL=EVIL, RISE=RISE, FALL=FALL, UNOBSERVED=UNOBSERVED, START_S=START_S,
        make_epoch=make_epoch, make_reference=make_reference, fill=fill, box=box,
    )  # fmt: skip
