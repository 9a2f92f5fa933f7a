"""What is in a picture: the right colour at the right place, means of what does not fit, small enough."""

import io
from dataclasses import replace

import netCDF4
import numpy as np
import pytest
from PIL import Image

from station.archive import store
from station.archive.aggregate import Aggregates
from station.archive.layout import Series
from station.archive.rasters import Raster
from station.archive.reference import write_reference
from station.archive.series import build_series
from station.products import maps
from station.products.colours import change_scale, points_scale, round_up, sigma_scale
from station.products.look import Looking, base_of, look_at, look_between
from station.products.maps import MOST_BYTES, PAPER, Caption, change_map, encoded, points_map, sigma_map
from station.quantities import ChangeErrors, Grid, Shared
from station.science.shared import basis

CAPTION = Caption("Hintereisferner", "2025-11-21 05:00 UTC", "degraded: no weather")
WIDTH = 1248  # 20 pixels a cell
SCANNER = (632_300.0, 5_184_500.0, 3200.0)


@pytest.fixture
def last(series):
    return store.rows(series)[-1]


def cell_colour(picture, row, column):
    """Colour in the middle of a cell of the map."""
    across = (WIDTH - 2 * round(24 * WIDTH / 1200)) / 58
    x = round(24 * WIDTH / 1200) + (column + 0.5) * across
    y = round(92 * WIDTH / 1200) + (row + 0.5) * across
    return np.array(picture.getpixel((int(x), int(y))), dtype=int)


def test_each_cell_has_the_colour_of_its_change(series, last, small):
    look = look_at(last, base_of(series, "1", WIDTH))
    assert look.base.factor == 1
    assert look.base.shade.shape == (45, 58)  # the border that nobody knows is cut off
    picture = change_map(look, CAPTION, 0.5, WIDTH, "the reference")
    red, _, blue = cell_colour(picture, *(part.start + 3 for part in small.RISE))
    assert blue > red + 60
    red, _, blue = cell_colour(picture, *(part.start + 3 for part in small.FALL))
    assert red > blue + 60
    still = np.argwhere(look.seen & ~look.is_significant)
    unseen = np.argwhere(~look.seen)
    for cells, darkest, palest in ((still, 100, 215), (unseen, 200, 255)):
        for row, column in cells[:: len(cells) // 15]:
            if row > 38 and column < 25:
                continue  # the scale's plate lies there
            colour = cell_colour(picture, row, column)
            assert np.ptp(colour) <= 3  # grey: what is not significant has no colour
            assert darkest < colour[0] <= palest
    assert picture.getpixel((1, 1)) == PAPER


def test_significant_is_what_the_store_flags(series, last):
    look = look_at(last, base_of(series, "1", WIDTH))
    with netCDF4.Dataset(last.path) as file:
        flagged = (np.asarray(file["quality"][0])[:, :58] & 16) > 0
    assert flagged.sum() > 300
    assert (look.is_significant != flagged).sum() <= 3  # on the edge, by the digits that a file keeps


@pytest.mark.parametrize("pixels", [29, 19, 11])
def test_what_does_not_fit_is_a_mean_with_its_sigma(series, last, small, pixels):
    """Against plain loops over what the file holds: random parts average out, the shared one does not."""
    look = look_at(last, base_of(series, "1", pixels), points=True)
    factor, base = 58 // pixels, look.base
    assert base.factor == factor
    assert base.rows.stop - base.rows.start == factor * base.grid.ny
    with netCDF4.Dataset(last.path) as file:
        change, sigma, random = (
            np.ma.filled(file[f"elevation_change{end}"][0].astype(float), np.nan)[base.rows, base.columns]
            for end in ("", "_uncertainty", "_random_uncertainty")
        )
        points = np.asarray(file["point_count"][0])[base.rows, base.columns]
    for row, column in np.ndindex(base.grid.shape):
        block = np.s_[row * factor : (row + 1) * factor, column * factor : (column + 1) * factor]
        seen = np.isfinite(change[block])
        if not seen.any():
            assert np.isnan(look.change_m[row, column])
            continue
        n = seen.sum()
        assert look.change_m[row, column] == pytest.approx(change[block][seen].mean(), abs=1e-5)
        own = np.sum(random[block][seen] ** 2) / n**2
        common = np.mean(sigma[block][seen] ** 2 - random[block][seen] ** 2)
        assert look.sigma_m[row, column] == pytest.approx(np.sqrt(own + common), rel=1e-3)
        assert look.points[row, column] == pytest.approx(points[block].mean())
    assert base.grid.x_m[0] == small.GRID.x_m[base.columns][:factor].mean()
    assert base.grid.y_m[-1] == pytest.approx(small.GRID.y_m[base.rows][-factor:].mean())


@pytest.mark.parametrize("pixels", [WIDTH, 29, 11])
def test_an_epoch_that_is_written_looks_as_it_will_in_the_store(series, small, pixels):
    epoch = small.make_epoch(11)
    number = epoch.measurement.number[21, 33]
    epoch.measurement.change_m[number] = np.nan  # points, but no change
    base = base_of(series, "1", pixels)
    looking = Looking(base, points=True)
    written = store.write_epoch(series, epoch, seen=looking.add)
    told, read = looking.look(), look_at(store.rows_in(written.path)[0], base, points=True)
    by_few = Looking(base, points=True)
    for top in range(0, small.GRID.ny, 7):  # which cuts pixels
        rows = slice(top, min(top + 7, small.GRID.ny))
        by_few.add(rows, {name: Raster(written.path, name, index=0)[rows] for name in by_few.names})
    assert np.isfinite(told.points).sum() > 100 * (base.factor == 1)
    for name in ("change_m", "sigma_m", "points"):
        other = getattr(read, name)
        for one in (getattr(told, name), getattr(by_few.look(), name)):
            assert np.array_equal(np.isnan(one), np.isnan(other)), name
            assert np.nanmax(np.abs(one - other)) <= 1e-6, name


def with_shared(epoch, alike):
    """An epoch whose points share a lean and errors of a change; `alike` to all others made so, or not."""
    of, rng = basis(epoch.measurement.grid, SCANNER), np.random.default_rng(5)
    size = len(of.names)
    modes = np.zeros((size, 32))
    modes[:2] = rng.normal(0, 4e-5, (2, 32)) / np.sqrt(32)
    pattern = np.random.default_rng(0 if alike else int(epoch.start_s)).normal(size=288)
    covariance = modes @ modes.T
    covariance[range(2), range(2)] += 2e-10
    shared = Shared(
        of.names, of.units, np.zeros(size), covariance, np.zeros(size), ChangeErrors(modes, pattern)
    )
    place = dict(zip(("scanner_east", "scanner_north", "scanner_height"), SCANNER, strict=True))
    numbers = epoch.numbers | place | {"scanner_axis_east": 0.0, "scanner_axis_north": 0.0}
    return replace(epoch, shared=shared, numbers=numbers)


@pytest.mark.parametrize("pixels", [WIDTH, 29])
@pytest.mark.parametrize(("alike", "low", "high"), [(True, 0.05, 0.6), (False, 0.8, 1.0)])
def test_sigma_between_two_epochs_is_that_of_the_store(series, small, alike, low, high, pixels):
    """What `station.variance` says of the mean of a pixel's cells: what both have wrong is not in it."""
    for hour in (7, 9):
        store.write_epoch(series, with_shared(small.make_epoch(hour), alike))
    build_series(series)
    other, row = store.rows(series)[-2:]
    look = look_between(row, other, base_of(series, "1", pixels), series)
    found, factor, base = Aggregates(series), look.base.factor, look.base
    with netCDF4.Dataset(row.path) as one, netCDF4.Dataset(other.path) as two:
        both = [np.ma.filled(file["elevation_change"][0].astype(float), np.nan) for file in (one, two)]
    seen = np.isfinite(both[0] - both[1])
    shares = []
    for at in np.argwhere(look.seen)[:: 200 // factor**2]:
        weights = np.zeros(small.GRID.shape)
        first = at * factor + (base.rows.start, base.columns.start)
        weights[first[0] : first[0] + factor, first[1] : first[1] + factor] = 1
        if not seen[weights > 0].all():
            continue
        weights /= weights.sum()
        wanted = found.variance(weights, row, other)
        assert look.sigma_m[tuple(at)] ** 2 == pytest.approx(wanted, rel=1e-3 if factor == 1 else 0.05)
        apart = sum(found.variance(weights, one) for one in (row, other))
        shares.append(wanted / apart)
    assert len(shares) > 5
    assert low < np.median(shares) < high
    if factor == 1:
        assert np.nanmean(look.change_m[small.RISE]) == pytest.approx(0.10, abs=0.01)


def test_sigma_and_points_have_their_maps(series, last, small):
    look = look_at(last, base_of(series, "1", WIDTH), points=True)
    for picture in (sigma_map(look, CAPTION, 0.5, WIDTH), points_map(look, CAPTION, WIDTH)):
        assert picture.width == WIDTH
        assert np.ptp(cell_colour(picture, *(part.start + 2 for part in small.UNSEEN))) <= 3
        assert np.ptp(cell_colour(picture, 10, 10)) > 20


def test_what_is_sent_keeps_grey_grey_and_colours_near(series, last):
    """In few colours: nothing grey takes a tint that could be read as a change."""
    look = look_at(last, base_of(series, "1", WIDTH))
    picture = change_map(look, CAPTION, 0.5, WIDTH, "the reference")
    with Image.open(io.BytesIO(encoded(picture))) as sent:
        told, wanted = (np.asarray(one.convert("RGB"), dtype=int) for one in (sent, picture))
    grey = np.ptp(wanted, axis=-1) == 0
    assert grey.sum() > 10_000
    assert np.ptp(told[grey], axis=-1).max() <= 3
    assert np.abs(told - wanted).mean() < 4
    assert np.percentile(np.abs(told - wanted), 99) < 25


def test_some_bands_tell_how_good_a_picture_may_be(monkeypatch):
    """What comes out is what one quality after the other, on the whole, would have given."""
    grey = np.random.default_rng(3).normal(150, 12, (700, 500)).clip(90, 250)
    grey[:, 200:] = np.linspace(100, 240, 300)
    picture = Image.fromarray(np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8))
    limits = 70_000, 38_000, 24_000, 17_000, 7_000, 500
    found = [encoded(picture, most_bytes) for most_bytes in limits]
    monkeypatch.setattr(maps, "SAMPLE_ONE_IN", 1)
    assert found == [encoded(picture, most_bytes) for most_bytes in limits]
    assert len({len(one) for one in found}) == len(limits)


def test_scales_are_fixed_and_even():
    scale = change_scale(0.5, "the reference")
    colours = scale.paint(np.array([-9.0, -0.5, 0.0, 0.5, 9.0], np.float32)).astype(int)
    assert (colours[0] == colours[1]).all()
    assert (colours[3] == colours[4]).all()
    assert colours[1][0] > colours[1][2]  # red sinks
    assert colours[3][2] > colours[3][0]  # blue rises
    assert colours[2].min() > 200  # next to nothing is nearly white
    for one in (sigma_scale(0.5), points_scale()):
        dark = one.table().astype(int).sum(axis=1)
        assert (np.diff(dark) <= 3).all()  # the more the darker
        assert one.paint(np.array([one.low / 9, 9 * one.high])).tolist() == [
            one.table()[0].tolist(),
            one.table()[-1].tolist(),
        ]
    assert [round_up(value) for value in (0.11, 0.2, 0.21, 3.0, 0.049, 9.0)] == [0.2, 0.2, 0.5, 5, 0.05, 10]


def test_a_dense_noisy_map_is_small_enough(tmp_path, small):
    """One pixel a cell, nothing but noise: the worst there is."""
    grid = Grid(632_000.0, 5_186_000.0, 1.0, 1150, 900)
    series = Series(tmp_path, "hef", grid, "EPSG:32632")
    write_reference(series, small.make_reference(grid))
    store.write_epoch(series, small.make_epoch(5, grid=grid))
    look = look_at(store.rows(series)[0], base_of(series, "1", 1152))
    picture = change_map(look, CAPTION, 0.03, 1200, "the reference")
    found = encoded(picture)
    assert 20_000 < len(found) <= MOST_BYTES
    with Image.open(io.BytesIO(found)) as again:
        assert again.width >= picture.width / 2
        wide = again.convert("L").resize(picture.size)
        off = np.abs(np.asarray(wide, float) - np.asarray(picture.convert("L"), float)).mean()
    assert off < 25
