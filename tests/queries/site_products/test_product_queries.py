"""Products of the site file, against plain sums of the stored rasters and dense matrix algebra."""

from dataclasses import replace

import numpy as np
import pytest
from support.crossings import crossing
from support.plane_store import (
    EAST,
    GRID,
    dense_variance,
    independent_m2,
    make_epoch,
    make_reference,
    random_parameters,
    reference_random_m2,
    shared_variance,
)
from support.series import copied, open_with_processing

import station
from station.archive import epochs
from station.archive.derived.product_files import product_path
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.quantities import Grid
from station.queries.site_products.product_queries import Product, update_products
from station.queries.site_products.profile_lines import sample_line
from station.sections.product import ProductSection

SUMMER, BEFORE, LAST = range(3)
HOURS = (1, 30, 54)  # the last is 24 h after the one before
SUMMER_TIME = {"from": "2025-11-21T00:00:00Z", "to": "2025-11-21T06:00:00Z"}
ROW = 12  # of the line


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("products"), "hef", GRID, "EPSG:32632")
    write_reference(series, make_reference())
    for hour in HOURS:
        epochs.write_epoch(series, make_epoch(hour, "joint", random_parameters(hour, 0.3)))
    build_series(series)
    return series


@pytest.fixture(scope="module")
def stored(base):
    """Rasters and covariances of the store, in memory."""
    with open_with_processing(base.folder) as ds:
        return ds.load()


@pytest.fixture(scope="module")
def box(stored):
    """A box of cells that all epochs observed: no void is interpolated."""
    cells = np.zeros(GRID.shape, bool)
    cells[5:20, 10:30] = True
    return cells & np.isfinite(stored.elevation_change.values).all(axis=0)


def computed(series, places=None, *, rasters=None, **settings):
    """Return a product of the series, and how many epochs were computed."""
    section = ProductSection.model_validate({"name": "test", **settings})
    line = sample_line(section.line, GRID) if section.line else None
    product = Product(section, places or {"test": line.cells}, {"test": line} if line else {}, rasters or {})
    steps = []
    update_products(series, [product], [section.key], lambda: steps.append(1))
    return station.product(series.folder, "test"), len(steps)


def change_m(stored, index, cells):
    return stored.elevation_change.values[index][cells].astype(float)


def assert_sigmas(product, name, index, *, random, total, systematic=0.0, rel=1e-4):
    """Assert the parts of one sigma, given as variances; `systematic` is added to the total."""
    actual = {
        part: float(product[f"{name}_{part}"].values[index].squeeze()) ** 2
        for part in ("uncertainty", "random_uncertainty", "systematic_uncertainty")
    }
    assert actual["random_uncertainty"] == pytest.approx(random, rel=rel)
    assert actual["uncertainty"] == pytest.approx(total + systematic, rel=rel)
    assert actual["systematic_uncertainty"] == pytest.approx(total + systematic - random, rel=10 * rel)


def difference_variances(stored, reference_m2, weights, first, second):
    """Return random and total variance of a weighted sum of the change between two epochs, dense."""
    random_m2 = [independent_m2(stored, index, reference_m2) for index in (first, second)]
    total = sum(
        dense_variance(stored, weights, index, random_m2=noise_m2)
        for index, noise_m2 in zip((first, second), random_m2, strict=True)
    )
    return np.nansum(weights**2 * sum(random_m2)), total


def test_snow_depth_is_the_height_above_the_stations_own_summer(base, stored, box):
    depth, _ = computed(
        base, {"bowl": box}, kind="snow_depth", surface=SUMMER_TIME, offset_m=0.03, offset_sigma_m=0.02
    )
    depth = depth.sel(place="bowl")
    assert depth.snow_depth.attrs["standard_name"] == "surface_snow_thickness"
    expected = change_m(stored, LAST, box).mean() - change_m(stored, SUMMER, box).mean() + 0.03
    assert float(depth.snow_depth[LAST]) == pytest.approx(expected)
    assert float(depth.snow_depth[SUMMER]) == 0.03
    weights, reference_m2 = box / box.sum(), reference_random_m2(base)
    random, total = difference_variances(stored, reference_m2, weights, LAST, SUMMER)
    assert_sigmas(depth, "snow_depth", LAST, random=random, total=total, systematic=0.02**2)
    new_m = change_m(stored, LAST, box).mean() - change_m(stored, BEFORE, box).mean()
    assert float(depth.new_snow_24h[LAST]) == pytest.approx(new_m)
    random, total = difference_variances(stored, reference_m2, weights, LAST, BEFORE)
    assert_sigmas(depth, "new_snow_24h", LAST, random=random, total=total)
    assert np.isnan(depth.new_snow_24h[BEFORE])
    assert np.isnan(depth.new_snow_72h).all()


def test_snow_depth_above_a_given_surface_has_the_errors_of_the_reference(base, stored, box):
    surface_m = np.where(box, stored.elevation.values[LAST] - 1.25, np.nan)
    depth, _ = computed(
        base, {"bowl": box}, kind="snow_depth", surface="summer.tif", rasters={"surface": surface_m}
    )
    assert float(depth.snow_depth[LAST, 0]) == pytest.approx(1.25, abs=1e-3)
    weights, random_m2 = box / box.sum(), independent_m2(stored, LAST, reference_random_m2(base))
    total = dense_variance(stored, weights, LAST, random_m2=random_m2, reference=random_parameters(7, 0.5))
    assert_sigmas(depth, "snow_depth", LAST, random=np.nansum(weights**2 * random_m2), total=total)


@pytest.mark.parametrize(
    ("kind", "sign"),
    [("melt", -1.0), pytest.param("surface_mass_balance", 1.0, marks=pytest.mark.integration)],
)
def test_mass_is_change_times_density_with_the_error_of_both(base, stored, box, kind, sign):
    mass, _ = computed(base, {"ice": box}, kind=kind, density_kg_m3=850.0, density_sigma_kg_m3=40.0)
    mean_m = change_m(stored, LAST, box).mean()
    assert float(mass[kind][LAST, 0]) == pytest.approx(sign * 0.85 * mean_m)
    weights = box / box.sum()
    variance = dense_variance(stored, weights, LAST)
    random = np.sum((weights[box] * stored.elevation_change_random_uncertainty.values[LAST][box]) ** 2)
    # The exact variance of a product of independent factors.
    expected = 0.85**2 * variance + mean_m**2 * 0.04**2 + variance * 0.04**2
    assert_sigmas(mass, kind, LAST, random=0.85**2 * random, total=expected)


@pytest.mark.integration
def test_a_point_has_elevation_and_change(base, stored, box):
    row, column = np.argwhere(box)[40]
    cell = np.zeros(GRID.shape, bool)
    cell[row, column] = True
    at = [float(GRID.x_m[column]), float(GRID.y_m[row])]
    point, _ = computed(base, {"stake": cell}, kind="point", at=at)
    assert [float(point.place_x[0]), float(point.place_y[0])] == at
    assert float(point.elevation[LAST, 0]) == pytest.approx(stored.elevation.values[LAST, row, column])
    assert float(point.elevation_change[LAST, 0]) == stored.elevation_change.values[LAST, row, column]
    random_m2 = independent_m2(stored, LAST, reference_random_m2(base))
    total = dense_variance(stored, 1.0 * cell, LAST, random_m2=random_m2, reference=random_parameters(7, 0.5))
    assert_sigmas(point, "elevation", LAST, random=random_m2[row, column], total=total)
    assert float(point.elevation_change_uncertainty[LAST, 0]) == pytest.approx(
        dense_variance(stored, 1.0 * cell, LAST) ** 0.5, rel=1e-3
    )


@pytest.mark.integration
def test_the_volume_between_two_levels_is_that_of_clipped_heights(base, stored, box):
    low_m, high_m = 2840.0, 2860.0
    volume, _ = computed(base, {"beach": box}, kind="volume_between", low=low_m, high=high_m)
    height_m = stored.elevation.values[LAST][box].astype(float)
    expected = 100.0 * (np.clip(height_m, low_m, high_m) - low_m).sum()
    assert float(volume.volume[LAST, 0]) == pytest.approx(expected, rel=1e-6)
    weights = np.zeros(GRID.shape)
    weights[box] = 100.0 * ((height_m > low_m) & (height_m < high_m))
    assert 0 < np.count_nonzero(weights) < box.sum()
    random_m2 = independent_m2(stored, LAST, reference_random_m2(base))
    total = dense_variance(stored, weights, LAST, random_m2=random_m2, reference=random_parameters(7, 0.5))
    assert_sigmas(volume, "volume", LAST, random=np.nansum(weights**2 * random_m2), total=total)


def test_a_volume_budget_closes_and_has_the_covariance_of_its_classes(base, stored, box):
    """The class of each cell by the sum of its neighbours, cell by cell; sigma by dense matrices."""
    height_m = stored.elevation.values[LAST].astype(float)
    plane_m = np.where(box, height_m - np.where(np.arange(GRID.nx) < 20, 0.5, -0.5), np.nan)
    noise_m = np.random.default_rng(3).normal(0, 0.1, GRID.shape)
    surface_m = plane_m + noise_m
    budget, _ = computed(
        base, {"slope": box}, kind="volume_budget", surface="before.tif", rasters={"surface": surface_m}
    )
    values_m = height_m - surface_m
    random_m2 = independent_m2(stored, LAST, reference_random_m2(base))
    is_gain = np.zeros(GRID.shape, bool)
    for row, column in np.argwhere(box):
        window = np.s_[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        neighbours = np.nansum(np.where(box, values_m, np.nan)[window]) - values_m[row, column]
        is_clear = abs(values_m[row, column]) > 4 * random_m2[row, column] ** 0.5
        is_gain[row, column] = (values_m[row, column] if is_clear else neighbours) > 0
    reference = random_parameters(7, 0.5)
    for name, cells in (("deposition", is_gain), ("erosion", box & ~is_gain), ("net_change", box)):
        assert cells.sum() > 50
        expected = 100.0 * values_m[cells].sum()
        assert float(budget[name][LAST, 0]) == pytest.approx(expected, abs=0.5)
        total = dense_variance(stored, 100.0 * cells, LAST, random_m2=random_m2, reference=reference)
        random = np.sum(100.0**2 * random_m2[cells])
        assert_sigmas(budget, name, LAST, random=random, total=total)
    closure = budget.deposition + budget.erosion - budget.net_change
    assert np.abs(closure.values[np.isfinite(closure.values)]).max() < 1e-6


def test_cells_that_may_have_gained_or_lost_have_their_systematic_error_in_both(base, stored):
    """Places of one cell amid changes of the size of their errors, by dense matrices.

    The mean of the cells around decides, also of those outside the place. A quarter of the cells is certain.
    """
    height_m = stored.elevation.values[LAST].astype(float)
    random_m2 = independent_m2(stored, LAST, reference_random_m2(base))
    reference = random_parameters(7, 0.5)
    wave_m = 0.2 * np.sin(np.arange(GRID.nx) / 3.0)
    values_m = wave_m + np.random.default_rng(5).normal(0, 0.05, GRID.shape)
    seen = np.isfinite(height_m)
    places, expected = {}, []
    for row, column in np.argwhere(seen)[::23]:
        cell, window = np.zeros(GRID.shape, bool), np.zeros(GRID.shape, bool)
        cell[row, column] = True
        window[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = True
        around = window & seen & ~cell
        value_m, own_m2 = values_m[row, column], random_m2[row, column]
        total_m2 = dense_variance(stored, 1.0 * cell, LAST, random_m2=random_m2, reference=reference)
        deciding_m, deciding_m2 = values_m[around].mean(), random_m2[around].sum() / around.sum() ** 2
        if value_m**2 > 16 * own_m2:
            deciding_m, deciding_m2 = value_m, own_m2
        is_certain = deciding_m**2 > 1.959964**2 * (deciding_m2 + total_m2 - own_m2)
        chosen, other = (own_m2, total_m2), (0.0, 0.0)
        if not is_certain:
            other = deciding_m2, deciding_m2 + total_m2 - own_m2
        places[f"{row} {column}"] = cell
        expected.append((value_m, is_certain, *((chosen, other) if deciding_m > 0 else (other, chosen))))
    assert 0.15 < np.mean([is_certain for _, is_certain, *_ in expected]) < 0.85
    budget, _ = computed(
        base, places, kind="volume_budget", surface="before.tif", rasters={"surface": height_m - values_m}
    )
    for index, (value_m, _, *parts) in enumerate(expected):
        place = budget.isel(place=index)
        assert float(place.net_change[LAST]) == pytest.approx(100.0 * value_m, abs=0.1)
        for name, (random, total) in zip(("deposition", "erosion"), parts, strict=True):
            assert float(place[f"{name}_uncertainty"][LAST]) == pytest.approx(100 * total**0.5, rel=1e-3)
            actual = float(place[f"{name}_random_uncertainty"][LAST])
            assert actual == pytest.approx(100 * random**0.5, rel=1e-3)


ENDS = [(GRID.x_m[4], GRID.y_m[ROW]), (GRID.x_m[34], GRID.y_m[ROW])]  # it climbs by a quarter


@pytest.mark.integration
def test_a_profile_has_the_heights_and_sigmas_of_its_cells(base, stored):
    profile, _ = computed(base, kind="profile", line=ENDS)
    expected_m = stored.elevation.values[LAST, ROW, 4:35]
    np.testing.assert_allclose(profile.elevation.values[LAST], expected_m, atol=1e-3)
    expected_m = stored.elevation_change.values[LAST, ROW, 4:35]
    np.testing.assert_allclose(profile.elevation_change.values[LAST], expected_m, atol=1e-6)
    assert profile.distance.values.tolist() == [10.0 * k for k in range(31)]
    known = np.flatnonzero(np.isfinite(expected_m))
    random_m2 = independent_m2(stored, LAST, reference_random_m2(base))
    for sample in known[::8].tolist():
        weights = np.zeros(GRID.shape)
        weights[ROW, 4 + sample] = 1.0
        total = dense_variance(
            stored, weights, LAST, random_m2=random_m2, reference=random_parameters(7, 0.5)
        )
        assert_sigmas(
            profile.isel(distance=sample), "elevation", LAST, random=random_m2[ROW, 4 + sample], total=total
        )


def test_a_contour_is_where_the_surface_crosses_the_height(base, stored):
    """On a plane that climbs by a quarter; the error of the height moves it four times as far."""
    heights_m = stored.elevation.values[LAST, ROW, 4:35].astype(float)
    first = next(k for k in range(8, 28) if np.isfinite(heights_m[k - 1 : k + 3]).all())
    level_m = heights_m[first : first + 2].mean()
    contour, _ = computed(base, kind="contour", line=ENDS, height_m=level_m)
    start_m = 2800 + EAST * (GRID.x_m[4] - GRID.west_m) - 0.125 * (GRID.y_m[ROW] - GRID.north_m)
    expected_m = (level_m - start_m - np.nanmean(stored.elevation_change.values[LAST])) / EAST
    assert float(contour.distance[LAST, 0]) == pytest.approx(expected_m, abs=1.0)  # cells scatter by 0.1 m

    random_m2 = independent_m2(stored, LAST, reference_random_m2(base))
    _, along, relief, relief_m2 = crossing(10.0 * np.arange(31), heights_m, random_m2[ROW, 4:35], level_m)
    weights = np.zeros(GRID.shape)
    weights[ROW, 4:35] = along
    total = dense_variance(stored, weights, LAST, random_m2=random_m2, reference=random_parameters(7, 0.5))
    random = np.nansum(weights**2 * random_m2) + relief_m2 * relief @ relief
    total += relief_m2 * relief @ relief
    assert_sigmas(contour, "distance", LAST, random=random, total=total, rel=2e-3)  # heights are f4


@pytest.mark.parametrize(("sop_scan_count", "share"), [(1, 1.0), (None, 0.0)])
def test_heights_without_adjustment_have_the_error_of_the_scan_of_the_sop(tmp_path, sop_scan_count, share):
    """As large as that of its own log. The movement of a contour has what both places do not share."""
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    write_reference(series, replace(make_reference(), sop_scan_count=sop_scan_count))
    shared = random_parameters(1, 1.0)
    epochs.write_epoch(series, make_epoch(1, "none", shared))
    build_series(series)
    in_log = np.array([name.startswith(("tilt_", "sight_tilt_")) for name in shared.names])
    assert 2 < in_log.sum() < len(in_log)
    sop = replace(shared, covariance=share * np.where(np.outer(in_log, in_log), shared.covariance, 0.0),
                  line_tilt_variance=0.0 * shared.line_tilt_variance)  # fmt: skip
    with open_with_processing(series.folder) as ds:
        stored = ds.load()
    random_m2 = independent_m2(stored, 0, reference_random_m2(series))
    cells = np.zeros(GRID.shape, bool)
    cells[5:9, 10:14] = np.isfinite(stored.elevation_change.values[0, 5:9, 10:14])
    point, _ = computed(series, {"stake": cells}, kind="point", at=(GRID.x_m[11], GRID.y_m[6]))
    total = dense_variance(stored, cells / cells.sum(), 0, random_m2=random_m2, reference=sop)
    assert float(point.elevation_uncertainty[0, 0]) == pytest.approx(total**0.5, rel=1e-4)
    change = dense_variance(stored, cells / cells.sum(), 0, reference=random_parameters(7, 0.5))
    assert float(point.elevation_change_uncertainty[0, 0]) == pytest.approx(change**0.5, rel=1e-4)

    heights_m = stored.elevation.values[0, ROW, 4:35].astype(float)
    level_m = np.nanmedian(heights_m)
    contour, _ = computed(series, kind="contour", line=ENDS, height_m=float(level_m))
    place = crossing(10.0 * np.arange(31), heights_m, random_m2[ROW, 4:35], level_m)
    base_m = make_reference().elevation_m[ROW, 4:35]
    base = crossing(10.0 * np.arange(31), base_m, reference_random_m2(series)[ROW, 4:35], level_m)
    weights, base_weights = np.zeros((2, *GRID.shape))
    weights[ROW, 4:35], base_weights[ROW, 4:35] = place[1], base[1]
    own = dense_variance(stored, weights, 0, random_m2=0 * random_m2)
    of_sop, apart = (
        shared_variance(stored, a, 0, sop.covariance, sop.line_tilt_variance)
        for a in (weights, weights - base_weights)
    )
    actual = float(contour.distance_systematic_uncertainty[0, 0]) ** 2
    assert actual == pytest.approx(own + of_sop, rel=2e-3)
    reference = random_parameters(7, 0.5)
    of_base = shared_variance(stored, base_weights, 0, reference.covariance, reference.line_tilt_variance)
    actual = float(contour.distance_change_systematic_uncertainty[0, 0]) ** 2
    assert actual == pytest.approx(own + of_base + apart, rel=2e-3)


def test_only_new_epochs_and_those_that_depend_on_them_are_computed(base, box, tmp_path):
    series = copied(base, tmp_path / "store")
    settings = {"kind": "snow_depth", "surface": SUMMER_TIME}
    (late,) = [epoch for epoch in epochs.epoch_files(series) if epoch.start.day == 22]
    aside = late.path.rename(tmp_path / late.path.name)
    build_series(series)
    without, count = computed(series, {"bowl": box}, **settings)
    assert (count, without.sizes["time"]) == (2, 2)
    assert computed(series, {"bowl": box}, **settings)[1] == 0
    aside.rename(late.path)
    build_series(series)
    with_late, count = computed(series, {"bowl": box}, **settings)
    assert count == 2  # the late scan, and that 24 h after it
    assert with_late.isel(time=[0]).equals(without.isel(time=[0]))
    path = product_path(series.folder, "test")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    repaired, count = computed(series, {"bowl": box}, **settings)
    assert count == 3
    assert repaired.equals(with_late)
    assert computed(series, {"bowl": box}, offset_m=0.1, **settings)[1] == 3
    update_products(series, [], ["other"], lambda: None)
    assert not path.exists()


@pytest.mark.integration
@pytest.mark.parametrize("span", [("2026-07-01", "2026-08-01"), ("2025-11-21", "2025-11-24")])
def test_nothing_is_written_until_the_time_of_the_surface_is_over(base, box, tmp_path, span):
    series = copied(base, tmp_path / "store")
    time = dict(zip(("from", "to"), (f"{day}T00:00:00Z" for day in span), strict=True))
    section = ProductSection.model_validate({"name": "test", "kind": "snow_depth", "surface": time})
    update_products(series, [Product(section, {"bowl": box})], ["test"], lambda: None)
    assert not product_path(series.folder, "test").exists()


@pytest.mark.integration
def test_unusable_scans_are_no_surface_and_no_earlier_snow(base, box, tmp_path):
    series = copied(base, tmp_path / "store")
    epoch = replace(make_epoch(31, "joint", random_parameters(31, 0.3)), verdict="unusable")
    epochs.write_epoch(series, replace(epoch, start_s=epoch.start_s - 1800))  # nearer to 24 h than no other
    build_series(series)
    depth, _ = computed(series, {"bowl": box}, kind="snow_depth", surface=SUMMER_TIME)
    expected, _ = computed(base, {"bowl": box}, kind="snow_depth", surface=SUMMER_TIME)
    assert float(depth.new_snow_24h[-1, 0]) == float(expected.new_snow_24h[-1, 0])


@pytest.mark.parametrize(
    "points",
    [
        [(632_012.0, 5_185_990.0), (632_333.0, 5_185_777.0)],
        [(632_000.0, 5_185_900.0), (632_390.0, 5_185_900.0)],
    ],
)
def test_samples_of_a_line_interpolate_a_plane_exactly(points):
    grid = Grid(632_000.0, 5_186_000.0, 10.0, 40, 30)
    line = sample_line(points, grid)
    plane = 3.0 + 0.25 * grid.x_m[None, :] - 0.5 * grid.y_m[:, None]
    weights, complete = line.weights(np.ones(grid.shape, bool))
    assert complete.all()
    np.testing.assert_allclose(weights @ plane[line.cells], 3.0 + 0.25 * line.x_m - 0.5 * line.y_m)
    start, end = np.array(points)
    direction = (end - start) / np.linalg.norm(end - start)
    along = (np.stack([line.x_m, line.y_m], axis=-1) - start) @ direction
    np.testing.assert_allclose(along, line.distance_m, atol=1e-6)
