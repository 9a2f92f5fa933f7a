"""4D objects-by-change: the recipe of the documentation, as py4dgeo runs it on an exported file."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.epochs import make_epoch
from support.programs import readers_python, run

from station.archive import epochs
from station.archive.series.virtual import build_series
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import select, split

pytestmark = pytest.mark.integration
RECIPE = Path(__file__).parents[3] / "docs/how-to/deposit.md"
EPOCHS, BEGIN = 18, 8
DEPOSIT = slice(40, 52), slice(30, 42)  # 144 cells of 10 m


def recipe(path, grid):
    """Return the recipe for a file and the cells around the deposit."""
    (code,) = re.findall(
        r"```python \{\.no-run\}\n(from datetime import timedelta.*?)```", RECIPE.read_text(), re.DOTALL
    )
    west, east, north, south = grid.x_m[20], grid.x_m[60], grid.y_m[30], grid.y_m[70]
    box = f"ds.sel(x=slice({west}, {east}), y=slice({north}, {south}))"
    code = re.sub(r"ds\.sel\(x=slice\(.*?\), y=slice\(.*?\)\)", box, code)
    return code.replace("deposit/simulated.nc", str(path)).replace(
        "objects.zip", str(path.with_suffix(".zip"))
    )


def test_py4dgeo_finds_a_deposit_in_an_exported_file(series, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where py4dgeo writes its log
    rng = np.random.default_rng(1)
    for hour in range(EPOCHS):
        change_m = rng.normal(0, 0.02, series.grid.shape)
        change_m[DEPOSIT] += 1.0 if hour >= BEGIN else 0.0
        epochs.write_epoch(series, make_epoch(hour, value=change_m))
    build_series(series)
    selection, netcdf = select(series, Span.parse(None, None)), FORMATS["netcdf"]
    (path,) = netcdf.write(
        selection, split(selection, tmp_path / "all.nc", netcdf.suffix, None), lambda _: None, lambda _: None
    )
    printed = run(readers_python(), "-c", recipe(path, series.grid)).stdout
    (found,) = re.findall(r"(\d+) cells, epochs (\d+) to (\d+)", printed)
    assert [int(number) for number in found] == [144, BEGIN, EPOCHS - 1]
