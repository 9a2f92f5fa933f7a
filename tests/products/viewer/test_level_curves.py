"""Level and rate of blocks for the page: means of the stored cells, and what happens if a file is damaged."""

import numpy as np
import pytest

from station.archive.derived import level_files
from station.products import page
from station.products.viewer.level_curves import LevelCodes

SIZE = 2  # cells along each side of a block
NAMES = ("level", "rate")


def store(series, day, rasters, *, version="1"):
    """Store the levels of a day of November; return the file."""
    start_s = 1_761_955_200.0 + 86_400 * (day - 1)
    period = level_files.LevelPeriod(
        f"202511{day:02d}", f"{day:016d}", version, start_s, start_s + 86_400, start_s + 80_000, 24
    )
    return level_files.write_levels(
        series, period, lambda rows: level_files.encoded({k: v[rows] for k, v in rasters.items()})
    )


def rasters_of(shape, value):
    ones = np.ones(shape)
    rasters = {"level": ones * value, "rate": ones * value / 10, "coverage": ones}
    for name in NAMES:
        rasters[f"{name}_random_uncertainty"] = ones * 0.01
        rasters[f"{name}_systematic_uncertainty"] = ones * 0.02
    return rasters


def sigma_m(code):
    return 1e-5 * np.exp((code.astype(float) - 1) * 0.02)


def test_a_block_has_the_mean_of_its_cells_and_its_sigma(series, tmp_path):
    shape = series.grid.shape
    rasters = rasters_of(shape, 0.0)
    row, column = np.indices(shape)
    rasters["level"], rasters["rate"] = 0.01 * row + 0.1 * column, -0.001 * row
    rasters["rate_random_uncertainty"] = np.full(shape, 0.004)
    for name in [name for name in rasters if name != "coverage"]:
        rasters[name][0, 1] = rasters[name][0, 2:4] = rasters[name][1, 2:4] = np.nan
    store(series, 3, rasters)
    known = np.ones((-(-shape[0] // SIZE), -(-shape[1] // SIZE)), bool)
    codes = LevelCodes(series, tmp_path / "codes", "1", known, SIZE)
    (name,) = codes.keep(lambda: None)
    time_s, day = codes.read(name)
    assert time_s == 1_761_955_200.0 + 2 * 86_400 + 80_000
    # the first block: three of four cells
    assert day["coverage"][:2].tolist() == [3, 0]
    assert day["change"][0] * 0.001 == pytest.approx((0.0 + 0.01 + 0.11) / 3, abs=0.00051)
    assert day["rate"][0] * 0.0001 == pytest.approx(-0.002 / 3, abs=0.000051)
    # as if all four were known: independent errors average out, common ones do not
    assert sigma_m(day["random"][0]) == pytest.approx(0.01 / 2, rel=0.011)
    assert sigma_m(day["rate_random"][0]) == pytest.approx(0.004 / 2, rel=0.011)
    assert sigma_m(day["systematic"][0]) == pytest.approx(0.02, rel=0.011)
    # a block far from it: rows 4 and 5, columns 10 and 11
    block = 2 * known.shape[1] + 5
    assert day["change"][block] * 0.001 == pytest.approx(0.045 + 1.05, abs=0.00051)


def test_days_of_the_newest_reference_are_kept_some_at_a_time(series, tmp_path):
    rasters = rasters_of(series.grid.shape, 0.1)
    for day in range(1, 8):
        store(series, day, rasters, version="0" if day == 1 else "1")
    codes = LevelCodes(series, tmp_path, "1", np.ones((1, 1), bool), 60)
    assert [name[-11:-9] for name in codes.keep(lambda: None)] == ["04", "05", "06", "07"]
    names = codes.keep(lambda: None)
    assert [name[-11:-9] for name in names] == ["02", "03", "04", "05", "06", "07"]
    (tmp_path / f"{names[2]}.npz").write_bytes(b"damaged")
    assert codes.read(names[2]) is None
    assert codes.keep(lambda: None) == names
    assert codes.read(names[2]) is not None


@pytest.mark.integration
def test_a_damaged_level_is_named_on_the_page_until_it_is_there_again(series, tmp_path):
    rasters = rasters_of(series.grid.shape, 0.1)
    path = store(series, 20, rasters)
    store(series, 21, rasters)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    context = page.PageContext("x", "", 1.0, 3600.0, [], [], ["the disk is nearly full"], {})
    for is_whole in (False, True):
        if is_whole:
            path.write_bytes(whole)
        page.write_page(series, tmp_path, context, 600, None, lambda: None)
        text = (tmp_path / "index.html").read_text()
        assert "the disk is nearly full" in text
        assert (path.name in text) != is_whole
        assert ("station check --store" in text) != is_whole
        assert len(list((tmp_path / "values").glob("level_*"))) == 1 + is_whole
        assert (tmp_path / "levels" / "0_0.js").is_file()
