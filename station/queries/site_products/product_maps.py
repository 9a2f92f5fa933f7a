"""Maps of products: snow depth, melt or mass balance of each cell in one epoch, computed when asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from station.archive.derived.product_files import QUANTITIES
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import attributes
from station.archive.schema import RASTER, Variable
from station.errors import StationError
from station.quantities import Bools, Floats32
from station.queries.site_products.product_queries import Product, ProductQueries, parts_of
from station.queries.site_products.quantities_of_places import CountedFrom, mapped_quantity, observe_change
from station.science.analysis.product_estimates import Estimate
from station.sections.product import UPWARD_KINDS

if TYPE_CHECKING:
    import xarray as xr

BLOCK_CELLS = 400_000  # at once


def map_variables(product: Product) -> tuple[Variable, ...]:
    """Return the variables of a map: the quantity and one sigma of a cell with its two parts.

    Raises StationError if the product is not one of cells.
    """
    section = product.section
    if section.kind not in UPWARD_KINDS:
        raise StationError(
            f"product {section.name} has no map: it is of kind {section.kind}, not {', '.join(UPWARD_KINDS)}"
        )
    specs = [spec for spec in QUANTITIES[section.kind] if spec.name.startswith(section.kind)]
    return tuple(
        replace(
            spec, dims=RASTER, dtype="f4", ancillary=tuple(of.name for of in specs[1:]) * (spec is specs[0])
        )
        for spec in specs
    )


def product_map(queries: ProductQueries, product: Product, epoch: EpochRef) -> dict[str, Floats32]:
    """Return the rasters (ny, nx) of `map_variables` in an epoch, NaN where it was not observed.

    Of the whole grid, areas or not. The variances are those of a place of one cell. Raises StationError if
    the surface of the product has not been measured yet.
    """
    names = [spec.name for spec in map_variables(product)]
    rasters = {name: np.full(queries.grid.shape, np.nan, np.float32) for name in names}
    rows = max(1, BLOCK_CELLS // queries.grid.nx)
    for top in range(0, queries.grid.ny, rows):
        cells = np.zeros(queries.grid.shape, np.bool_)
        cells[top : top + rows] = True
        observed, estimate = _cell_quantity(queries, product, cells, epoch)
        for name, values in parts_of(names[0], estimate).items():
            rasters[name][observed] = values
    return rasters


def _cell_quantity(
    queries: ProductQueries, product: Product, cells: Bools, epoch: EpochRef
) -> tuple[Bools, Estimate]:
    """Return the observed ones (ny, nx) of some cells, and the quantity in each of them (n,)."""
    base = CountedFrom(queries.surface_scans(product, cells), product.rasters.get("surface"))
    area, share = observe_change(queries, cells, epoch, base)
    if area is None:
        return np.zeros_like(cells), Estimate(*np.empty((3, 0)))
    random_m2, systematic_m2 = queries.cell_variances(area)
    change = Estimate(share * area.value_m, share**2 * random_m2, share**2 * systematic_m2)
    return area.cells, mapped_quantity(product.section, change)


def map_dataset(queries: ProductQueries, product: Product, epoch: EpochRef) -> xr.Dataset:
    """Return the map of a product in an epoch."""
    import xarray as xr  # noqa: PLC0415 - half a second that the service does not need

    grid, rasters = queries.grid, product_map(queries, product, epoch)
    time = np.datetime64(round(epoch.time_s * 1000), "ms").astype("M8[ns]")
    dataset = xr.Dataset(coords={"time": time, "y": grid.y_m, "x": grid.x_m})
    for spec in map_variables(product):
        attrs = attributes(spec, queries.series)
        attrs.pop("grid_mapping", None)
        dataset[spec.name] = ("y", "x"), rasters[spec.name], attrs
    return dataset
