"""Products of beaches, snow slopes and rock faces against the truth, several stations of each kind."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from support.processed_station import REFERENCE, ProcessedStation, crossing_m, product_of, rms, squares_of

from station.queries.site_products.profile_lines import sample_line
from station.simulation.kinds import beach, low_cost_snow, rockfall
from station.simulation.station import simulate

pytestmark = [pytest.mark.integration, pytest.mark.slow]
SEEDS = {"beach": (11, 12, 13, 14, 15, 16), "low-cost-snow": (1, 2, 3), "rockfall": (1, 2, 3)}
LINES_NORTH_M = np.linspace(-70.0, 80.0, 15)  # down the beach, of the scanner
SEAWARD_M = (82.0, 130.0)  # where their ends are
DAY_S, DAY_H = 86_400.0, 24
SCENARIOS = {
    "beach": replace(  # whose stable ground heaves as that of the valley `breathing`
        beach(hours=8), lines=150, shots_per_line=150, cell_m=4.0, terrain_step_m=2.0,
        reference_scans=REFERENCE, heave_m=0.003,
    ),
    "low-cost-snow": replace(  # a scan a day: eight, on which it snows from the third on
        low_cost_snow(hours=8 * DAY_H), interval_s=DAY_S, lines=10, shots_per_line=2000, cell_m=4.0,
        terrain_step_m=2.0, reference_scans=REFERENCE, snow_hours=(2.0 * DAY_H, 8.0 * DAY_H),
    ),
    "rockfall": replace(
        rockfall(hours=6), lines=220, shots_per_line=200, cell_m=2.0, terrain_step_m=1.0,
        reference_scans=REFERENCE, rockfall_hour=4.5,
    ),
}  # fmt: skip
SUMMER = {"from": "2026-01-15T00:00:00Z", "to": "2026-01-18T12:00:00Z"}  # the first of the snow stations


@pytest.fixture(scope="module", params=SCENARIOS)
def kind_and_stations(request, tmp_path_factory):
    stations = []
    for seed in SEEDS[request.param]:
        folder = tmp_path_factory.mktemp(request.param) / f"{seed}"
        simulate(folder, replace(SCENARIOS[request.param], seed=seed))
        stations.append(ProcessedStation(folder))
    return request.param, stations


def cells_of(processed):
    """Return places of one cell each, off the stable ground, that all scans saw."""
    seen = np.isfinite(processed.error()).all(axis=0) & ~processed.stable
    chosen = np.argwhere(seen)[:: max(np.count_nonzero(seen) // 40, 1)]
    places = {}
    for row, column in chosen:
        places[f"{row} {column}"] = np.zeros(seen.shape, bool)
        places[f"{row} {column}"][row, column] = True
    return places, tuple(chosen.T)


def z_of(product, name, true):
    """Return error over sigma of a quantity (t, n) where it is known and has an error."""
    sigma = product[f"{name}_uncertainty"].values
    known = np.isfinite(product[name].values) & np.isfinite(true) & (sigma > 0)
    return (product[name].values - true)[known] / sigma[known]


def later_less_earlier(values, days):
    """Return values (t, n) less those of some scans before, NaN for the first scans."""
    differences = np.full(values.shape, np.nan)
    differences[days:] = values[days:] - values[:-days]
    return differences


def test_budgets_volumes_and_new_snow_are_as_far_from_the_truth_as_sigma_says(kind_and_stations):
    """On the beach most of sigma is common to all cells, so that six stations are needed."""
    kind, stations = kind_and_stations
    z = {}
    for processed in stations:
        places, (rows, columns) = cells_of(processed)
        area_m2, change_m = processed.site.grid.cell_m**2, processed.true_change[:, rows, columns]
        height_m = processed.true_elevation[:, rows, columns]
        products = [("volume_budget", "net_change", area_m2 * change_m, {})]
        if kind != "rockfall":
            low_m, high_m = np.quantile(height_m, (0.2, 0.8)).tolist()
            true_m3 = area_m2 * (np.clip(height_m, low_m, high_m) - low_m)
            products.append(("volume_between", "volume", true_m3, {"low": low_m, "high": high_m}))
        if kind == "low-cost-snow":
            products += [
                ("snow_depth", f"new_snow_{DAY_H * days}h", later_less_earlier(change_m, days),
                 {"surface": SUMMER})
                for days in (1, 3)
            ]  # fmt: skip
        for product_kind, name, true, settings in products:
            product = product_of(processed, places, kind=product_kind, **settings)
            z.setdefault(name, []).append(z_of(product, name, true))
    pooled = {name: rms(np.hstack(values)) for name, values in z.items()}
    assert all(len(np.hstack(values)) > 60 for values in z.values())
    assert all(0.8 < value < 1.25 for value in pooled.values()), pooled


@pytest.mark.parametrize("side", [1, 3])
def test_gain_of_few_cells_is_as_far_from_the_truth_as_sigma_says(kind_and_stations, side):
    """Where most ground gained. The loss, of which there is hardly any, is within its sigma."""
    kind, stations = kind_and_stations
    if kind != "low-cost-snow":
        pytest.skip("only snow falls everywhere")
    z, area_m2 = defaultdict(list), stations[0].site.grid.cell_m ** 2
    for processed in stations:
        places = squares_of(processed, side, 4)
        budget = product_of(processed, places, kind="volume_budget")
        for name, part in (("deposition", np.maximum), ("erosion", np.minimum)):
            true_m3 = [
                [area_m2 * part(change_m[cells], 0.0).sum() for cells in places.values()]
                for change_m in processed.true_change
            ]
            certain = budget[f"{name}_uncertainty"].values == 0  # that there is none
            assert (np.abs(budget[name].values - true_m3)[certain] < 0.01 * area_m2).all()
            z[name].append(z_of(budget, name, np.array(true_m3)))
    pooled = {name: rms(np.hstack(values)) for name, values in z.items()}
    assert 0.8 < pooled["deposition"] < 1.25, pooled
    assert pooled["erosion"] < 1.0, pooled
    assert all(np.mean(np.abs(np.hstack(values)) < 2.5) > 0.95 for values in z.values())


def test_lines_down_the_beach_change_and_move_as_far_from_the_truth_as_sigma_says(kind_and_stations):
    """The height of the scanner above stable ground that heaves is most of sigma, and common to all lines."""
    kind, stations = kind_and_stations
    if kind != "beach":
        pytest.skip("of a beach")
    z = defaultdict(list)
    for processed in stations:
        with xr.open_dataset(processed.folder / "truth.nc") as truth:
            elevation_m = truth.elevation.values
        east_m, north_m = (processed.series[f"scanner_{way}"].values[0] for way in ("east", "north"))
        for along_m in LINES_NORTH_M:
            ends = [(east_m - away_m, north_m + along_m) for away_m in SEAWARD_M]
            line = sample_line(ends, processed.site.grid_cells)
            true_m = np.array([line.interpolation @ heights_m[line.cells] for heights_m in elevation_m])
            before_m, after_m = true_m[:REFERENCE].mean(axis=0), true_m[REFERENCE:]
            profile = product_of(processed, kind="profile", line=ends)
            z["profile"].append(z_of(profile, "elevation_change", after_m - before_m))
            level_m = float(after_m[:, 4].mean())
            contour = product_of(processed, kind="contour", line=ends, height_m=level_m)
            place_m = np.array([crossing_m(line, heights_m, level_m) for heights_m in after_m])
            moved_m = place_m - crossing_m(line, before_m, level_m)
            z["movement"].append(z_of(contour, "distance_change", moved_m[:, None]))
            z["distance"].append(z_of(contour, "distance", place_m[:, None]))
    pooled = {name: rms(np.hstack(values)) for name, values in z.items()}
    assert all(0.8 < value < 1.25 for value in pooled.values()), pooled
