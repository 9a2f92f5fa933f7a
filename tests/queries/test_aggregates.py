"""Variances of boxes, areas, volumes and differences from the store, compared with dense matrix algebra."""

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import numpy as np
import pytest
from support.epochs import START_S
from support.plane_store import (
    AXIS,
    GRID,
    PARAMS,
    dense_jacobian,
    dense_variance,
    independent_m2,
    make_epoch,
    make_reference,
    random_parameters,
    reference_random_m2,
)  # fmt: skip
from support.series import copied, open_with_processing
from support.shared_parameters import SCANNER

import station
from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.compaction import compact
from station.archive.series.virtual import build_series
from station.errors import StationError, StoreError
from station.quantities import (
    ChangeErrors,
    Quality,
    SharedParameters,
    VarianceComponents,
)
from station.queries.aggregates import Aggregates
from station.queries.common_errors import common_error_covariance
from station.science.adjustment import ground_classes, prior
from station.science.adjustment.joint import adjust_scan
from station.science.adjustment.patches import Patches
from station.science.analysis.voids import area_weights, void_variance
from station.science.uncertainty import jacobian, parameters, propagation

ALL_CELLS = np.ones(GRID.shape, bool)
LOG_ONLY, JOINT, NO_PARAMETERS, EMPTY = range(4)  # epochs of the store


@pytest.fixture(scope="module")
def base_store(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("base"), "hef", GRID, "EPSG:32632")
    write_reference(series, make_reference())
    epochs.write_epoch(series, make_epoch(1, "none", random_parameters(1, 1.0)))
    epochs.write_epoch(series, make_epoch(3, "joint", random_parameters(3, 0.3)))
    epochs.write_epoch(series, make_epoch(6, "none", None))
    epochs.write_epoch(series, make_epoch(9, "none", random_parameters(9, 1.0), empty=True))
    build_series(series)
    return series


@pytest.fixture
def stored(base_store, tmp_path):
    """A store of four epochs that a test may change."""
    return copied(base_store, tmp_path / "store")


class Queries(Aggregates):
    """Queries with epochs given by their index in the series."""

    def variance_of(self, weights, *indices):
        return self.variance(weights, *map(self.find_epoch, indices))

    def area_of(self, cells, *indices):
        return self.area(cells, *map(self.find_epoch, indices))


def weight_cases(ds, *indices):
    """Return weights of a cell, a box, a volume and a contrast; each also with zeros at unobserved cells."""
    known = np.isfinite(make_reference().elevation_m)
    observed = np.logical_and.reduce([np.isfinite(ds.elevation_change[i].values) for i in indices]) & known
    cases = [np.zeros(GRID.shape) for _ in range(4)]
    cases[0][tuple(np.argwhere(observed)[70])] = 1
    cases[1][5:15, 5:15] = 0.01
    cases[2][:] = 100
    cases[3][:] = np.random.default_rng(4).normal(size=GRID.shape)
    return [(weights, np.where(observed, weights, 0.0)) for weights in cases]


def test_the_variance_of_an_unadjusted_epoch_includes_its_covariance_and_the_references(stored):
    queries = Queries(stored)
    with open_with_processing(stored.folder) as ds:
        for weights, counted in weight_cases(ds, LOG_ONLY):
            variance = queries.variance_of(weights, LOG_ONLY)
            expected = dense_variance(ds, counted, LOG_ONLY, reference=random_parameters(7, 0.5))
            assert variance == pytest.approx(expected, rel=1e-4)
            assert variance > 1.01 * dense_variance(ds, counted, LOG_ONLY)
            assert station.variance(stored.folder, weights, LOG_ONLY) == variance


def test_the_variance_of_an_adjusted_epoch_is_relative_to_the_reference(stored):
    queries = Queries(stored)
    with open_with_processing(stored.folder) as ds:
        for weights, counted in weight_cases(ds, JOINT):
            variance = queries.variance_of(weights, JOINT)
            assert variance == pytest.approx(dense_variance(ds, counted, JOINT), rel=1e-4)
            assert station.variance(stored.folder, weights, JOINT) == variance


def test_an_older_epoch_without_cross_tilt_is_read_as_if_its_variance_were_zero(stored):
    full = random_parameters(13, 0.3)
    older = np.array(["cross_tilt" not in name for name in full.names])
    names, units = (tuple(np.array(texts)[older]) for texts in (full.names, full.units))
    reduced = SharedParameters(
        names,
        units,
        full.estimate[older],
        full.covariance[np.ix_(older, older)],
        full.line_tilt_variance[older],
    )
    zero = replace(full, covariance=np.where(np.outer(older, older), full.covariance, 0.0))
    for hour, shared in ((12, reduced), (13, zero)):
        epochs.write_epoch(stored, replace(make_epoch(12, "joint", shared), start_s=START_S + 3600 * hour))
    queries = Queries(stored)
    weights = np.full(GRID.shape, 1.0)
    assert queries.variance_of(weights, -2) == pytest.approx(queries.variance_of(weights, -1), rel=1e-6)


def test_a_difference_has_the_errors_of_both_epochs_and_none_of_the_reference(stored):
    queries, reference_m2 = Queries(stored), reference_random_m2(stored)
    with open_with_processing(stored.folder) as ds:
        for weights, counted in weight_cases(ds, LOG_ONLY, JOINT):
            expected = sum(
                dense_variance(ds, counted, index, random_m2=independent_m2(ds, index, reference_m2))
                for index in (LOG_ONLY, JOINT)
            )
            variance = queries.variance_of(weights, LOG_ONLY, JOINT)
            assert variance == pytest.approx(expected, rel=1e-4)
            assert variance == pytest.approx(queries.variance_of(weights, JOINT, LOG_ONLY))
            assert station.variance(stored.folder, weights, LOG_ONLY, JOINT) == variance


@pytest.mark.integration
def test_leverage_reduces_the_variance_of_a_difference(stored):
    """Σ a² σ² + aᵀ Σ (a - 2 h a), dense, with leverage h by ground class; none relative to the reference."""
    excess_m2 = {"adjustment_leverage_moving": 4e-4, "adjustment_leverage_stable": 1e-4}
    rng = np.random.default_rng(5)
    for hour in (12, 13):
        epoch = make_epoch(hour, "joint", random_parameters(hour, 0.02))
        stable_flag = np.where(rng.uniform(size=GRID.shape) < 0.4, int(Quality.STABLE_GROUND), 0).ravel()
        quality = np.where(epoch.measurement.quality, stable_flag, 0).astype(np.uint8)
        measurement = replace(epoch.measurement, quality=quality)
        epochs.write_epoch(stored, replace(epoch, measurement=measurement, scalars=SCANNER | excess_m2))
    build_series(stored)
    queries, reference_m2 = Queries(stored), reference_random_m2(stored)
    holdout = ground_classes.is_holdout(*np.meshgrid(GRID.x_m, GRID.y_m))
    assert 0 < holdout.sum() < holdout.size
    with open_with_processing(stored.folder) as ds:
        for weights, counted in weight_cases(ds, -2, -1):
            expected, without_leverage = 0.0, 0.0
            for index in (-2, -1):
                random_m2 = independent_m2(ds, index, reference_m2)
                stable = (ds.quality[index].values.astype(int) & Quality.STABLE_GROUND) > 0
                leverage = random_m2 / (random_m2 + reference_m2 + np.where(stable, 1e-4, 4e-4))
                leverage = np.where(stable & holdout, 0.0, leverage)
                leveraged = np.where(counted != 0, counted * leverage, 0.0)
                both, alone, rest = (
                    dense_variance(ds, a, index, random_m2=0 * random_m2)
                    for a in (counted + leveraged, counted, leveraged)
                )
                random_part = np.nansum(counted**2 * random_m2)
                epoch_variance = random_part + alone - (both - alone - rest)
                assert epoch_variance > np.nansum(counted * (counted - leveraged) * random_m2)  # lower bound
                expected += epoch_variance
                without_leverage += random_part + alone
            variance = queries.variance_of(weights, -2, -1)
            assert variance == pytest.approx(expected, rel=1e-4)
            assert abs(variance - without_leverage) > 1e-3 * without_leverage
            assert queries.variance_of(counted, -1) == pytest.approx(
                dense_variance(ds, counted, -1), rel=1e-4
            )
            volume = station.volume(stored.folder, weights > 0, -1, -2)
            assert float(volume.variance_share.sum()) == pytest.approx(1)


def epoch_after_change(size, pattern, hour, *, version="1", adjustment="joint"):
    """Return an epoch with one mode of change errors, in a column of its own: modes have no order."""
    shared = random_parameters(20, 0.3)
    sigma = np.sqrt(np.diag(shared.covariance))
    mode = sigma * np.random.default_rng(21).normal(size=len(shared.names)) * size
    modes = np.zeros((len(mode), 32))
    modes[:, hour % 32] = mode
    covariance = shared.covariance + np.outer(mode, mode)
    shared = replace(shared, covariance=covariance, change_errors=ChangeErrors(modes, pattern))
    epoch = make_epoch(hour, adjustment, shared)
    return replace(epoch, provenance=epoch.provenance | {"reference_version": version})


PATTERN = np.where(np.arange(288) % 5 == 0, np.random.default_rng(8).normal(size=288), 0.0)


@pytest.mark.integration
@pytest.mark.parametrize(("factor", "correlation"), [(1.0, 1.0), (0.5, 0.8), (-1.0, -1.0)])
def test_common_errors_after_similar_change_cancel_in_a_difference(stored, factor, correlation):
    """Errors s and t of one mode contribute (s - t)², as far as the change patterns are correlated."""
    pattern = np.where(PATTERN != 0, PATTERN - PATTERN[PATTERN != 0].mean(), 0.0)
    sizes = {12: 3.0, 13: -2.0}  # a mode has no sign
    for (hour, size), scaled in zip(sizes.items(), (pattern, factor * pattern), strict=True):
        epochs.write_epoch(stored, epoch_after_change(size, scaled, hour))
    build_series(stored)
    queries, reference_m2, shares = Queries(stored), reference_random_m2(stored), []
    with open_with_processing(stored.folder) as ds:
        for weights, counted in weight_cases(ds, -2, -1):
            total, effects = 0.0, []
            for index, hour in ((-2, 12), (-1, 13)):
                random_m2 = independent_m2(ds, index, reference_m2)
                total += dense_variance(ds, counted, index, random_m2=random_m2)
                gradient = np.nan_to_num(counted).ravel() @ dense_jacobian(ds, index)[0]
                effects.append(gradient @ ds.change_errors[index].values.astype(float)[:, hour % 32])
            common = 2 * correlation * abs(effects[0] * effects[1])
            variance = queries.variance_of(weights, -2, -1)
            assert variance == pytest.approx(total - common, rel=1e-3)
            assert variance == pytest.approx(queries.variance_of(weights, -1, -2))
            shares.append(abs(common) / total)
    assert max(shares) > 0.2
    volume = station.volume(stored.folder, weights > 0, -1, -2)
    assert float(volume.variance_share.sum()) == pytest.approx(1)
    variance = queries.variance_of(weights, -2, -1)
    compact(stored, datetime(2025, 12, 31, tzinfo=UTC), lambda: None)
    build_series(stored)
    assert Queries(stored).variance_of(weights, -2, -1) == pytest.approx(variance)


@pytest.mark.parametrize("change", [{"version": "2"}, {"adjustment": "none"}])
def test_epochs_relative_to_different_surfaces_have_no_common_errors(stored, change):
    write_reference(stored, replace(make_reference(), version="2"))
    for hour, options in ((12, {}), (13, {}), (14, change)):
        epochs.write_epoch(stored, epoch_after_change(3.0, PATTERN, hour, **options))
    queries = Queries(stored)
    first, similar, different = (
        queries.read_cells(queries.find_epoch(index), ALL_CELLS) for index in (-3, -2, -1)
    )
    assert common_error_covariance([first, similar]) is not None
    assert common_error_covariance([first, different]) is None
    assert common_error_covariance([first]) is None


@pytest.mark.integration
def test_the_variance_of_a_difference_is_at_least_its_random_part(stored):
    """Even with inconsistent modes, far larger than the covariance that they should be part of."""
    for hour in (12, 13):
        epoch = epoch_after_change(3.0, PATTERN, hour)
        change_errors = ChangeErrors(50 * epoch.shared.change_errors.modes, PATTERN)
        epochs.write_epoch(stored, replace(epoch, shared=replace(epoch.shared, change_errors=change_errors)))
    build_series(stored)
    queries, reference_m2 = Queries(stored), reference_random_m2(stored)
    with open_with_processing(stored.folder) as ds:
        for weights, counted in weight_cases(ds, -2, -1):
            random_m2 = sum(independent_m2(ds, index, reference_m2) for index in (-2, -1))
            lower_bound = np.nansum(counted**2 * random_m2)
            assert queries.variance_of(weights, -2, -1) == pytest.approx(lower_bound, rel=1e-4)


def test_an_epoch_without_shared_parameters_has_random_errors_only(stored):
    queries = Queries(stored)
    with open_with_processing(stored.folder) as ds:
        random_m2 = ds.elevation_change_random_uncertainty[NO_PARAMETERS].values.astype(float) ** 2
        for weights, counted in weight_cases(ds, NO_PARAMETERS):
            expected = np.nansum(counted**2 * random_m2)
            assert queries.variance_of(weights, NO_PARAMETERS) == pytest.approx(expected, rel=1e-5)


def test_an_epoch_after_a_relocation_has_a_variance(stored):
    relocated = SCANNER | {"scanner_east": 632_200.0, "scanner_north": 5_185_000.0}
    params = parameters.parameter_layout(GRID, tuple(list(relocated.values())[:3]), AXIS)
    assert params.names != PARAMS.names
    size = len(params.names)
    shared = SharedParameters(
        params.names, params.units, np.zeros(size), 1e-10 * np.eye(size), np.zeros(size)
    )
    epochs.write_epoch(stored, replace(make_epoch(12, "none", shared), scalars=relocated))
    build_series(stored)
    assert Queries(stored).variance_of(np.full(GRID.shape, 1e-3), -1) > 0


def test_cells_without_a_change_do_not_contribute(stored):
    queries = Queries(stored)
    with open_with_processing(stored.folder) as ds:
        unobserved = np.isnan(ds.elevation_change[LOG_ONLY].values) | np.isnan(make_reference().elevation_m)
    assert unobserved.sum() > 200
    weights = np.full(GRID.shape, 1e-3)
    heavy = np.where(unobserved, 1e3, weights)
    assert queries.variance_of(heavy, LOG_ONLY) == queries.variance_of(weights, LOG_ONLY)
    assert queries.variance_of(unobserved.astype(float), LOG_ONLY) == 0.0
    assert queries.variance_of(np.zeros(GRID.shape), LOG_ONLY) == 0.0
    assert queries.variance_of(weights, EMPTY) == 0.0


@pytest.mark.integration
def test_compaction_changes_no_variance(stored):
    weights = np.full(GRID.shape, 1e-3)
    single = Queries(stored)
    variances = [single.variance_of(weights, index) for index in (LOG_ONLY, JOINT, EMPTY)]
    difference = single.variance_of(weights, LOG_ONLY, JOINT)
    area = single.area_of(weights > 0, JOINT)
    # Epochs with and without shared parameters cannot be compacted together.
    epochs.revisions(stored, single.find_epoch(NO_PARAMETERS).start)[0].path.unlink()
    epochs.write_epoch(stored, make_epoch(12, "none", random_parameters(1, 1.0)))
    assert len(compact(stored, datetime(2025, 11, 23, tzinfo=UTC), lambda: None)) == 1
    build_series(stored)
    compacted = Queries(stored)
    refs = [compacted.find_epoch(index) for index in range(4)]
    assert {ref.path.parts[-4] for ref in refs} == {"days"}
    assert [ref.index for ref in refs] == [0, 1, 2, 3]
    assert [compacted.variance_of(weights, index) for index in range(3)] == variances
    assert compacted.variance_of(weights, 0, 1) == difference
    assert compacted.area_of(weights > 0, 1) == area


def test_epochs_are_found_by_index_and_by_the_nearest_time(stored):
    queries = Queries(stored)
    times_s = [START_S + 3600 * hour + 450 for hour in (1, 3, 6, 9)]
    assert [queries.find_epoch(index).time_s for index in range(4)] == times_s
    assert queries.find_epoch(-1) == queries.find_epoch(3) == queries.find_epoch(np.int64(3))
    for requested, index in (
        ("2025-11-21T01:07:30", 0),
        ("2025-11-21T02:20", 1),
        (np.datetime64("2025-11-21T05:00:00.000"), 2),
        ("2025-11-21", 0),
    ):
        assert queries.find_epoch(requested) == queries.find_epoch(index)
    for far_off in ("1999-01-01", "2050-01-01"):
        with pytest.raises(StationError, match=rf"within 12 h of {far_off} .* nearest is that of 2025"):
            queries.find_epoch(far_off)
    weights = np.ones(GRID.shape)
    by_time = station.variance(stored.folder, weights, "2025-11-21T03:00")
    assert by_time == station.variance(stored.folder, weights, JOINT)
    assert station.variance(stored.folder, weights, JOINT, JOINT) == 0.0
    with pytest.raises(StationError, match="no epoch 4: the series has 4"):
        queries.find_epoch(4)


def area_with_voids(ds, *indices):
    """Return an area, its observed cells, their weights in its mean, and the fill distance of the voids."""
    area = np.zeros(GRID.shape, bool)
    area[10:20, 10:30] = True
    observed = np.logical_and.reduce([np.isfinite(ds.elevation_change[i].values) for i in indices])
    assert (area & ~observed).sum() > 20
    return area, area & observed, *area_weights(area, observed)


def test_mean_and_median_of_an_area_with_voids(stored):
    queries = Queries(stored)
    with open_with_processing(stored.folder) as ds:
        for index in (LOG_ONLY, JOINT, NO_PARAMETERS):
            area, observed, weights, fill_distance = area_with_voids(ds, index)
            change_m = np.where(observed, ds.elevation_change[index].values, np.nan).astype(float)
            random_m2 = ds.elevation_change_random_uncertainty[index].values.astype(float) ** 2
            actual = queries.area_of(area, index)
            assert actual.coverage == observed.sum() / area.sum()
            assert actual.mean_m == pytest.approx(np.nansum(weights * change_m), rel=1e-6)
            void_m2 = void_variance(area, fill_distance, change_m, random_m2)
            assert void_m2 > 0
            expected_m2 = queries.variance_of(weights, index) + void_m2
            assert actual.mean_sigma_m**2 == pytest.approx(expected_m2, rel=1e-5)
            assert actual.median_m == pytest.approx(np.nanmedian(change_m))
            equal = observed / observed.sum()
            excess_m2 = (np.pi / 2 - 1) * np.nansum(equal**2 * random_m2)  # random part of a median
            expected_m2 = queries.variance_of(equal, index) + excess_m2
            assert actual.median_sigma_m**2 == pytest.approx(expected_m2, rel=1e-5)
    for missing in (queries.area_of(area, EMPTY), queries.area_of(area & ~area, LOG_ONLY)):
        assert np.isnan(
            [missing.mean_m, missing.mean_sigma_m, missing.median_m, missing.median_sigma_m]
        ).all()
        assert missing.coverage == 0.0


def test_the_change_of_an_area_between_two_epochs(stored):
    queries = Queries(stored)
    with open_with_processing(stored.folder) as ds:
        area, observed, weights, _ = area_with_voids(ds, JOINT, LOG_ONLY)
        change_m = (ds.elevation_change[JOINT] - ds.elevation_change[LOG_ONLY]).values.astype(float)
    forward, backward = queries.area_of(area, JOINT, LOG_ONLY), queries.area_of(area, LOG_ONLY, JOINT)
    assert forward.mean_m == pytest.approx(np.nansum(weights * change_m), rel=1e-6) == -backward.mean_m
    assert forward.median_m == pytest.approx(np.median(change_m[observed])) == -backward.median_m
    assert forward.mean_sigma_m == pytest.approx(backward.mean_sigma_m)
    assert forward.mean_sigma_m**2 > queries.variance_of(weights, JOINT, LOG_ONLY)
    assert forward.coverage == observed.sum() / area.sum()


def test_an_empty_store_and_a_missing_reference_are_reported(tmp_path):
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    with pytest.raises(StoreError, match="nothing is stored"):
        Queries(series).find_epoch(0)
    epochs.write_epoch(series, make_epoch(1, "none", random_parameters(1, 1.0)))
    build_series(series)
    with pytest.raises(StoreError, match="no reference"):
        Queries(series).variance_of(np.ones(GRID.shape), 0)


SECTOR = parameters.ParameterLayout(np.radians(20.0), 40, full_circle=False)
LINES, RANGE_BINS = np.meshgrid(np.arange(200), np.arange(8, 32))  # 640 to 2,560 m away
FAR = RANGE_BINS >= 27
RANGE_BIN_M = 80.0


def glacier_jacobian(azimuth_deg, range_m):
    """Return the Jacobian of points on an undulating glacier."""
    azimuth_rad = np.radians(azimuth_deg)
    x, y = range_m * np.sin(azimuth_rad), range_m * np.cos(azimuth_rad)
    slopes = 0.2 * np.sin(x / 300), 0.1 + 0.2 * np.cos(y / 400)
    return jacobian.height_jacobian(SECTOR, (x, y, 100 * np.sin(x / 500) - 300), *slopes)


def gradient_by_line(height_jacobian, weights):
    """Return the derivatives (10 + lines + knots,) of a weighted sum by the state with tilt by line."""
    by_knot = height_jacobian.aggregate(weights)
    by_line = height_jacobian.aggregate_by_line(weights)
    return np.concatenate([by_knot[:10], by_line, by_knot[10 + SECTOR.sight_tilt_knots :]])


@cache
def adjusted(scene):
    """Return the adjustment of a scan to ground of a scene, without change, with residuals of 3 mm."""
    lines = prior.line_times(SECTOR, np.eye(3), None)
    state_prior = prior.state_prior(SECTOR, lines, VarianceComponents(), weather_known=True)
    rng = np.random.default_rng(8)
    observed, stable = {
        "nothing": (FAR & ~FAR, FAR),
        "a ring of rock": (FAR, FAR),
        "a far ridge": (FAR & (LINES < 50), FAR),
        "a far ridge and a glacier": (~FAR | (LINES < 50), FAR),
        "scattered rock": (rng.uniform(size=FAR.shape) < 0.3, rng.uniform(size=FAR.shape) < 0.4),
    }[scene]
    line, range_bin, ground_class = LINES[observed], RANGE_BINS[observed], stable[observed].astype(np.int64)
    height_jacobian = glacier_jacobian(20 + 0.2 * (line + 0.5), RANGE_BIN_M * (range_bin + 0.5))
    count = len(line)
    patches = Patches(
        height_jacobian,
        range_bin,
        np.zeros(count),
        ground_class,
        rng.normal(0, 0.003, count),
        np.full(count, 9e-6),
        np.ones(count),
        np.zeros(count),
    )
    return adjust_scan(patches, np.zeros((3, SECTOR.line_groups)), state_prior, None)


def sample_jacobians(size_m, count=40):
    """Return the Jacobians of cells, boxes or an area spread over the glacier."""
    rng = np.random.default_rng(11)
    azimuth_deg, range_m = rng.uniform(23, 57, count), rng.uniform(800, 2900, count)
    if size_m == "area":
        return [glacier_jacobian(rng.uniform(22, 58, 8000), rng.uniform(800, 2900, 8000))]
    side_m = np.arange(1.25, size_m, 2.5) - size_m / 2
    result = []
    for azimuth, distance in zip(np.radians(azimuth_deg), range_m, strict=True):
        x, y = (
            axis.ravel()
            for axis in np.meshgrid(distance * np.sin(azimuth) + side_m, distance * np.cos(azimuth) + side_m)
        )
        result.append(glacier_jacobian(np.degrees(np.arctan2(x, y)), np.hypot(x, y)))
    return result


def rms_sigmas(scene, size_m):
    """Return the root mean square sigma of means, from the stored and from the full covariance by line."""
    adjustment = adjusted(scene)
    shared = adjustment.shared
    stored_m2, full_m2 = [], []
    for height_jacobian in sample_jacobians(size_m):
        count = len(height_jacobian)
        weights = np.full(count, 1 / count)
        gradient = gradient_by_line(height_jacobian, weights)
        stored_m2.append(propagation.aggregate_variance(weights, np.zeros(count), height_jacobian, shared))
        full_m2.append(gradient @ adjustment.covariance @ gradient)
    return np.sqrt(np.mean(stored_m2)), np.sqrt(np.mean(full_m2))


@pytest.mark.parametrize(
    "size_m", [2.5, *(pytest.param(size, marks=pytest.mark.integration) for size in (10, 100)), "area"]
)
@pytest.mark.parametrize(
    "scene", ["nothing", "a ring of rock", "a far ridge", "a far ridge and a glacier", "scattered rock"]
)
def test_condensing_the_covariance_to_knots_changes_sigma_by_less_than_five_percent(scene, size_m):
    stored_m, full_m = rms_sigmas(scene, size_m)
    assert stored_m == pytest.approx(full_m, rel=0.05)


def test_coarsened_cells_are_means_of_their_points(stored):
    """Compared with a plain loop; the shared part of the variance does not shrink with the points."""
    cells = 7
    actual = station.coarsen(stored.folder, JOINT, cells)
    with open_with_processing(stored.folder) as ds:
        change, sigma, random, count = (
            ds[name][JOINT].values.astype(float)
            for name in (
                "elevation_change",
                "elevation_change_uncertainty",
                "elevation_change_random_uncertainty",
                "point_count",
            )
        )
        assert actual.x.values[0] == pytest.approx(ds.x.values[:cells].mean())
        assert actual.y.values[1] == pytest.approx(ds.y.values[cells : 2 * cells].mean())
    assert actual.elevation_change.shape == tuple(size // cells for size in change.shape)
    blocks_compared = 0
    for row, column in np.ndindex(actual.elevation_change.shape):
        block = np.s_[row * cells : (row + 1) * cells, column * cells : (column + 1) * cells]
        observed = np.isfinite(change[block])
        if not observed.any():
            assert np.isnan(actual.elevation_change[row, column])
            continue
        n = count[block][observed]
        mean_m = np.sum(n * change[block][observed]) / n.sum()
        random_m2 = np.sum((n * random[block][observed]) ** 2) / n.sum() ** 2
        shared_m2 = np.sum(n * (sigma[block][observed] ** 2 - random[block][observed] ** 2)) / n.sum()
        assert actual.elevation_change[row, column] == pytest.approx(mean_m, rel=1e-5)
        assert actual.elevation_change_uncertainty[row, column] == pytest.approx(
            np.sqrt(random_m2 + shared_m2), rel=1e-5
        )
        blocks_compared += 1
    assert blocks_compared > 5
    with pytest.raises(ValueError, match="do not fit"):
        station.coarsen(stored.folder, JOINT, 10_000)


def test_weights_on_another_grid_are_rejected(stored):
    """A single cell, or rows and columns exchanged, would otherwise give a variance of zero."""
    for weights in (np.ones((1, 1)), np.ones(GRID.shape).T, np.ones(GRID.nx * GRID.ny)):
        with pytest.raises(ValueError, match="the array has shape"):
            station.variance(stored.folder, weights, JOINT)
