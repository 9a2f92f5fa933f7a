"""Products of three simulated stations against the truth: places, profiles and contours."""

from collections import defaultdict
from dataclasses import replace
from datetime import UTC, timedelta

import numpy as np
import pytest
import xarray as xr
from support.processed_station import REFERENCE, ProcessedStation, crossing_m, product_of, rms, squares_of

from station.queries.site_products.profile_lines import sample_line
from station.simulation.scenario import named
from station.simulation.station import simulate

pytestmark = [pytest.mark.integration, pytest.mark.slow]
SEEDS = (1, 2, 3)
IN_SURFACE = 2  # scans of the surface; two come after them
LINES = 25  # of each station, downhill
HALF_LINE_M, CELL_M = 120.0, 10.0


@pytest.fixture(scope="module")
def stations(tmp_path_factory):
    """Stations on whose ice 5 cm melt an hour."""
    folder = tmp_path_factory.mktemp("melting")
    for seed in SEEDS:
        melting = replace(named("melt", hours=7, seed=seed), reference_scans=REFERENCE, melt_m_per_h=0.05)
        simulate(folder / f"{seed}", melting)
    return [ProcessedStation(folder / f"{seed}") for seed in SEEDS]


def span_of(processed, scans=IN_SURFACE):
    """Return the time of the first scans, which make the surface."""
    times = processed.series.time.values[:scans].astype("M8[s]").tolist()
    first, last = (time.replace(tzinfo=UTC) for time in (times[0], times[-1]))
    return {"from": first - timedelta(minutes=20), "to": last + timedelta(minutes=20)}


def z_of(product, name, true):
    """Return error over sigma of a quantity (t, n) where it is known."""
    z = (product[name].values - true) / product[f"{name}_uncertainty"].values
    return z[np.isfinite(z)]


def z_between(processed, places, low_m, high_m):
    """Return error over sigma of the volumes between two heights, where the surface is between them."""
    volume = product_of(processed, places, kind="volume_between", low=float(low_m), high=float(high_m))
    thickness_m = np.clip(processed.true_elevation, low_m, high_m) - low_m
    true_m3 = processed.site.grid.cell_m**2 * np.array(
        [[m[cells].sum() for cells in places.values()] for m in thickness_m]
    )
    return z_of(volume.where(volume.volume_uncertainty > 0), "volume", true_m3)


@pytest.mark.parametrize("side", [1, 3])
def test_melt_and_depth_above_the_mean_of_scans(stations, side):
    """Of exactly known density. The mean of a surface has errors as far below sigma as a single scan has.

    Heights and volumes between heights have the errors of the reference on the map.
    """
    z, later = defaultdict(list), slice(IN_SURFACE, None)
    for processed in stations:
        places = squares_of(processed, side, 10)
        true_m = np.array([[m[cells].mean() for cells in places.values()] for m in processed.true_change])
        for scans in (1, IN_SURFACE):
            above_m, span = true_m - true_m[:scans].mean(axis=0), span_of(processed, scans)
            depth = product_of(processed, places, kind="snow_depth", surface=span)
            z[scans].append(z_of(depth.isel(time=later), "snow_depth", above_m[later]))
        z["within"].append(z_of(depth.isel(time=slice(IN_SURFACE)), "snow_depth", above_m[:IN_SURFACE]))
        mass = {"kind": "melt", "surface": span, "density_kg_m3": 900.0}
        melt = product_of(processed, places, **mass)
        z["melt"].append(z_of(melt.isel(time=later), "melt", -0.9 * above_m[later]))
        mass = {"kind": "surface_mass_balance", "density_kg_m3": 400.0}
        balance = product_of(processed, places, **mass)
        z["balance"].append(z_of(balance, "surface_mass_balance", 0.4 * true_m))
        point = product_of(processed, places, kind="point", at=(0.0, 0.0))
        z["point"].append(z_of(point, "elevation_change", true_m))
        heights_m = processed.true_elevation
        true_m = np.array([[m[cells].mean() for cells in places.values()] for m in heights_m])
        z["height"].append(z_of(point, "elevation", true_m))
        z["between"].append(z_between(processed, places, *np.quantile(true_m, (0.3, 0.7))))
        budget = product_of(processed, places, kind="volume_budget")
        true_m3 = [[m[cells].sum() for cells in places.values()] for m in processed.true_change]
        z["budget"].append(z_of(budget, "net_change", CELL_M**2 * np.array(true_m3)))
    pooled = {name: rms(np.hstack(values)) for name, values in z.items()}
    assert all(0.8 < value < 1.25 for value in pooled.values()), pooled
    assert 0.8 < pooled[IN_SURFACE] / pooled[1] < 1.25, pooled


def lines_of(processed, ground_m):
    """Return lines downhill on moving ground that all scans saw, and the height in the middle of each."""
    grid, rng = processed.site.grid_cells, np.random.default_rng(0)
    south, east = np.gradient(ground_m, grid.cell_m)
    slope, seen = np.hypot(east, south), np.isfinite(processed.error()).all(axis=0)
    lines = []
    while len(lines) < LINES:
        row, column = rng.integers(15, grid.ny - 15), rng.integers(15, grid.nx - 15)
        near = np.s_[row - 3 : row + 4, column - 3 : column + 4]
        if not 0.05 < slope[row, column] < 1.2 or processed.stable[near].any():
            continue
        uphill = np.array([east[row, column], -south[row, column]]) / slope[row, column]
        middle = np.array([grid.x_m[column], grid.y_m[row]])
        ends = [tuple((middle + way * HALF_LINE_M * uphill).tolist()) for way in (-1, 1)]
        line = sample_line(ends, grid)
        if seen[line.cells].mean() > 0.9:
            lines.append((ends, line, float(ground_m[row, column])))
    return lines


def test_contours_lie_and_move_and_profiles_change_as_the_ground_does(stations):
    """Downhill on rough ice; the movement is as long as the melt over the slope, up to some metres.

    Distances and heights have the error of the reference, which is one sample a station.
    """
    z, moved_m = defaultdict(list), []
    for processed in stations:
        with xr.open_dataset(processed.folder / "truth.nc") as truth:
            elevation_m = truth.elevation.values
        ground_m = elevation_m[:REFERENCE].mean(axis=0)
        for ends, line, level_m in lines_of(processed, ground_m):
            true_m = np.array([line.interpolation @ heights_m[line.cells] for heights_m in elevation_m])
            before_m, after_m = true_m[:REFERENCE].mean(axis=0), true_m[REFERENCE:]
            profile = product_of(processed, kind="profile", line=ends)
            z["profile"].append(z_of(profile, "elevation_change", after_m - before_m))
            z["height"].append(z_of(profile, "elevation", after_m))
            place_m = np.array([crossing_m(line, heights_m, level_m) for heights_m in after_m])
            shoreline = {"kind": "contour", "line": ends, "height_m": level_m}
            contour = product_of(processed, **shoreline)
            z["distance"].append(z_of(contour, "distance", place_m[:, None]))
            movement_m = place_m - crossing_m(line, before_m, level_m)
            z["since the reference"].append(z_of(contour, "distance_change", movement_m[:, None]))
            surface_m = after_m[:IN_SURFACE].mean(axis=0)
            contour = product_of(processed, surface=span_of(processed), **shoreline)
            movement_m = place_m - crossing_m(line, surface_m, level_m)
            later = contour.isel(time=slice(IN_SURFACE, None))
            z["since the surface"].append(z_of(later, "distance_change", movement_m[IN_SURFACE:, None]))
            moved_m.append(np.abs(movement_m[-1]))
    pooled = {name: rms(np.hstack(values)) for name, values in z.items()}
    assert all(0.8 < value < 1.25 for value in pooled.values()), pooled
    assert np.nanmax(moved_m) > 1.0
