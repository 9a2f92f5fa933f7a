"""A station of each kind: its site file is clean, and its numbers agree with the truth."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import station
from station.config import read_site
from station.errors import ConfigError
from station.operations.batch import process_scans
from station.operations.site_check import site_findings
from station.processing.epoch_recorder import page_folder
from station.products.area_tables import area_cells
from station.science.geometry.robust_statistics import nmad
from station.service.store_repair import require_same_map
from station.simulation.kinds import beach, low_cost_snow, rockfall
from station.simulation.station import Station, simulate

pytestmark = pytest.mark.integration

SMALL = {"cell_m": 4.0, "terrain_step_m": 2.0, "reference_scans": 2}
SCENARIOS = {
    "low-cost-snow": replace(
        low_cost_snow(hours=1), interval_s=900.0, lines=10, shots_per_line=2000, **SMALL
    ),
    "beach": replace(beach(hours=4), lines=150, shots_per_line=150, **SMALL),
    "rockfall": replace(
        rockfall(hours=6), lines=220, shots_per_line=200, cell_m=2.0, terrain_step_m=1.0, reference_scans=3
    ),
}

# Limits of z of cells and areas. On calm sand sigma is too large (accuracy.md, known limits): a change that
# all stable ground shares cannot be excluded, and cells at the edge of stone count for the noise of all.
# Likewise for areas of a rock face: rock may heave by 2 mm, and the simulated one does not.
LIMITS = {
    "low-cost-snow": ((0.8, 1.25), (0.5, 1.6)),
    "beach": ((0.4, 1.25), (0.2, 1.6)),
    "rockfall": ((0.8, 1.25), (0.15, 1.6)),
}


MORE_SEEDS = {"low-cost-snow": (2, 3, 4), "beach": (2, 3)}  # two values of one station judge no sigma


def processed(folder, scenario):
    """Return site and truth of a simulated station whose scans are processed."""
    if not folder.exists():
        simulate(folder, scenario)
    site = read_site(folder / "site.toml")
    assert process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None) == 0
    with xr.open_dataset(folder / "truth.nc") as truth:
        return site, truth.load()


@pytest.fixture(scope="module", params=SCENARIOS)
def run(request, tmp_path_factory):
    """Return site and truth of a processed station."""
    folder = tmp_path_factory.mktemp(request.param) / "station"
    simulate(folder, SCENARIOS[request.param])
    findings = site_findings(folder / "site.toml")
    faults = [f for f in findings if f["level"] != "ok" and f["what"] != "rights"]  # those of root
    return *processed(folder, SCENARIOS[request.param]), faults


def errors(site, truth):
    """Return error and sigma of the change in the scans after the reference (n, ny, nx)."""
    series, first = station.open(site.path), site.reference.scans
    true_m = truth["change"].to_numpy()
    true_m = true_m - true_m[:first].mean(axis=0)
    error_m = series["elevation_change"].to_numpy() - true_m
    return error_m[first:], series["elevation_change_uncertainty"].to_numpy()[first:]


def test_check_finds_nothing_and_the_page_is_there(run):
    site, _, faults = run
    assert not faults
    assert (page_folder(site) / "index.html").is_file()


def test_cells_are_as_far_from_the_truth_as_sigma_says(run):
    error_m, sigma_m = errors(*run[:2])
    known = np.isfinite(error_m)
    assert known.mean() > 0.15
    low, high = LIMITS[run[0].station.id][0]
    assert low < nmad((error_m / sigma_m)[known]) < high


def area_z(site, truth):
    """Return the mean error of each area in each scan over its sigma."""
    error_m, _ = errors(site, truth)
    z = []
    for cells in area_cells(site, None).values():
        for number, epoch_m in enumerate(error_m):
            inside = cells & np.isfinite(epoch_m)
            if inside.sum() > 0.5 * cells.sum():
                weights = inside / inside.sum()
                sigma_m = station.variance(site.path, weights, site.reference.scans + number) ** 0.5
                z.append(np.sum(weights * np.nan_to_num(epoch_m)) / sigma_m)
    return z


def test_areas_are_as_far_from_the_truth_as_sigma_says(run, tmp_path):
    site, truth, _ = run
    kind, z = site.station.id, area_z(site, truth)
    for seed in MORE_SEEDS.get(kind, ()):
        z += area_z(*processed(tmp_path / f"{seed}", replace(SCENARIOS[kind], seed=seed)))
    assert len(z) >= 4
    low, high = LIMITS[kind][1]
    assert low < np.sqrt(np.mean(np.square(z))) < high


@pytest.mark.parametrize("run", ["rockfall"], indirect=True)
def test_what_fell_from_a_rock_face_is_as_far_from_the_truth_as_sigma_says(run):
    """Loss, gain and net change of each area before and after the fall, against the simulated blocks."""
    site, truth, _ = run
    budget, first = station.product(site.path, "rockfall"), site.reference.scans
    true_m = truth["change"].to_numpy()
    true_m = true_m - true_m[:first].mean(axis=0)
    z = defaultdict(list)
    for name, cells in area_cells(site, None).items():
        of_area = budget.sel(place=name)
        for quantity, clipped_m in (
            ("net_change", true_m),
            ("erosion", np.minimum(true_m, 0)),
            ("deposition", np.maximum(true_m, 0)),
        ):
            true_m3 = clipped_m[:, cells].sum(axis=1) * site.grid.cell_m**2
            error_m3 = (of_area[quantity].to_numpy() - true_m3)[first:]
            sigma_m3 = of_area[f"{quantity}_uncertainty"].to_numpy()[first:]
            assert np.all(error_m3[sigma_m3 == 0] == 0)  # all of a scar is loss
            z[quantity] += (error_m3 / np.where(sigma_m3 > 0, sigma_m3, 1)).tolist()
    assert budget["erosion"].sel(place="scar").to_numpy()[-1] == pytest.approx(-36.2, abs=3.0)
    rms = {quantity: np.sqrt(np.mean(np.square(values))) for quantity, values in z.items()}
    assert rms["net_change"] > 0.3, rms  # of rock at rest, gain or loss has the value 0 and a sigma
    assert max(rms.values()) < 1.6, rms


@pytest.mark.parametrize("run", ["rockfall"], indirect=True)
def test_files_of_a_rock_face_lead_back_to_the_map(run):
    """The plane in the attributes of a file places a cell where the simulated face is."""
    site, _, _ = run
    with xr.open_dataset(site.station.data / "series.nc") as series:
        attrs, x = series.attrs, series["x"]
        assert "standard_name" not in x.attrs
        assert not {"standard_name", "grid_mapping"} & set(series["elevation_change"].attrs)
        assert "geospatial_vertical_min" not in attrs
    facing_rad, origin_m = np.radians(attrs["grid_plane_facing_deg"]), attrs["grid_plane_origin_m"]
    out = np.array([np.sin(facing_rad), np.cos(facing_rad), 0.0])
    scan = Station(SCENARIOS["rockfall"]).scan(0)
    out_m = (scan.true_m - origin_m) @ out
    assert attrs["grid_plane_dip_deg"] == 90.0
    assert np.abs(out_m).max() < 8.0  # the relief of the face
    scanner_m = np.array(SCENARIOS["rockfall"].mount_position_m)
    assert station.open(site.path)["elevation_change"].dims == ("time", "y", "x")
    with xr.open_dataset(site.station.data / "processing.nc") as processing:
        stored_m = [float(processing[f"scanner_{axis}"][0]) for axis in ("east", "north", "height")]
    np.testing.assert_allclose(stored_m, scanner_m, atol=1e-6)
    text = site.path.read_text()
    (site.path.parent / "other.toml").write_text(text.replace("dip_deg = 90.0", "dip_deg = 85.0"))
    with pytest.raises(ConfigError, match=r"grid\.plane differs"):
        require_same_map(read_site(site.path.parent / "other.toml"))
