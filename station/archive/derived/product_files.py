"""`products/`: the quantities of `[[product]]` over time, a file for each, computed from the epochs.

A file for each product, because CF has one kind of geometry in a file, and a product that is changed in the
site file is computed again while the others stay.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.chunk_codec import read_column
from station.archive.derived.boxes import Entries
from station.archive.derived.fingerprints import fingerprints_path, is_intact, write_fingerprints
from station.archive.discovery import time_coverage
from station.archive.netcdf_layout import (
    Series,
    axis_attributes,
    create_crs,
    create_time_axis,
    create_variable,
    decode_text,
    encode_text,
    write_global_attrs,
)
from station.archive.read_errors import read_errors
from station.archive.schema import BY_NAME, FILL, TEXT, TEXT_LENGTH, VERDICTS, Variable
from station.errors import StationError, StoreError
from station.quantities import Bools, Floats, Ints
from station.sections.product import product_key

if TYPE_CHECKING:
    import xarray as xr

FOLDER = "products"  # in the data folder
RECIPE = "product_sha256"
PLACE, DISTANCE = "place", "distance"
MISSING = -1
SIGMAS = {  # parts of the uncertainty of a quantity, and what they are
    "uncertainty": "everything included",
    "random_uncertainty": "the part that is independent between scans and cells",
    "systematic_uncertainty": "the part that cells of a scan share, or all scans, which does not average out",
}
_KEYS = (
    Variable("sources", TEXT, "S1", "name of the epoch file, or SHA-256 of the names of several"),
    BY_NAME["reference_version"],
)
_VERDICT = BY_NAME["verdict"]


def _quantity(
    name: str, long_name: str, units: str, standard_name: str | None = None, comment: str | None = None,
    dims: tuple[str, ...] = ("time", PLACE), cell_methods: str | None = "area: mean",
) -> tuple[Variable, ...]:  # fmt: skip
    """Return the variables of a quantity: its value, and one sigma with its two parts."""
    dtype = "f4" if DISTANCE in dims else "f8"  # a profile is large
    parts = tuple(f"{name}_{part}" for part in SIGMAS)
    value = Variable(
        name, dims, dtype, long_name, units, standard_name, None, cell_methods, comment,
        ancillary=(*parts, "verdict"),
    )  # fmt: skip
    return value, *(
        Variable(
            part,
            dims,
            dtype,
            f"{part.removeprefix(f'{name}_').replace('_', ' ')} of the {long_name}",
            units,
            comment=f"one standard deviation, {meaning}",
        )
        for part, meaning in zip(parts, SIGMAS.values(), strict=True)
    )


_COVERAGE = Variable("coverage", ("time", PLACE), "f8", "share of the cells that have a value", "1")
_SETTLED = "the snow that fell, less its settling and what melted or was blown away"
_WATER = "water equivalent: 1 m is 1000 kg m-2"
_MAP = "above the surface of the map: the errors of the reference surface included"
_ALONG = ("time", DISTANCE)
QUANTITIES: dict[str, tuple[Variable, ...]] = {
    "point": (
        *_quantity("elevation", "elevation of the surface", "m", "surface_altitude", _MAP),
        *_quantity("elevation_change", "elevation above the reference surface", "m"),
        _COVERAGE,
    ),
    "snow_depth": (
        *_quantity("snow_depth", "depth of the snow", "m", "surface_snow_thickness"),
        *_quantity("new_snow_24h", "change of the depth of the snow in 24 h", "m", None, _SETTLED),
        *_quantity("new_snow_72h", "change of the depth of the snow in 72 h", "m", None, _SETTLED),
        _COVERAGE,
    ),
    "surface_mass_balance": (
        *_quantity("surface_mass_balance", "change of mass per area", "m", None, _WATER),
        _COVERAGE,
    ),
    "melt": (*_quantity("melt", "loss of mass per area", "m", None, _WATER), _COVERAGE),
    "volume_budget": (
        *_quantity("net_change", "volume gained less volume lost", "m3", cell_methods="area: sum"),
        *_quantity("deposition", "volume gained", "m3", cell_methods="area: sum"),
        *_quantity("erosion", "volume lost, negative", "m3", cell_methods="area: sum"),
        _COVERAGE,
    ),
    "volume_between": (
        *_quantity("volume", "volume of the ground between two levels", "m3", None, _MAP,
                   cell_methods="area: sum"),
        _COVERAGE,
    ),
    "profile": (
        *_quantity("elevation", "elevation of the surface", "m", "surface_altitude", _MAP, _ALONG),
        *_quantity("elevation_change", "elevation above the reference surface", "m", dims=_ALONG),
    ),
    "contour": (
        *_quantity("distance", "distance from the start of the line to the height or the crest",
                   "m", None, _MAP, cell_methods=None),
        *_quantity("distance_change", "movement away from the start of the line", "m", cell_methods=None),
    ),
}  # fmt: skip


def units_of(kind: str) -> dict[str, str]:
    """Return the units of the quantities of a kind of product by name."""
    return {spec.name: spec.units or "1" for spec in QUANTITIES[kind] if spec.ancillary}


@dataclass(frozen=True)
class ProductFile:
    """What a product's file is called and contains."""

    key: str  # name of the file
    title: str
    kind: str
    recipe: str  # hash of everything but the epochs that the values are computed from
    dim: str  # PLACE or DISTANCE
    x_m: Floats  # (n,) along that dimension
    y_m: Floats
    names: tuple[str, ...] = ()  # of the places
    distance_m: Floats | None = None  # from the start of the line

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The variables over time and place, or over time and distance."""
        return QUANTITIES[self.kind]


Row = Mapping[str, Floats]  # values (n,) of one epoch by variable
Columns = dict[str, np.ndarray[Any, Any]]  # (t, n) as stored


def product_path(folder: Path, key: str) -> Path:
    """Return the path of a product's file in a data folder."""
    return folder / FOLDER / f"{key}.nc"


def update_product(
    series: Series,
    product: ProductFile,
    entries: Entries,
    verdict: Ints,
    compute: Callable[[int], Row],
    progress: Callable[[], None],
) -> Path | None:
    """Bring a product's file up to date with its entries (n,), in order of time, and return its path.

    `compute` returns the values of an entry; those in the file are not computed again unless the product has
    changed or the file is damaged. Returns None and writes nothing without an entry. Raises StoreError if an
    epoch is damaged or the file cannot be written; the old file remains.
    """
    if not len(entries):
        return None
    path, keys = product_path(series.folder, product.key), entries.keys.tolist()
    known_keys, known = _read_known(path, product) if is_intact(path) else ([], {})
    if known_keys == keys:
        return path
    position = {key: index for index, key in enumerate(known_keys)}
    rows = np.array([position.get(key, MISSING) for key in keys])
    columns = {}
    for spec in product.variables:
        column = columns[spec.name] = np.full((len(keys), len(product.x_m)), FILL, spec.dtype)
        if known:
            column[rows != MISSING] = known[spec.name][rows[rows != MISSING]]
    for index in np.flatnonzero(rows == MISSING).tolist():
        for name, values in compute(index).items():
            columns[name][index] = np.where(np.isfinite(values), values, FILL)
        progress()
    with atomic_write(path) as tmp_path:
        with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
            _write(file, series, product, entries, verdict, columns)
        write_fingerprints(path, tmp_path)
    return path


def delete_products(series: Series, keys: Collection[str]) -> None:
    """Delete the files of these products."""
    for path in (product_path(series.folder, key) for key in keys):
        for file in (path, fingerprints_path(path)):
            with suppress(OSError):
                file.unlink()


def _read_known(path: Path, product: ProductFile) -> tuple[list[bytes], Columns]:
    """Return the keys and the columns of a file as stored; none if it is of another product or damaged."""
    try:
        with read_errors(path), h5py.File(path, "r") as file:
            if file.attrs[RECIPE] != np.bytes_(product.recipe):
                return [], {}
            columns = {spec.name: read_column(file[spec.name]) for spec in product.variables}
            bounds_s = file["time_bnds"][:]
            texts = [
                np.ascontiguousarray(read_column(file[spec.name])).view(f"S{TEXT_LENGTH['text']}")[:, 0]
                for spec in _KEYS
            ]
            return Entries(bounds_s[:, 0], bounds_s[:, 1], *texts).keys.tolist(), columns
    except StoreError:
        return [], {}


def _write(
    file: netCDF4.Dataset,
    series: Series,
    product: ProductFile,
    entries: Entries,
    verdict: Ints,
    columns: Columns,
) -> None:
    write_global_attrs(file, series, f"{product.title} at {series.name or series.station_id}")
    for dim, length in {"time": None, "bnds": 2, product.dim: len(product.x_m), **TEXT_LENGTH}.items():
        if dim not in file.dimensions:
            file.createDimension(dim, length)
    create_time_axis(file, len(entries))
    _write_geometry(file, series, product)
    for spec in (*product.variables, *_KEYS, _VERDICT):
        variable = create_variable(file, spec, series, len(entries))
        if len(spec.dims) == 2 and spec.dims[1] == product.dim:
            labels = "place_name " if product.names else ""
            variable.coordinates = f"{labels}{product.dim}_x {product.dim}_y"
            variable.setncatts({"grid_mapping": "crs"} if series.crs is not None else {})
    file.set_auto_mask(False)
    file["time"][:], file["time_bnds"][:] = (
        (entries.start_s + entries.end_s) / 2,
        np.stack([entries.start_s, entries.end_s], axis=-1),
    )
    for name, column in columns.items():
        file[name][:] = column
    for spec, texts in zip(_KEYS, (entries.sources, entries.reference_version), strict=True):
        file[spec.name][:] = encode_text([text.decode() for text in texts.tolist()], "text")
    file["verdict"][:] = verdict
    file.setncatts({RECIPE: product.recipe, "product_kind": product.kind, "product_name": product.title})
    file.setncatts(time_coverage(entries.start_s[0], entries.end_s[-1]))


def _write_geometry(file: netCDF4.Dataset, series: Series, product: ProductFile) -> None:
    """Write where the values are: places with their names, or points along a line."""
    if series.crs is not None:
        create_crs(file, series)
        file["crs"].delncattr("GeoTransform")  # there is no raster
    for axis, values in (("x", product.x_m), ("y", product.y_m)):
        variable = file.createVariable(f"{product.dim}_{axis}", "f8", (product.dim,))
        variable.setncatts(axis_attributes(axis, series.grid.plane))
        variable[:] = values
    if product.distance_m is not None:
        variable = file.createVariable(DISTANCE, "f8", (DISTANCE,))
        variable.setncatts({"long_name": "distance from the start of the line", "units": "m"})
        variable[:] = product.distance_m
        return
    file.setncatts({"featureType": "timeSeries", "cdm_data_type": "Station"})
    variable = file.createVariable("place_name", "S1", (PLACE, "text"))
    variable.setncatts({"long_name": "name of the place", "_Encoding": "utf-8", "cf_role": "timeseries_id"})
    variable[:] = encode_text(product.names, "text")


def product_keys(folder: Path) -> list[str]:
    """Return the products in a data folder, in order of their names."""
    return sorted(path.stem for path in (folder / FOLDER).glob("*.nc"))


def open_product(folder: Path, name: str) -> xr.Dataset:
    """Return a product by its name or that of its file; raise StationError if there is none."""
    import xarray as xr  # noqa: PLC0415 - half a second that the service does not need

    path = _find(folder, name)
    with read_errors(path), xr.open_dataset(path) as file:
        dataset = file.load()
    if PLACE in dataset.dims:
        return dataset.assign_coords({PLACE: dataset["place_name"].astype(str)})
    return dataset


@dataclass(frozen=True)
class ProductSeries:
    """A product over time, as its file has it."""

    name: str
    key: str
    kind: str
    labels: list[str] | list[float]  # (n,) names of places, or distances along a line [m]
    start_s: Floats  # (t,) since 1970
    end_s: Floats
    verdict: Ints
    columns: dict[str, Floats]  # (t, n) by variable, NaN where missing

    @property
    def units(self) -> dict[str, str]:
        """The units of its quantities by name."""
        return units_of(self.kind)

    @property
    def usable(self) -> ProductSeries:
        """The same without the scans that must not be used."""
        return self._at(self.verdict != VERDICTS.index("unusable"))

    def until(self, end_s: float) -> ProductSeries:
        """Return the scans that began before a time [s since 1970]."""
        return self._at(self.start_s < end_s)

    def _at(self, rows: Bools) -> ProductSeries:
        columns = {name: column[rows] for name, column in self.columns.items()}
        return replace(
            self,
            start_s=self.start_s[rows],
            end_s=self.end_s[rows],
            verdict=self.verdict[rows],
            columns=columns,
        )


def read_product(folder: Path, name: str) -> ProductSeries:
    """Return a product by its name or that of its file; raise StationError if there is none."""
    path = _find(folder, name)
    with read_errors(path), h5py.File(path, "r") as file:
        kind = file.attrs["product_kind"].decode()
        is_place = "place_name" in file
        bounds_s = np.asarray(file["time_bnds"][:], dtype=np.float64)
        columns = {
            spec.name: np.asarray(read_column(file[spec.name]), dtype=np.float64) for spec in QUANTITIES[kind]
        }
        return ProductSeries(
            name=file.attrs["product_name"].decode(),
            key=path.stem,
            kind=kind,
            labels=decode_text(file["place_name"][:]) if is_place else file[DISTANCE][:].tolist(),
            start_s=bounds_s[:, 0],
            end_s=bounds_s[:, 1],
            verdict=np.asarray(file["verdict"][:], dtype=np.int64),
            columns={name: np.where(values < FILL / 2, values, np.nan) for name, values in columns.items()},
        )


def read_products(folder: Path) -> list[ProductSeries]:
    """Return all products in a data folder, in order of their names."""
    return [read_product(folder, key) for key in product_keys(folder)]


def _find(folder: Path, name: str) -> Path:
    """Return the file of a product; raise StationError, with the products there are, if it has none."""
    path = product_path(folder, product_key(name))
    if not path.is_file():
        known = ", ".join(product_keys(folder)) or "none yet"
        raise StationError(f"no product {name!r} in {folder / FOLDER}; products: {known}")
    return path
