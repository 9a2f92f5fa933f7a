"""Simulated stations with a known truth: what the pipeline makes of them, and how sure it says it is."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from station.archive.reference import read_reference
from station.archive.store import open_series
from station.config import read_site
from station.quantities import Quality
from station.science import shared, terrain
from station.service import tasks
from station.service.gather import frame_of
from station.service.inbox import Arrival
from station.simulation.station import demo, simulate

CALM = replace(demo(hours=6), melt_m_per_h=0.0, avalanche_m=0.0, reference_scans=3)
PERFECT = CALM.without_errors()
SHOTS_ONLY = {"range_noise_m": 0.01, "beam_divergence_mrad": 0.12, "line_jitter_deg": 0.0008}
BOX = 10  # cells of 10 m


class Measured:
    """A simulated station, processed."""

    def __init__(self, folder, site_name="site.toml"):
        self.site = read_site(folder / site_name)
        arrivals = []
        for path in sorted(self.site.scans.inbox.glob("*.laz")):
            log = path.with_name(f"{path.stem}-incl.txt") if self.site.inclination else None
            status = path.stat()
            arrivals.append(Arrival(path.name, path, log, status.st_size, status.st_mtime_ns))
        tasks.build_reference(self.site, arrivals[:3], "1", lambda: None)
        self.outcomes = [tasks.process(self.site, arrival, lambda: None) for arrival in arrivals]
        tasks.publish(self.site, lambda: None)
        self.series = open_series(self.site.station.data).load()
        self.truth = xr.open_dataset(folder / "truth.nc").load()
        self.reference = read_reference(tasks.series_of(self.site))
        self.position_m = frame_of(self.site, self.site.sop[0]).position_m

    def error(self, scan):
        return self.series.elevation[scan].values - self.truth.elevation[scan].values

    def error_of_change(self, scan):
        """Nothing changes in these stations."""
        return self.series.elevation_change[scan].values.astype(float)

    def boxes(self, error_of):
        """Error, sigma and distance of every 100 m box of every scan, from random sigma and covariance."""
        grid = self.site.grid_cells
        of = shared.basis(grid, self.position_m)
        gradient = terrain.smooth_gradient(self.reference.elevation_m, grid.cell_m)
        found = []
        for scan in range(self.series.sizes["time"]):
            error = error_of(scan)
            random_m = self.series.elevation_change_random_uncertainty[scan].values.astype(float)
            covariance = (
                self.series.shared_parameter_covariance[scan].values + self.reference.shared.covariance
            )
            for top in range(0, grid.ny - BOX, BOX):
                for left in range(0, grid.nx - BOX, BOX):
                    box = np.zeros(grid.shape, bool)
                    box[top : top + BOX, left : left + BOX] = True
                    box &= np.isfinite(error) & np.isfinite(self.reference.elevation_m)
                    if box.sum() < 0.6 * BOX**2:
                        continue
                    elevation_m = self.reference.elevation_m
                    felt = shared.cell_sensitivities(of, grid, self.position_m, elevation_m, gradient, box)
                    weights = np.full(box.sum(), 1 / box.sum())
                    variance = shared.aggregate_variance(weights, random_m[box] ** 2, felt, covariance)
                    east, north = grid.x_m[left + 5], grid.y_m[top + 5]
                    distance_m = np.hypot(east - self.position_m[0], north - self.position_m[1])
                    found.append((error[box].mean(), np.sqrt(variance), distance_m))
        return np.array(found).T


def test_random_sigma_is_calibrated(tmp_path):
    """Shared errors off: (DEM - truth) / sigma_random has a standard deviation of one."""
    simulate(tmp_path / "station", replace(PERFECT, **SHOTS_ONLY))
    measured = Measured(tmp_path / "station")
    z = np.array([measured.error(scan) for scan in range(3, 6)])
    z /= measured.series.elevation_change_random_uncertainty[3:].values
    assert np.nanstd(z) == pytest.approx(1.0, abs=0.1)
    assert abs(np.nanmedian(z)) < 0.03
    count = measured.series.point_count[3:].values
    for points in (1, 2, 3):
        assert np.nanstd(z[count == points]) == pytest.approx(1.0, abs=0.2)


def test_filtered_inclination_takes_two_thirds_of_the_drift_away(tmp_path):
    """Tilt drift without sensor bias: far 100 m boxes with and without the log."""
    drifting = {"lean_drift_deg": 0.004, "lean_within_scan_deg": 0.0018, "log_noise_deg": 0.008}
    simulate(tmp_path / "station", replace(PERFECT, **SHOTS_ONLY, **drifting))
    site = (tmp_path / "station" / "site.toml").read_text()
    start, end = site.index("[inclination]"), site.index("[adjustment]")
    without = (site[:start] + site[end:]).replace('data = "data"', 'data = "data_without"')
    (tmp_path / "station" / "without.toml").write_text(without)
    rms_m = []
    for name in ("site.toml", "without.toml"):
        error, _, distance_m = (measured := Measured(tmp_path / "station", name)).boxes(measured.error)
        rms_m.append(np.sqrt(np.mean(error[distance_m > 2000] ** 2)))
    assert rms_m[0] < rms_m[1] / 3
    assert rms_m[1] > 0.1


def test_sigma_holds_what_the_log_cannot_know(tmp_path):
    """All errors on: whatever the correction does to it, the error is within two sigma in 90 % of boxes."""
    simulate(tmp_path / "station", CALM)
    measured = Measured(tmp_path / "station")
    error, sigma, distance_m = measured.boxes(measured.error_of_change)
    for near, far in ((0, 1500), (1500, 2500), (2500, 5000)):
        inside = (distance_m >= near) & (distance_m < far)
        assert np.mean(np.abs(error[inside]) < 2 * sigma[inside]) > 0.9
        assert sigma[inside].mean() < 0.6
    assert {outcome.verdict for outcome in measured.outcomes} == {"good"}
    assert measured.series.verdict.values.tolist() == [0] * 6
    assert np.isfinite(measured.series.air_temperature.values).all()
    seen = np.isfinite(measured.series.elevation_change.values)
    flagged = measured.series.quality.values.astype(int) & Quality.CHANGE_SIGNIFICANT
    assert (flagged > 0)[seen].mean() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_sigma_holds_for_other_stations(tmp_path, seed):
    """Other weather, motion and sensor errors: box by box within two sigma, and not because sigma is vast."""
    simulate(tmp_path / "station", replace(CALM, seed=seed))
    measured = Measured(tmp_path / "station")
    error, sigma, _ = measured.boxes(measured.error_of_change)
    assert np.mean(np.abs(error) < 2 * sigma) > 0.9
    assert np.std(error / sigma) > 0.3
