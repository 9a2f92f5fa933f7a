"""Simulated stations with a known truth: errors of the pipeline and calibration of its uncertainty."""

import re
import shutil
from collections import defaultdict
from dataclasses import replace
from datetime import UTC, timedelta
from functools import cache

import laspy
import numpy as np
import pytest
import xarray as xr
from support.processed_station import BOX, REFERENCE, ProcessedStation, product_of, rms

from station.monitoring.log_clock import log_clock_offset
from station.products.area_tables import Span
from station.products.trend_tables import trend_records
from station.quantities import Quality
from station.science.analysis.inclination_check import MAX_OFFSET_S
from station.simulation.instrument.motion import sensor_faults
from station.simulation.scenario import named
from station.simulation.station import simulate

pytestmark = pytest.mark.integration
CALM = replace(named("quiet", hours=6), reference_scans=REFERENCE)
PERFECT = CALM.without_errors()
SHOTS_ONLY = {"range_noise_m": 0.01, "beam_divergence_mrad": 0.12, "line_jitter_deg": 0.0008}
SEEDS = (1, 2, 3, 4, 5)
FILTERED = ('method = "joint"', 'method = "none"')


def test_random_sigma_is_calibrated(tmp_path):
    """Without systematic errors, (DEM - truth) / sigma_random has a standard deviation of one."""
    simulate(tmp_path / "station", replace(PERFECT, **SHOTS_ONLY))
    processed = ProcessedStation(tmp_path / "station", FILTERED)
    z = processed.series.elevation.values - processed.true_elevation
    z /= processed.series.elevation_change_random_uncertainty.values
    assert np.nanstd(z) == pytest.approx(1.0, abs=0.12)
    assert abs(np.nanmedian(z)) < 0.05
    count = processed.series.point_count.values
    for points in (1, 2, 3):
        assert np.nanstd(z[count == points]) == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_filtered_inclination_removes_two_thirds_of_the_drift(tmp_path):
    """Tilt drift without sensor bias: 100 m boxes beyond 2 km, with and without the log."""
    drifting = {"tilt_drift_deg": 0.004, "tilt_within_scan_deg": 0.0018, "log_noise_deg": 0.008}
    simulate(tmp_path / "station", replace(PERFECT, **SHOTS_ONLY, **drifting))
    text = (tmp_path / "station" / "site.toml").read_text()
    log = text[text.index("[inclination]") : text.index("[adjustment]")]
    rms_m = []
    for changes in ([FILTERED], [FILTERED, (log, "")]):
        processed = ProcessedStation(tmp_path / "station", *changes, first=0)
        heights = processed.series.elevation.values - processed.true_elevation
        error, _, distance_m = processed.boxes(heights, everywhere=True)
        rms_m.append(np.sqrt(np.mean(error[distance_m > 2000] ** 2)))
    assert rms_m[0] < rms_m[1] / 3
    assert rms_m[1] > 0.1


@pytest.mark.slow
def test_sigma_covers_errors_that_the_log_does_not_measure(unadjusted):
    """Filtered log without adjustment, all errors on: within two sigma in 90 % of boxes."""
    error, sigma, distance_m = unadjusted.boxes()
    for near, far in ((0, 1500), (1500, 2500), (2500, 5000)):
        inside = (distance_m >= near) & (distance_m < far)
        assert np.mean(np.abs(error[inside]) < 2 * sigma[inside]) > 0.9
        assert sigma[inside].mean() < 0.6
    assert {result.verdict for result in unadjusted.results} == {"good"}


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calm") / "station"
    simulate(folder, CALM)
    return ProcessedStation(folder)


@pytest.fixture(scope="module")
def unadjusted(calm):
    return ProcessedStation(calm.folder, FILTERED)


def copy_of_inputs(folder, copy):
    return shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("data", "other-*"))


@pytest.fixture
def calm_folder(calm, tmp_path):
    return copy_of_inputs(calm.folder, tmp_path / "station")


def test_adjustment_is_as_accurate_as_manual_registration(calm):
    """100 m boxes of a calm day: published ±0.10 m manual, ±0.50 m unattended; required 0.03 m."""
    error, sigma, _ = calm.boxes()
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.quantile(np.abs(error), 0.95) < 0.06
    assert np.abs(error).max() < 0.10
    assert 0.8 < rms(error / sigma) < 1.25
    assert {result.verdict for result in calm.results} == {"good"}
    assert calm.series.adjustment.values.tolist() == ["joint"] * 3


def test_boxes_in_their_file_are_calibrated_and_the_bound_is_above_their_error(calm):
    """The bound is that of the files' comments, by which other programs average cells."""
    with xr.open_dataset(calm.site.station.data / "boxes.nc") as boxes:
        sigma_m = boxes.elevation_change_uncertainty.values
        chosen = (boxes.coverage > 0.6).values
    cells = xr.Dataset(
        {
            "error_m": calm.series.elevation_change.copy(data=calm.error()),
            "systematic_m": calm.series.elevation_change_systematic_uncertainty,
            "random_m2": calm.series.elevation_change_random_uncertainty**2,
            "stable": calm.series.elevation_change.copy(
                data=np.broadcast_to(1.0 * calm.stable, calm.error().shape)
            ),
        }
    )
    blocks = cells.coarsen(y=BOX, x=BOX, boundary="pad")
    mean, count = blocks.mean(), blocks.count().error_m
    bound_m = np.sqrt(mean.random_m2 / count + mean.systematic_m**2).values
    chosen &= (mean.stable == 0).values
    error_m, sigma_m, bound_m = (values[chosen] for values in (mean.error_m.values, sigma_m, bound_m))
    assert 0.8 < rms(error_m / sigma_m) < 1.25
    assert (bound_m > 0.99 * sigma_m).all()
    assert 0.1 < rms(error_m / bound_m) < 0.9
    assert np.mean(np.abs(error_m) < 2 * bound_m) > 0.99
    assert np.median(bound_m / sigma_m) < 6


def test_blocks_of_single_scans_are_calibrated(calm):
    """Cells of 5 m, so that a block of 10 m is a cell of the truth."""
    fine = ProcessedStation(calm.folder, ("cell_m = 10.0", "cell_m = 5.0"))
    folder = fine.site.station.data
    (path,) = folder.glob("blocks/*/*.nc")
    with xr.open_dataset(path) as blocks:
        error_m = blocks.elevation_change.values - fine.true_change
        sigma_m = blocks.elevation_change_uncertainty.values
        whole = (blocks.coverage == 1).values & ~fine.stable
    z = error_m / sigma_m
    assert np.count_nonzero(whole) > 10_000
    assert 0.8 < np.std(np.clip(z[whole], -5, 5)) < 1.25
    ratios = []
    for epoch, row, column in np.argwhere(whole)[:: np.count_nonzero(whole) // 12]:
        mask = np.zeros((2 * whole.shape[1], 2 * whole.shape[2]), bool)
        mask[2 * row : 2 * row + 2, 2 * column : 2 * column + 2] = True
        exact_m = np.sqrt(fine.aggregates.variance(mask / 4, fine.aggregates.find_epoch(int(epoch))))
        ratios.append(sigma_m[epoch, row, column] / exact_m)
    # A block spans several scan lines, taken as one, which shows where their tilt is most of its variance.
    assert 0.98 < min(ratios) < np.median(ratios) < 1.03
    assert max(ratios) < 1.15


def test_uncertainty_of_cells_and_areas_is_calibrated(calm):
    z = calm.error() / calm.series.elevation_change_uncertainty.values
    assert 0.8 < np.nanstd(np.clip(z, -5, 5)) < 1.25
    assert np.abs(calm.area_z()).max() < 3.5
    flagged = calm.series.quality.values.astype(int) & Quality.CHANGE_SIGNIFICANT
    assert (flagged > 0)[np.isfinite(calm.error())].mean() < 0.15


def test_holdout_stable_ground_agrees_with_the_truth(calm):
    """The calibration on hold-out ground agrees with that against the truth."""
    off_stable = np.isfinite(calm.error()) & ~calm.stable
    z = np.where(off_stable, calm.error() / calm.series.elevation_change_uncertainty.values, np.nan)
    true_z = 1.4826 * np.nanmedian(np.abs(z))
    assert calm.series.stable_count.values.min() > 500
    assert np.median(calm.series.stable_z_std.values) == pytest.approx(true_z, abs=0.3)
    assert np.abs(calm.series.stable_median.values).max() < 0.01


def test_area_changes_are_stored_with_every_epoch(calm):
    with xr.open_dataset(calm.site.station.data / "areas.nc") as areas:
        assert areas.area_name.values.tolist() == ["glacier", "deposit", "rock"]
        assert areas.sizes["time"] == 3
        assert (np.abs(areas.mean_change) < 3.5 * areas.mean_change_uncertainty).all()
        assert (areas.mean_change_uncertainty < 0.02).all()


def test_products_are_calibrated(calm):
    """Depth above the first scan, and gain and loss where nothing changed, in boxes with their voids."""
    error_m, boxes = calm.error(), {}
    for top, left in np.ndindex(*(size // (2 * BOX) for size in calm.stable.shape)):
        cells = np.zeros(calm.stable.shape, bool)
        cells[2 * BOX * top :, 2 * BOX * left :][:BOX, :BOX] = True
        if np.isfinite(error_m).all(axis=0)[cells].mean() > 0.75 and not calm.stable[cells].any():
            boxes[f"{top} {left}"] = cells
    boxes = dict(list(boxes.items())[::2])
    assert len(boxes) > 20
    first = calm.series.time.values[0].astype("M8[s]").item().replace(tzinfo=UTC)
    span = {"from": first - timedelta(minutes=10), "to": first + timedelta(minutes=10)}
    depth = product_of(calm, boxes, kind="snow_depth", surface=span)
    assert not calm.true_change.any()
    z = depth.snow_depth.values[1:] / depth.snow_depth_uncertainty.values[1:]
    assert 0.8 < rms(z) < 1.25
    budget = product_of(calm, boxes, kind="volume_budget")
    positive_m3 = 100.0 * np.mean([np.nansum(np.maximum(m[c], 0)) for m in error_m for c in boxes.values()])
    for name in ("net_change", "deposition", "erosion"):
        z = budget[name].values / budget[f"{name}_uncertainty"].values
        assert 0.8 < rms(z[np.isfinite(z)]) < 1.25
        assert abs(float(budget[name].mean())) < 0.1 * positive_m3  # the sum of positive cells is no gain


@pytest.fixture(scope="module")
def snowfall(tmp_path_factory):
    folder = tmp_path_factory.mktemp("snowfall") / "station"
    simulate(folder, replace(CALM, snowfall_m=0.4, snow_hours=(2.5, 4.0)))
    return folder


@pytest.mark.slow
def test_snow_on_stable_ground_is_not_adjusted_as_tilt(snowfall):
    """0.4 m of patchy snow on everything below 40-50°, on rock too."""
    processed = ProcessedStation(snowfall)
    error, _, _ = processed.boxes()
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert processed.series.change_step.values[-1] > 0.05
    fixed, _, _ = ProcessedStation(snowfall, FILTERED).boxes()
    assert np.sqrt(np.mean(error**2)) < 0.7 * np.sqrt(np.mean(fixed**2))


@pytest.mark.slow
@pytest.mark.parametrize(("brightness", "largest"), [("linear", 1.25), ("none", 2.0)])
def test_the_first_snow_is_within_sigma(tmp_path, brightness, largest):
    """6 mm on all ground below 40 to 50 degrees, which look like a scanner that sank: z was 4 to 6.

    Without brightness snow is no likelier than none, which does not cover all of the error.
    """
    z = []
    for seed in SEEDS[:3]:
        snowy = replace(named("snowfall", 7, seed), brightness=brightness, snow_hours=(6.0, 14.0))
        simulate(tmp_path / f"station-{seed}", snowy)
        z += ProcessedStation(tmp_path / f"station-{seed}", reference=5, first=6).area_z().tolist()
    assert 0.5 < rms(z) < largest


@pytest.mark.slow
def test_snow_on_stable_ground_without_brightness_is_within_sigma(snowfall, tmp_path):
    """The same snowfall in scans whose intensity is zero: only steep rock is stable."""
    copy_of_inputs(snowfall, tmp_path / "station")
    for path in (tmp_path / "station" / "inbox").glob("*.laz"):
        las = laspy.read(path)
        las.intensity[:] = 0
        las.write(path)
    processed = ProcessedStation(tmp_path / "station")
    error, sigma, _ = processed.boxes()
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert 0.8 < rms(error / sigma) < 1.25
    assert all("no brightness" in result.reason for result in processed.results)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "verdict", "limit_m"), [("airborne", "good", 0.02), ("airborne-heavy", "degraded", 0.03)]
)
@pytest.mark.parametrize("along", ["near", "along"])
def test_echoes_of_the_air_move_no_box(tmp_path, name, verdict, limit_m, along):
    """0.1 % and 1 % of all shots, in the scans of the reference too: plain means are off by up to 0.3 m."""
    scenario = replace(named(name, hours=6), reference_scans=REFERENCE, airborne=along)
    simulate(tmp_path / "station", scenario)
    processed = ProcessedStation(tmp_path / "station")
    error, sigma, _ = processed.boxes()
    assert np.sqrt(np.mean(error**2)) < limit_m
    assert np.quantile(np.abs(error), 0.95) < 2 * limit_m
    assert 0.6 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.4
    z = np.clip(processed.error() / processed.series.elevation_change_uncertainty.values, -5, 5)
    assert 0.8 < np.nanstd(z) < 1.25
    assert {result.verdict for result in processed.results} == {verdict}
    assert all(
        ("not from the ground" in result.reason) == (verdict != "good") for result in processed.results
    )


@pytest.mark.slow
def test_avalanche_deposit_keeps_its_height(tmp_path):
    scenario = replace(CALM, avalanche_m=2.0, avalanche_hour=4.0, avalanche_size=0.4)
    simulate(tmp_path / "station", scenario)
    processed = ProcessedStation(tmp_path / "station")
    true = processed.true_change[-1]
    deposit = np.isfinite(processed.error()[-1]) & (true > 1.0)
    ratio = processed.series.elevation_change.values[-1][deposit].mean() / true[deposit].mean()
    assert ratio == pytest.approx(1.0, abs=0.03)
    flagged = processed.series.quality.values[-1].astype(int) & Quality.CHANGE_SIGNIFICANT
    assert (flagged[deposit] > 0).mean() > 0.95
    error, _, _ = processed.boxes()
    assert np.sqrt(np.mean(error**2)) < 0.03


@pytest.fixture(scope="module")
def without(calm, tmp_path_factory):
    """Process the station without its logs, its weather, or any stable ground."""

    @cache
    def process(missing):
        folder = copy_of_inputs(calm.folder, tmp_path_factory.mktemp(missing) / "station")
        if missing == "logs":
            for path in sorted((folder / "inbox").glob("*-incl.txt"))[REFERENCE:]:
                path.unlink()
        elif missing == "weather":
            (folder / "weather.dat").write_text("")
        else:
            far = [[0.0, 0.0], [1000.0, 0.0], [1000.0, 1000.0], [0.0, 0.0]]
            ring = str([[[632000 + x, 5170000 + y] for x, y in far]])
            (folder / "stable.geojson").write_text(f'{{"type": "Polygon", "coordinates": {ring}}}')
        return ProcessedStation(folder)

    return process


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "reason"),
    [
        ("logs", "inclination log missing"),
        ("weather", "weather"),
        ("stable ground", "no stable ground"),
    ],
)
def test_missing_input_is_reported(without, missing, reason):
    for result in without(missing).results:
        assert result.verdict == "degraded"
        assert reason in result.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    "missing",
    [
        "logs",
        "weather",
        pytest.param(
            "stable ground", marks=pytest.mark.xfail(strict=True, reason="sigma is too large: z is 0.60")
        ),
    ],
)
def test_sigma_includes_missing_input(without, missing):
    error, sigma, _ = without(missing).boxes()
    assert 0.8 < rms(error / sigma) < 1.25


@pytest.fixture(scope="module")
def z_of_stations(calm, unadjusted, tmp_path_factory):
    """Standardised errors of stations with other weather, motion and sensor errors, by method and scale."""
    z = defaultdict(list)
    for seed in SEEDS:
        stations = {"joint": calm, "none": unadjusted}
        if seed != CALM.seed:
            folder = tmp_path_factory.mktemp("other") / "station"
            simulate(folder, replace(CALM, seed=seed))
            stations = {"joint": ProcessedStation(folder), "none": ProcessedStation(folder, FILTERED)}
        for method, processed in stations.items():
            error, sigma, _ = processed.boxes()
            assert rms(error) < (0.03 if method == "joint" else 0.5)
            cells = processed.error() / processed.series.elevation_change_uncertainty.values
            z[method, "cell"].append(cells[np.isfinite(cells)])
            z[method, "100 m"].append(error / sigma)
            z[method, "area"].append(processed.area_z())
            trends = [record.trend for record in trend_records(processed.site, None, Span.parse(None, None))]
            true_m_d = 0.0  # nothing changes
            z[method, "rate"].append([(trend.rate_m_d - true_m_d) / trend.rate_sigma_m_d for trend in trends])
    return {key: np.concatenate(values) for key, values in z.items()}


def sigma_too_large(value):
    return pytest.mark.xfail(strict=True, reason=f"sigma is too large: z is {value}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "scale"),
    [
        ("joint", "cell"),
        pytest.param("joint", "100 m", marks=pytest.mark.xfail(strict=False, reason="at the bound: 0.79")),
        pytest.param("joint", "area", marks=pytest.mark.xfail(strict=False, reason="near 0.6")),
        ("joint", "rate"),
        pytest.param("none", "cell", marks=sigma_too_large(0.66)),
        pytest.param("none", "100 m", marks=sigma_too_large(0.68)),
        pytest.param("none", "area", marks=pytest.mark.xfail(strict=False, reason="near 0.6")),
    ],
)
def test_sigma_is_calibrated_over_five_stations(z_of_stations, method, scale):
    """At most a quarter off; 15 scans have 15 errors and rates of areas, for which bounds are wider."""
    z = z_of_stations[method, scale]
    spread = 1.4826 * np.median(np.abs(z)) if scale == "cell" else rms(z)
    low, high = (0.6, 1.5) if scale in {"area", "rate"} else (0.8, 1.25)
    assert low < spread < high


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "drift",
        "wind",
        pytest.param("melt", marks=sigma_too_large("0.70")),
        pytest.param("poor", marks=pytest.mark.xfail(strict=True, reason="sigma is too small: z is 1.33")),
        pytest.param("fog", marks=pytest.mark.xfail(strict=False, reason="at the bound: 0.805")),
        "moved",
    ],
)
def test_scenarios_stay_within_their_uncertainty(tmp_path, name):
    """Errors of boxes and of their sigma; a relocation and fog are reported."""
    scenario = replace(named(name, hours=9), reference_scans=REFERENCE)
    simulate(tmp_path / "station", scenario)
    processed = ProcessedStation(tmp_path / "station")
    error, sigma, _ = processed.boxes()
    assert np.sqrt(np.mean(error**2)) < 0.04
    assert 0.8 < rms(error / sigma) < 1.25
    reasons = {"moved": "moved?", "fog": "of the usually visible cells observed, none beyond 1"}
    if name in reasons:
        assert any(reasons[name] in result.reason for result in processed.results)
        assert {result.verdict for result in processed.results} == {"good", "degraded"}
    else:
        assert not any("usually visible" in result.reason for result in processed.results)


def true_clock_offsets(scenario):
    """Return the true clock offset of the log of each scan [s]."""
    return np.array([sensor_faults(scenario, scan).clock_s for scan in range(scenario.hours)])


def test_log_clock_offset_is_estimated_and_stored(calm):
    true_offset_s = true_clock_offsets(CALM)[REFERENCE:]
    error_s = calm.series.log_clock_offset + calm.series.log_offset - true_offset_s
    assert np.all(np.abs(error_s) < 4 * calm.series.log_clock_offset_uncertainty)
    assert np.all(calm.series.log_clock_offset_uncertainty < MAX_OFFSET_S)
    assert log_clock_offset(calm.site) == ""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint", "none"])
def test_log_five_seconds_late_is_within_sigma_and_corrected_in_wind(tmp_path, calm_folder, method):
    """In calm air the offset is too small to detect or to matter; with gusts the ground shows it."""
    folder, scenario = calm_folder, CALM
    if method == "joint":
        folder, scenario = tmp_path / "windy", replace(CALM, hours=REFERENCE + 6, wind_sway_deg=0.004)
        simulate(folder, scenario)
    for path in sorted((folder / "inbox").glob("*-incl.txt"))[REFERENCE:]:
        head, *rows = path.read_text().splitlines()
        late = (f"{float(row.split(',')[0]) + 5:.4f},{row.split(',', 1)[1]}" for row in rows)
        path.write_text("\n".join([head, *late]) + "\n")
    processed = ProcessedStation(folder, *([FILTERED] if method == "none" else []))
    error, sigma, _ = processed.boxes()
    smallest = (
        0.8 if method == "joint" else 0.3
    )  # without adjustment one error of tilt in each of three scans
    assert smallest < rms(error / sigma) < 1.25
    if method == "none":
        assert {result.verdict for result in processed.results} == {"good"}
        return
    true_offset_s = 5 + true_clock_offsets(scenario)[REFERENCE:]
    corrected_s = processed.series.log_offset.values
    error_s = processed.series.log_clock_offset.values + corrected_s - true_offset_s
    z = error_s / processed.series.log_clock_offset_uncertainty.values
    assert 0.3 < rms(z) < 1.6  # of six
    corrected = np.abs(corrected_s) > 3.5
    assert any(corrected)
    assert corrected_s[corrected] == pytest.approx(true_offset_s[corrected], abs=1)
    assert {result.verdict for result in processed.results} == {"good"}


@pytest.mark.slow
def test_changed_cyclic_error_is_reported(tmp_path):
    folder = tmp_path / "station"
    simulate(folder, replace(CALM, log_cyclic_change=0.6))
    processed = ProcessedStation(folder)
    error, sigma, _ = processed.boxes()
    assert 0.8 < rms(error / sigma) < 1.25
    assert any("cyclic error that differs" in result.reason for result in processed.results)


def cut_short(folder):
    """Keep the first 70 % of the sweep of the last scan."""
    import laspy

    path = max((folder / "inbox").glob("*.laz"))
    scan = laspy.read(path)
    time_s = np.asarray(scan.gps_time)
    scan.points = scan.points[time_s < time_s.min() + 0.7 * np.ptp(time_s)]
    scan.write(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "damage", "verdict", "message"),
    [
        ({"fog_visibility_m": 700.0, "fog_hours": (3.0, 9.0)}, None, "unusable", "usually visible cells"),
        ({}, cut_short, "degraded", "partial sweep: no points at azimuth"),
        (
            {"moved_hour": 2.5, "moved_deg": 0.5, "moved_m": 0.05},
            None,
            "degraded",
            r"^scanner tilted by 0\.(49|50)\d deg",
        ),
        ({"moved_hour": 2.5, "moved_deg": 8.0, "moved_m": 0.5}, None, "unusable", r"moved, or another SOP\?"),
    ],
    ids=["dense fog", "partial sweep", "knocked", "fallen"],
)
def test_disturbed_scan_gets_its_verdict(tmp_path, changes, damage, verdict, message):
    folder = tmp_path / "station"
    simulate(folder, replace(CALM, hours=REFERENCE + 1, **changes))
    if damage:
        damage(folder)
    (result,) = ProcessedStation(folder).results
    assert result.verdict == verdict
    assert re.search(message, result.reason)


def test_a_scanner_that_turned_in_a_season_does_not_seem_to_have_shifted(tmp_path):
    """0.05° of rotation and 3 m of melt: the position, which changed by 2 mm, is found within its sigma."""
    summer = replace(named("summer", hours=6, seed=2), reference_scans=REFERENCE, season_hour=REFERENCE)
    simulate(tmp_path / "station", summer)
    processed = ProcessedStation(tmp_path / "station")
    assert [result.verdict for result in processed.results] == ["good"] * 3
    series = processed.series
    estimate = series.shared_parameter.values
    names = series.parameter_name.values.astype(str).tolist()
    covariance = series.shared_parameter_covariance.values
    for axis in ("east", "north"):
        index = names.index(f"translation_{axis}")
        assert np.abs(estimate[:, index]).max() < 0.02
        assert rms(estimate[:, index] / np.sqrt(covariance[:, index, index])) < 2.5
    error_m, sigma_m, _ = processed.boxes()
    assert rms(error_m) < 0.05
    assert 0.4 < rms(error_m / sigma_m) < 1.4
