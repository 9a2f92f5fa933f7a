"""Reference surfaces from GeoTIFF."""

import sys
import warnings

import numpy as np
import pytest

from station.errors import ConfigError
from station.quantities import Grid
from station.readers.raster import read_geotiff

GRID = Grid(west_m=630_000.0, north_m=5_184_000.0, cell_m=2.0, nx=40, ny=30)
CRS = "EPSG:32632"
rasterio = pytest.importorskip("rasterio")


def write_tif(tmp_path, elevation, west=GRID.west_m, north=GRID.north_m, cell=2.0, **options):
    path = tmp_path / "reference.tif"
    profile = {
        "driver": "GTiff",
        "height": elevation.shape[-2],
        "width": elevation.shape[-1],
        "count": 1 if elevation.ndim == 2 else elevation.shape[0],
        "dtype": elevation.dtype,
        "crs": CRS,
        "transform": rasterio.Affine(cell, 0.0, west, 0.0, -cell, north),
        **options,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the missing georeference
        tif = rasterio.open(path, "w", **profile)
    with tif:
        tif.write(elevation if elevation.ndim == 3 else elevation[None])
    return path


def hills(shape):
    return np.random.default_rng(1).uniform(2400, 3700, shape).astype(np.float32)


@pytest.mark.parametrize("compress", ["deflate", "lzw", None])
def test_raster_on_the_grid(tmp_path, compress):
    expected = hills(GRID.shape)
    read = read_geotiff(
        write_tif(tmp_path, expected, compress=compress, predictor=3 if compress else 1), GRID, CRS
    )
    assert read.dtype == np.float64
    assert np.array_equal(read, expected)


def test_larger_raster_is_cropped_and_smaller_one_padded(tmp_path):
    expected = hills((50, 60))
    larger = read_geotiff(write_tif(tmp_path, expected, GRID.west_m - 10, GRID.north_m + 6), GRID, CRS)
    assert np.array_equal(larger, expected[3:33, 5:45])
    expected = hills((10, 12))
    smaller = read_geotiff(write_tif(tmp_path, expected, GRID.west_m + 20, GRID.north_m - 4), GRID, CRS)
    assert np.array_equal(smaller[2:12, 10:22], expected)
    assert np.isfinite(smaller).sum() == 120


def test_raster_that_overlaps_a_corner(tmp_path):
    expected = hills((20, 20))
    read = read_geotiff(write_tif(tmp_path, expected, GRID.west_m - 20, GRID.north_m + 20), GRID, CRS)
    assert np.array_equal(read[:10, :10], expected[10:, 10:])
    assert np.isfinite(read).sum() == 100


def test_nodata_becomes_nan(tmp_path):
    expected = hills(GRID.shape)
    expected[3, 4], expected[5, 6] = -9999, np.nan
    read = read_geotiff(write_tif(tmp_path, expected, nodata=-9999), GRID, CRS)
    assert np.argwhere(np.isnan(read)).tolist() == [[3, 4], [5, 6]]


def test_integer_elevations(tmp_path):
    expected = np.full(GRID.shape, 2500, dtype=np.int16)
    expected[0, 0] = -32768
    read = read_geotiff(write_tif(tmp_path, expected, nodata=-32768), GRID, CRS)
    assert np.isnan(read[0, 0])
    assert read[1, 1] == 2500


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"west": GRID.west_m + 0.5}, "0.250 of a cell off"),
        ({"north": GRID.north_m - 1}, "0.500 of a cell off"),
        ({"cell": 1.0}, r"cells of 1 × 1 m, grid.cell_m is 2"),
        ({"west": GRID.west_m + 5000}, "does not overlap"),
        ({"crs": "EPSG:32633"}, "is in WGS 84 / UTM zone 33N, map.crs is WGS 84 / UTM zone 32N"),
        ({"crs": None}, "declares no CRS"),
        ({"transform": None}, "not georeferenced"),
    ],
)
def test_mismatch_with_the_grid_is_rejected(tmp_path, options, reason):
    with pytest.raises(ConfigError, match=reason):
        read_geotiff(write_tif(tmp_path, hills(GRID.shape), **options), GRID, CRS)


def test_rotated_raster_is_rejected(tmp_path):
    transform = rasterio.Affine(2.0, 0.1, GRID.west_m, 0.1, -2.0, GRID.north_m)
    with pytest.raises(ConfigError, match="not north-up"):
        read_geotiff(write_tif(tmp_path, hills(GRID.shape), transform=transform), GRID, CRS)


def test_undeclared_nodata_is_rejected(tmp_path):
    expected = hills(GRID.shape)
    expected[3, 4] = -9999
    with pytest.raises(ConfigError, match="nodata value is not declared"):
        read_geotiff(write_tif(tmp_path, expected), GRID, CRS)


def test_several_bands_are_rejected(tmp_path):
    with pytest.raises(ConfigError, match="has 3 bands"):
        read_geotiff(write_tif(tmp_path, hills((3, *GRID.shape))), GRID, CRS)


def test_compound_crs_is_on_the_same_map(tmp_path):
    expected = hills(GRID.shape)
    assert np.array_equal(read_geotiff(write_tif(tmp_path, expected), GRID, "EPSG:32632+5773"), expected)


def test_invalid_file_is_rejected(tmp_path):
    (tmp_path / "reference.tif").write_text("no")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_geotiff(tmp_path / "reference.tif", GRID, CRS)


def test_geographic_raster_is_rejected_for_a_map_grid(shared_data):
    with pytest.raises(ConfigError, match="WGS 84"):
        read_geotiff(shared_data / "hef_terrain/hef_srtm.tif", GRID, CRS)


def test_missing_rasterio_is_explained(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(ConfigError, match=r"pip install 'tls-station\[geotiff\]'"):
        read_geotiff(tmp_path / "reference.tif", GRID, CRS)
