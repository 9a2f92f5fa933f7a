"""Maps of products, against plain raster arithmetic, places of one cell and dense matrix algebra."""

import numpy as np
import pytest
import rasterio
import xarray as xr
from support.plane_store import GRID, dense_variance, independent_m2, random_parameters, reference_random_m2
from support.surface_store import BASE, LAST, SPAN

import station
from station.archive.derived.product_files import SIGMAS
from station.errors import StationError
from station.products.area_tables import Span
from station.products.exports.product_maps import export_maps
from station.queries.site_products.product_maps import map_dataset
from station.queries.site_products.product_queries import Product, ProductQueries, update_products
from station.sections.product import ProductSection

SNOW = {"kind": "snow_depth", "surface": SPAN, "offset_m": 0.03, "offset_sigma_m": 0.02}
MELT = {"kind": "melt", "density_kg_m3": 850.0, "density_sigma_kg_m3": 40.0}
BALANCE = {"kind": "surface_mass_balance", "density_kg_m3": 850.0, "surface": SPAN}
EVERYWHERE = np.ones(GRID.shape, bool)


def product_of(places=None, rasters=None, **settings):
    section = ProductSection.model_validate({"name": "The Map", **settings})
    return Product(section, places or {"all": EVERYWHERE}, rasters=rasters or {})


def mapped(series, product, index):
    queries = ProductQueries(series)
    return map_dataset(queries, product, queries.find_epoch(index))


def mean_change_m(stored):
    change_m = stored.elevation_change.values[list(BASE)].astype(float)
    with np.errstate(invalid="ignore"):
        return np.nansum(change_m, axis=0) / np.isfinite(change_m).sum(axis=0)


def test_a_map_is_the_arithmetic_of_the_stored_rasters(series, stored):
    known = np.isfinite(reference_random_m2(series))
    change_m = np.where(known, stored.elevation_change.values[LAST].astype(float), np.nan)
    depth = mapped(series, product_of(**SNOW), LAST).snow_depth
    np.testing.assert_allclose(depth, change_m - mean_change_m(stored) + 0.03, atol=1e-6)
    np.testing.assert_allclose(mapped(series, product_of(**MELT), LAST).melt, -0.85 * change_m, atol=1e-6)
    balance = mapped(series, product_of(**BALANCE), LAST).surface_mass_balance
    np.testing.assert_allclose(balance, 0.85 * (change_m - mean_change_m(stored)), atol=1e-6)
    surface_m = np.where(np.arange(GRID.nx) < 20, 2800.0, np.nan) * np.ones((GRID.ny, 1))
    above = product_of(rasters={"surface": surface_m}, kind="snow_depth", surface="bare.tif")
    depth = mapped(series, above, LAST).snow_depth
    np.testing.assert_allclose(
        depth, np.where(known, stored.elevation.values[LAST], np.nan) - surface_m, atol=1e-3
    )


@pytest.mark.parametrize("settings", [SNOW, MELT, BALANCE])
@pytest.mark.parametrize("index", [LAST, 1])
def test_a_cell_of_a_map_is_a_place_of_one_cell(series, settings, index):
    maps = mapped(series, product_of(**settings), index)
    known = np.argwhere(np.isfinite(maps[settings["kind"]].values))
    places = {}
    for number, cell in enumerate(known[:: len(known) // 12]):
        places[f"{number}"] = np.zeros(GRID.shape, bool)
        places[f"{number}"][tuple(cell)] = True
    update_products(series, [product_of(places, **settings)], ["the_map"], lambda: None)
    values = station.product(series.folder, "The Map").isel(time=index)
    for name in (settings["kind"], *(f"{settings['kind']}_{part}" for part in SIGMAS)):
        of_map = [maps[name].values[cells].item() for cells in places.values()]
        np.testing.assert_allclose(of_map, values[name].values, rtol=2e-5, atol=1e-6)


def test_the_sigma_of_a_cell_is_that_of_dense_algebra(series, stored):
    """Above a raster: with the systematic error of the reference, without its noise."""
    rasters = {"surface": np.full(GRID.shape, 2800.0)}
    above = product_of(rasters=rasters, kind="snow_depth", surface="bare.tif")
    depth = mapped(series, above, LAST)
    random_m2 = independent_m2(stored, LAST, reference_random_m2(series))
    for cell in np.argwhere(np.isfinite(depth.snow_depth.values))[::100]:
        weights = np.zeros(GRID.shape)
        weights[tuple(cell)] = 1.0
        errors = random_parameters(7, 0.5)
        total_m2 = dense_variance(stored, weights, LAST, random_m2=random_m2, reference=errors)
        assert depth.snow_depth_uncertainty.values[tuple(cell)] ** 2 == pytest.approx(total_m2, rel=1e-3)
        random_m = depth.snow_depth_random_uncertainty.values[tuple(cell)]
        assert random_m**2 == pytest.approx(random_m2[tuple(cell)], rel=1e-3)


def test_maps_are_exported_for_other_programs(series, tmp_path):
    product, expected = product_of(**SNOW), mapped(series, product_of(**SNOW), LAST)
    value, *_ = paths = export_maps(series, product, None, tmp_path, "geotiff")
    assert [path.name.split("_the_map")[1] for path in paths] == [
        ".tif",
        *(f"_{part}.tif" for part in SIGMAS),
    ]
    with rasterio.open(value) as raster:
        np.testing.assert_array_equal(raster.read(1), expected.snow_depth)
        assert (raster.crs.to_epsg(), raster.units, raster.descriptions) == (
            32632,
            ("m",),
            ("depth of the snow",),
        )
        assert raster.tags()["product"] == "The Map"
    (path,) = export_maps(series, product, Span.parse("2025-11-21T03:00", None), tmp_path, "netcdf")
    with xr.open_dataset(path) as file:
        assert file.sizes["time"] == 3
        np.testing.assert_array_equal(file.snow_depth[-1], expected.snow_depth)
        np.testing.assert_array_equal(file.snow_depth_uncertainty[-1], expected.snow_depth_uncertainty)
        attrs = file.snow_depth.attrs
        assert (attrs["standard_name"], attrs["units"]) == ("surface_snow_thickness", "m")
        assert attrs["cell_methods"] == "area: mean"
        assert set(attrs["ancillary_variables"].split()) < set(file)
        assert "32632" in file.crs.attrs["crs_wkt"]


def test_a_map_that_cannot_be_computed_says_why(series, tmp_path):
    budget = product_of(kind="volume_budget")
    with pytest.raises(StationError, match="no map: it is of kind volume_budget"):
        export_maps(series, budget, None, tmp_path, "netcdf")
    future = {"from": "2026-07-01T00:00:00Z", "to": "2026-08-01T00:00:00Z"}
    with pytest.raises(StationError, match="time of its surface is not over"):
        mapped(series, product_of(kind="snow_depth", surface=future), LAST)
    with pytest.raises(StationError, match="no epoch with a change in this span"):
        export_maps(series, product_of(**MELT), Span.parse("2027-01-01", None), tmp_path, "geotiff")
