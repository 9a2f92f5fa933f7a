"""Fixtures of a small store on a grid at Hintereisferner."""

from dataclasses import replace

import numpy as np
import pytest

from station.archive.epochs import Epoch
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.quantities import ChangeErrors, Grid, Measurement, Reference, SharedParameters

GRID = Grid(west_m=632000.0, north_m=5186000.0, cell_m=10.0, nx=150, ny=140)
START_S = 1_763_683_200.0  # 2025-11-21 00:00 UTC
SURFACE_M = 2800.0  # height of the reference, less a slope of a millionth to the north


@pytest.fixture
def series(tmp_path):
    return Series(
        tmp_path, "hef", GRID, "EPSG:32632", "EGM2008 geoid", "Hintereisferner", "Institute of Tests"
    )


def write_surface(series):
    """Write the reference that the changes of `make_epoch` are counted from."""
    grid = series.grid
    surface_m = np.broadcast_to(SURFACE_M + grid.y_m[:, None] / 1e6, grid.shape)
    write_reference(series, Reference.from_elevation(grid, "1", surface_m, surface_m > 0))


@pytest.fixture
def epoch():
    return make_epoch


def make_epoch(hour, *, value=None, grid=GRID, terms=False):
    """Return an epoch; its change is the hour in centimetres, on the western half of the grid."""
    observed = np.zeros(grid.shape, bool)
    observed[:, : grid.nx // 2] = True
    change = np.where(observed, hour / 100 if value is None else value, np.nan).astype(np.float32)
    elevation = np.where(observed, SURFACE_M + grid.y_m[:, None] / 1e6, np.nan)
    count = np.where(observed, 3, 0).astype(np.int32)
    sigma = np.where(observed, 0.05, np.nan).astype(np.float32)
    measurement = Measurement.from_rasters(
        grid,
        observed.astype(np.uint8),
        elevation_m=elevation + np.nan_to_num(change),
        change_m=change,
        uncertainty_m=2 * sigma,
        systematic_uncertainty_m=np.sqrt(np.float32(3)) * sigma,
        spread_m=sigma,
        count=count,
        **({"sigma_geometry": sigma} if terms else {}),
    )
    names = ("tilt_east", "tilt_north", "range_bias")
    return Epoch(
        start_s=START_S + 3600 * hour,
        end_s=START_S + 3600 * hour + 900,
        scan_id=f"251121_{hour % 24:02d}0000",
        measurement=measurement,
        shared=SharedParameters(
            names,
            ("rad", "rad", "m"),
            np.zeros(3),
            np.diag([1e-10, 2e-10, 1.6e-5]),
            np.zeros(3),
            ChangeErrors(np.full((3, 32), hour * 1e-6), np.full(288, hour / 8)),
        ),
        verdict="good",
        verdict_reason="",
        scalars={"platform_roll": 0.12, "air_temperature": -3.5, "point_total": 1234.0, "coverage": 0.5},
        provenance={"scan_sha256": "ab" * 32, "sop_id": "sop-1", "reference_version": "1"},
    )


def random_epoch(hour, grid, random_m, *, unseen=None, quality=0, scatter_m=0.1, **fields):
    """Return an epoch with a random change of `hour` / 10 [m] in four of five cells.

    `random_m` (ny, nx) is its random uncertainty, half of its total one; none of the cells `unseen` is
    observed.
    """
    rng = np.random.default_rng(hour)
    observed = rng.uniform(size=grid.shape) < 0.8
    if unseen is not None:
        observed &= ~unseen
    change_m = np.where(observed, rng.normal(hour / 10, scatter_m, grid.shape), np.nan).astype(np.float32)
    sigma_m = np.where(observed, random_m, np.nan).astype(np.float32)
    measurement = Measurement.from_rasters(
        grid,
        np.where(observed, quality | observed, 0).astype(np.uint8),
        elevation_m=np.where(observed, 2900.0, np.nan),
        change_m=change_m,
        uncertainty_m=2 * sigma_m,
        systematic_uncertainty_m=np.sqrt(np.float32(3)) * sigma_m,
        spread_m=sigma_m,
        count=observed.astype(np.int32),
    )
    start_s = START_S + 3600 * hour
    epoch = Epoch(start_s, start_s + 900, f"251121_{hour:02d}0000", measurement, None, "good", "", {}, {})
    return replace(epoch, **fields)
