"""Products of a beach, a snow slope and a rock face against the truth, three stations of each kind."""

from dataclasses import replace

import numpy as np
import pytest
from support.processed_station import REFERENCE, ProcessedStation, product_of, rms

from station.simulation.kinds import beach, low_cost_snow, rockfall
from station.simulation.station import simulate

pytestmark = [pytest.mark.integration, pytest.mark.slow]
SEEDS = (1, 2, 3)
DAY_S, DAY_H = 86_400.0, 24
SCENARIOS = {
    "beach": replace(
        beach(hours=8), lines=150, shots_per_line=150, cell_m=4.0, terrain_step_m=2.0,
        reference_scans=REFERENCE,
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
    for seed in SEEDS:
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
    """On calm sand sigma is larger, for that of the height of the scanner (accuracy.md, products)."""
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
    assert all((0.7 if kind == "beach" else 0.8) < value < 1.25 for value in pooled.values()), pooled
