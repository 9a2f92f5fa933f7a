"""Draw the figures of the paper: `python docs/paper/figures.py FOLDER` (extra `plot`; minutes).

A station is simulated and processed in FOLDER, which is kept; the figures lie beside this file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

import station
from station.config import read_site
from station.operations.batch import process_scans
from station.products.plots import plot_map
from station.simulation.kinds import beach
from station.simulation.scenario import Scenario
from station.simulation.station import simulate

HERE = Path(__file__).parent
HOURS = 14
SIZES_M = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
MIN_SHARE = 0.5  # of the cells of a block that a scan must have observed
BLOCKS = 60  # of a size, of which the variance is computed


def processed(folder: Path, scenario: Scenario) -> Path:
    """Simulate and process a station, unless that was done; return its site file."""
    path = folder / "site.toml"
    if not path.exists():
        simulate(folder, scenario)
    site = read_site(path)
    if not (site.station.data / "series.nc").exists():
        scans = sorted(site.scans.inbox.glob("*.laz"))
        process_scans(site, scans, lambda entry: print(entry.name, entry.verdict))
    return path


def z_by_size(folder: Path, site: Path) -> list[tuple[float, float, float]]:
    """Return the rms of errors over σ by size of blocks [m]: with the covariance, and as if independent."""
    series, rows = station.open(site), []
    with xr.open_dataset(folder / "truth.nc") as truth:
        change_m = truth["change"].to_numpy()
    first = read_site(site).reference.scans
    error_m = series["elevation_change"].to_numpy() - (change_m - change_m[:first].mean(axis=0))
    sigma_m = series["elevation_change_uncertainty"].to_numpy()
    cell_m = read_site(site).grid.cell_m
    for size_m in SIZES_M:
        cells, z = max(1, round(size_m / cell_m)), []
        for epoch in range(first + 1, len(error_m), 3):
            for window in blocks(np.isfinite(error_m[epoch]), cells, epoch):
                known = np.isfinite(error_m[epoch][window])
                weights = np.zeros(error_m[epoch].shape)
                weights[window] = known / known.sum()
                error = np.nansum(weights * np.nan_to_num(error_m[epoch]))
                independent = np.sqrt(np.nansum((weights * np.nan_to_num(sigma_m[epoch])) ** 2))
                z.append((error / station.variance(site, weights, epoch) ** 0.5, error / independent))
        if z:
            rows.append((size_m, *np.sqrt(np.mean(np.square(z), axis=0))))
    return rows


def blocks(known: np.ndarray, cells: int, seed: int) -> list[tuple[slice, slice]]:
    """Return a sample of the square blocks of which enough cells are known."""
    ny, nx = known.shape
    found = [
        (slice(row, row + cells), slice(column, column + cells))
        for row in range(0, ny - cells + 1, cells)
        for column in range(0, nx - cells + 1, cells)
    ]
    found = [window for window in found if known[window].mean() >= MIN_SHARE]
    chosen = np.random.default_rng(seed).permutation(len(found))[:BLOCKS]
    return [found[index] for index in chosen]


def draw_z(rows: list[tuple[float, float, float]], path: Path) -> None:
    """Draw the errors over σ by size of the block."""
    size_m, own, independent = np.array(rows).T
    figure, axes = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
    axes.axhspan(0.8, 1.25, color="#dcefdc")
    axes.loglog(size_m, own, "o-", label="covariance of the scan")
    axes.loglog(size_m, independent, "s--", label="cells taken as independent")
    axes.set(xlabel="side of the block [m]", ylabel="error over σ, rms", yticks=[0.5, 1, 2, 5, 10, 20])
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend()
    figure.savefig(path, dpi=200)


def main() -> None:
    """Draw all figures."""
    folder = Path(sys.argv[1])
    site = processed(folder, beach(HOURS))
    plot_map(read_site(site), "last", "reference", "change", HERE / "beach.png", 1200, 0.4)
    draw_z(z_by_size(folder, site), HERE / "z_by_scale.png")


if __name__ == "__main__":
    main()
