"""Maps: colours by cell, block means where cells are smaller than pixels, file size."""

import io
from dataclasses import replace

import netCDF4
import numpy as np
import pytest
from PIL import Image

from station.archive import epochs
from station.archive.derived.computed_rasters import open_raster
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series import index
from station.archive.series.virtual import build_series
from station.grid_plane import GridPlane
from station.products import maps
from station.products.colours import change_scale, points_scale, round_up, sigma_scale
from station.products.maps import (
    HATCH,
    MAX_BYTES,
    PAPER,
    Caption,
    change_map,
    encode_webp,
    points_map,
    sigma_map,
)
from station.products.overview import OverviewBuilder, base_map, difference_overview, read_overview
from station.quantities import ChangeErrors, Grid, SharedParameters
from station.queries.aggregates import Aggregates
from station.science.uncertainty.parameters import parameter_layout

CAPTION = Caption("Hintereisferner", "2025-11-21 05:00 UTC", "degraded: no weather")
WIDTH = 1248  # 20 pixels a cell
SCANNER = (632_300.0, 5_184_500.0, 3200.0)


@pytest.fixture
def last(series):
    return index.list_epochs(series)[-1]


def cell_colour(picture, row, column, shift_px=0):
    """The colour at the centre of a cell of the map, or some pixels east of it."""
    cell_px = (WIDTH - 2 * round(24 * WIDTH / 1200)) / 58
    x = round(24 * WIDTH / 1200) + (column + 0.5) * cell_px
    y = round(92 * WIDTH / 1200) + (row + 0.5) * cell_px
    return np.array(picture.getpixel((int(x) + shift_px, int(y))), dtype=int)


def test_each_cell_has_the_colour_of_its_change(series, last, small):
    overview = read_overview(last, base_map(series, "1", WIDTH))
    assert overview.base.factor == 1
    assert overview.base.hillshade.shape == (45, 58)  # the border without elevations is cut off
    picture = change_map(overview, CAPTION, 0.5, WIDTH, "the reference")
    red, _, blue = cell_colour(picture, *(part.start + 3 for part in small.RISE))
    assert blue > red + 60
    red, _, blue = cell_colour(picture, *(part.start + 3 for part in small.FALL))
    assert red > blue + 60
    still = np.argwhere(overview.observed & ~overview.is_significant)
    unobserved = np.argwhere(~overview.observed)
    for cells, darkest, palest, lines in ((still, 100, 215, 0), (unobserved, 200, 255, 1)):
        for row, column in cells[:: len(cells) // 15]:
            if row > 38 and column < 25:
                continue  # under the legend
            colours = [cell_colour(picture, row, column, shift_px) for shift_px in range(-4, 4)]
            hatched = [np.array_equal(colour, HATCH) for colour in colours]
            assert sum(hatched) == lines  # so that bright ground is not taken for ground not seen
            for colour in (colour for colour, is_line in zip(colours, hatched, strict=True) if not is_line):
                assert np.ptp(colour) <= 3  # grey: change that is not significant has no colour
                assert darkest < colour[0] <= palest
    assert picture.getpixel((1, 1)) == PAPER


def test_significance_equals_the_stored_flag(series, last):
    overview = read_overview(last, base_map(series, "1", WIDTH))
    with netCDF4.Dataset(last.path) as file:
        flagged = (np.asarray(file["quality"][0])[:, :58] & 16) > 0
    assert flagged.sum() > 300
    assert (
        overview.is_significant != flagged
    ).sum() <= 3  # at the threshold, because of the rounding of stored values


@pytest.mark.parametrize("pixels", [29, 19, 11])
def test_pixels_larger_than_cells_show_block_means_and_their_sigma(series, last, small, pixels):
    """Compared with plain loops over the stored values: random errors average out, systematic ones do not."""
    overview = read_overview(last, base_map(series, "1", pixels), points=True)
    factor, base = 58 // pixels, overview.base
    assert base.factor == factor
    assert base.rows.stop - base.rows.start == factor * base.grid.ny
    with netCDF4.Dataset(last.path) as file:
        change, sigma, systematic = (
            np.ma.filled(file[f"elevation_change{suffix}"][0].astype(float), np.nan)[base.rows, base.columns]
            for suffix in ("", "_uncertainty", "_systematic_uncertainty")
        )
        points = np.asarray(file["point_count"][0])[base.rows, base.columns]
    for row, column in np.ndindex(base.grid.shape):
        block = np.s_[row * factor : (row + 1) * factor, column * factor : (column + 1) * factor]
        observed = np.isfinite(change[block])
        if not observed.any():
            assert np.isnan(overview.change_m[row, column])
            continue
        n = observed.sum()
        assert overview.change_m[row, column] == pytest.approx(change[block][observed].mean(), abs=1e-5)
        random_variance = np.sum(sigma[block][observed] ** 2 - systematic[block][observed] ** 2) / n**2
        systematic_variance = np.mean(systematic[block][observed] ** 2)
        assert overview.sigma_m[row, column] == pytest.approx(
            np.sqrt(random_variance + systematic_variance), rel=1e-3
        )
        assert overview.points[row, column] == pytest.approx(points[block].mean())
    assert base.grid.x_m[0] == small.GRID.x_m[base.columns][:factor].mean()
    assert base.grid.y_m[-1] == pytest.approx(small.GRID.y_m[base.rows][-factor:].mean())


@pytest.mark.parametrize("pixels", [WIDTH, 29, 11])
def test_overview_built_while_writing_equals_that_of_the_stored_epoch(series, small, pixels):
    epoch = small.make_epoch(11)
    index = epoch.measurement.cell_index[21, 33]
    epoch.measurement.change_m[index] = np.nan  # points, but no change
    base = base_map(series, "1", pixels)
    builder = OverviewBuilder(base, points=True)
    written = epochs.write_epoch(series, epoch, on_rows=builder.add)
    while_writing = builder.build()
    stored = read_overview(epochs.epochs_in_file(written.path)[0], base, points=True)
    by_bands = OverviewBuilder(base, points=True)
    for top in range(0, small.GRID.ny, 7):  # not a multiple of the pixel size
        rows = slice(top, min(top + 7, small.GRID.ny))
        by_bands.add(rows, {name: open_raster(written.path, name, 0)[rows] for name in by_bands.names})
    assert np.isfinite(while_writing.points).sum() > 100 * (base.factor == 1)
    for name in ("change_m", "sigma_m", "points"):
        expected = getattr(stored, name)
        for actual in (getattr(while_writing, name), getattr(by_bands.build(), name)):
            assert np.array_equal(np.isnan(actual), np.isnan(expected)), name
            assert np.nanmax(np.abs(actual - expected)) <= 1e-6, name


def with_shared(epoch, correlated):
    """An epoch with a systematic tilt error and change errors, `correlated` between epochs or independent."""
    params, rng = parameter_layout(epoch.measurement.grid, SCANNER), np.random.default_rng(5)
    size = len(params.names)
    modes = np.zeros((size, 32))
    modes[:2] = rng.normal(0, 4e-5, (2, 32)) / np.sqrt(32)
    pattern = np.random.default_rng(0 if correlated else int(epoch.start_s)).normal(size=288)
    covariance = modes @ modes.T
    covariance[range(2), range(2)] += 2e-10
    shared = SharedParameters(
        params.names, params.units, np.zeros(size), covariance, np.zeros(size), ChangeErrors(modes, pattern)
    )
    position = dict(zip(("scanner_east", "scanner_north", "scanner_height"), SCANNER, strict=True))
    scalars = epoch.scalars | position | {"scanner_axis_east": 0.0, "scanner_axis_north": 0.0}
    return replace(epoch, shared=shared, scalars=scalars)


@pytest.mark.integration
@pytest.mark.parametrize("pixels", [WIDTH, 29])
@pytest.mark.parametrize(("correlated", "low", "high"), [(True, 0.05, 0.6), (False, 0.8, 1.0)])
def test_sigma_of_a_difference_equals_that_of_the_aggregates(series, small, correlated, low, high, pixels):
    """Sigma of a pixel is that of `station.variance` for the mean of its cells; common errors cancel."""
    for hour in (7, 9):
        epochs.write_epoch(series, with_shared(small.make_epoch(hour), correlated))
    build_series(series)
    other, row = index.list_epochs(series)[-2:]
    overview = difference_overview(row, other, base_map(series, "1", pixels), series)
    aggregates, factor, base = Aggregates(series), overview.base.factor, overview.base
    with netCDF4.Dataset(row.path) as first_file, netCDF4.Dataset(other.path) as second_file:
        changes = [
            np.ma.filled(file["elevation_change"][0].astype(float), np.nan)
            for file in (first_file, second_file)
        ]
    observed = np.isfinite(changes[0] - changes[1])
    shares = []
    for pixel in np.argwhere(overview.observed)[:: 200 // factor**2]:
        weights = np.zeros(small.GRID.shape)
        first = pixel * factor + (base.rows.start, base.columns.start)
        weights[first[0] : first[0] + factor, first[1] : first[1] + factor] = 1
        if not observed[weights > 0].all():
            continue
        weights /= weights.sum()
        expected = aggregates.variance(weights, row, other)
        assert overview.sigma_m[tuple(pixel)] ** 2 == pytest.approx(
            expected, rel=1e-3 if factor == 1 else 0.05
        )
        independent = sum(aggregates.variance(weights, epoch) for epoch in (row, other))
        shares.append(expected / independent)
    assert len(shares) > 5
    assert low < np.median(shares) < high
    if factor == 1:
        assert np.nanmean(overview.change_m[small.RISE]) == pytest.approx(0.10, abs=0.01)


def test_maps_of_sigma_and_point_count(series, last, small):
    overview = read_overview(last, base_map(series, "1", WIDTH), points=True)
    for picture in (sigma_map(overview, CAPTION, 0.5, WIDTH), points_map(overview, CAPTION, WIDTH)):
        assert picture.width == WIDTH
        assert np.ptp(cell_colour(picture, *(part.start + 2 for part in small.UNOBSERVED))) <= 3
        assert np.ptp(cell_colour(picture, 10, 10)) > 20


@pytest.mark.integration
def test_compression_keeps_greys_neutral_and_colours_close(series, last):
    """With a reduced palette no grey takes a tint that could be read as change."""
    overview = read_overview(last, base_map(series, "1", WIDTH))
    picture = change_map(overview, CAPTION, 0.5, WIDTH, "the reference")
    with Image.open(io.BytesIO(encode_webp(picture))) as compressed:
        actual, expected = (np.asarray(image.convert("RGB"), dtype=int) for image in (compressed, picture))
    grey = np.ptp(expected, axis=-1) == 0
    assert grey.sum() > 10_000
    assert np.ptp(actual[grey], axis=-1).max() <= 3
    assert np.abs(actual - expected).mean() < 4
    assert np.percentile(np.abs(actual - expected), 99) < 25


@pytest.mark.integration
def test_quality_chosen_from_sampled_bands_equals_that_of_the_whole_picture(monkeypatch):
    """The result is that of trying each quality on the whole picture."""
    grey = np.random.default_rng(3).normal(150, 12, (700, 500)).clip(90, 250)
    grey[:, 200:] = np.linspace(100, 240, 300)
    picture = Image.fromarray(np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8))
    limits = 70_000, 38_000, 24_000, 17_000, 7_000, 500
    sampled = [encode_webp(picture, max_bytes) for max_bytes in limits]
    monkeypatch.setattr(maps, "SAMPLE_STEP", 1)
    assert sampled == [encode_webp(picture, max_bytes) for max_bytes in limits]
    assert len({len(encoded) for encoded in sampled}) == len(limits)


def test_colour_scales_are_clipped_and_monotonic():
    scale = change_scale(0.5, "the reference")
    colours = scale.paint(np.array([-9.0, -0.5, 0.0, 0.5, 9.0], np.float32)).astype(int)
    assert (colours[0] == colours[1]).all()
    assert (colours[3] == colours[4]).all()
    assert colours[1][0] > colours[1][2]  # red sinks
    assert colours[3][2] > colours[3][0]  # blue rises
    assert colours[2].min() > 200  # no change is nearly white
    for scale in (sigma_scale(0.5), points_scale()):
        brightness = scale.colour_table().astype(int).sum(axis=1)
        assert (np.diff(brightness) <= 3).all()  # larger values are darker
        assert scale.paint(np.array([scale.low / 9, 9 * scale.high])).tolist() == [
            scale.colour_table()[0].tolist(),
            scale.colour_table()[-1].tolist(),
        ]
    assert [round_up(value) for value in (0.11, 0.2, 0.21, 3.0, 0.049, 9.0)] == [0.2, 0.2, 0.5, 5, 0.05, 10]


@pytest.mark.integration
def test_file_size_of_a_map_of_noise(tmp_path, small):
    """One pixel per cell and noise only is the worst case."""
    grid = Grid(632_000.0, 5_186_000.0, 1.0, 1150, 900)
    series = Series(tmp_path, "hef", grid, "EPSG:32632")
    write_reference(series, small.make_reference(grid))
    epochs.write_epoch(series, small.make_epoch(5, grid=grid))
    overview = read_overview(index.list_epochs(series)[0], base_map(series, "1", 1152))
    picture = change_map(overview, CAPTION, 0.03, 1200, "the reference")
    encoded = encode_webp(picture)
    assert 20_000 < len(encoded) <= MAX_BYTES
    with Image.open(io.BytesIO(encoded)) as decoded:
        assert decoded.width >= picture.width / 2
        enlarged = decoded.convert("L").resize(picture.size)
        deviation = np.abs(np.asarray(enlarged, float) - np.asarray(picture.convert("L"), float)).mean()
    assert deviation < 25


def test_the_colour_bar_of_a_plane_names_the_normal(series, last):
    overview, wall = (
        read_overview(last, base_map(series, "1", WIDTH)),
        GridPlane((0.0, 0.0, 0.0), 180.0, 90.0),
    )
    on_plane = replace(overview, base=replace(overview.base, grid=replace(overview.base.grid, plane=wall)))
    assert change_scale(0.5, "May", on_map=False).title == "change along the normal since May, m"
    bars = [
        np.asarray(change_map(of, CAPTION, 0.5, WIDTH, "May"))[-100:, : WIDTH // 2]
        for of in (overview, on_plane)
    ]
    assert (bars[0] != bars[1]).any()
