"""`products/`: the quantities of `[[product]]` from the epochs, with the random and the systematic part of σ.

Each value is a weighted sum of changes or heights of cells, in one epoch or between two, so its variance is
that of `Aggregates`; what is the owner's (offset, density) is added to the systematic part.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from station.archive.chunk_codec import read_column
from station.archive.derived.boxes import Entries
from station.archive.derived.product_files import (
    DISTANCE,
    PLACE,
    SIGMAS,
    ProductFile,
    delete_products,
    product_keys,
    update_product,
)
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.read_errors import read_errors
from station.archive.schema import TEXT_LENGTH, VERDICTS
from station.archive.series.index import SeriesIndex
from station.errors import StationError
from station.quantities import Bools, Floats, Ints
from station.queries.aggregates import Aggregates
from station.queries.site_products.profile_lines import Line
from station.queries.site_products.quantities_along_lines import contour, profile
from station.queries.site_products.quantities_of_places import (
    NEW_SNOW_H,
    CountedFrom,
    deciding_cells,
    place_quantities,
)
from station.queries.site_products.surface_scans import SurfaceScans
from station.science.analysis.product_estimates import Estimate
from station.sections.product import ProductSection, SurfaceTime

HOUR_S = 3600.0
TIME_TOLERANCE = 1 / 12  # of the hours of new snow: 2 h of 24 h
SURFACE_SCANS = 24  # of a time span at most: more of them make a mean hardly better
NONE = -1  # no such epoch
FORMAT = "4"  # of the computation, part of the recipe

Row = dict[str, Floats]


@dataclass(frozen=True)
class Product:
    """A product of the site file with what it refers to, on the grid."""

    section: ProductSection
    places: dict[str, Bools]  # cells (ny, nx) by name
    lines: Mapping[str, Line] = field(default_factory=dict)  # of the same names
    rasters: Mapping[str, Floats] = field(default_factory=dict)  # (ny, nx) given surfaces by key
    files: tuple[str, ...] = ()  # SHA-256 of these

    @property
    def recipe(self) -> str:
        """Hash of everything but the epochs that the values depend on."""
        settings = self.section.model_dump_json(exclude={"name", "observations", "surface", "low", "high"})
        surface = self.section.surface
        span = surface.model_dump_json() if isinstance(surface, SurfaceTime) else ""
        digest = hashlib.sha256("|".join([FORMAT, settings, span, *self.files]).encode())
        digest.update(json.dumps(self.section.levels).encode())
        for name, cells in self.places.items():
            digest.update(repr((name, cells.shape)).encode() + np.packbits(cells).tobytes())
        return digest.hexdigest()


def update_products(
    series: Series, products: Iterable[Product], keys: Iterable[str], progress: Callable[[], None]
) -> None:
    """Bring the files of `products/` up to date with `series.nc`; delete those whose key is not in `keys`.

    `progress` is called after each epoch computed. Raises StoreError if an epoch is damaged or a file cannot
    be written; the old file remains.
    """
    delete_products(series, set(product_keys(series.folder)) - set(keys))
    queries = None
    for product in products:
        queries = queries or ProductQueries(series)
        queries.update(product, progress)


class ProductQueries(Aggregates):
    """Products of the epochs of a store."""

    def __init__(self, series: Series) -> None:
        """Read the index of the series; raise StoreError if it cannot be read."""
        super().__init__(series)
        self._epochs = SeriesIndex(series)
        self._end_s, self._verdict = np.empty(0), np.empty(0, np.int64)
        self._versions = np.empty(0, f"S{TEXT_LENGTH['text']}")
        if len(self._epochs):
            with read_errors(series.path), h5py.File(series.path, "r") as file:
                self._end_s = np.asarray(file["time_bnds"][:, 1], dtype=np.float64)
                self._verdict = np.asarray(read_column(file["verdict"]), dtype=np.int64)
                self._versions = read_column(file["reference_version"]).view(self._versions.dtype)[:, 0]
        self._measured = np.flatnonzero(self._versions != b"")
        usable = self._verdict[self._measured] != VERDICTS.index("unusable")
        self._usable = self._measured[usable]

    def update(self, product: Product, progress: Callable[[], None]) -> Path | None:
        """Bring the file of a product up to date; None if there is nothing to write yet."""
        epochs, partners = self._measured, self._partners(product)
        base = self._base(product)
        if base is None:
            delete_products(self.series, [product.section.key])
            return None
        names = [epoch.epoch_file.encode() for epoch in base]
        sources = [
            self._sources(index, names, others)
            for index, others in zip(epochs.tolist(), partners.tolist(), strict=True)
        ]
        entries = Entries(
            self._epochs.start_s[epochs],
            self._end_s[epochs],
            np.array(sources, f"S{TEXT_LENGTH['text']}"),
            self._versions[epochs],
        )
        surface: list[SurfaceScans] = []  # read when the first entry is computed

        def compute(row: int) -> Row:
            if base and not surface:
                cells = np.logical_or.reduce(list(product.places.values()))
                if product.section.kind == "volume_budget":
                    cells = deciding_cells(cells)
                surface.append(SurfaceScans(self, base, cells))
            others = [None if index == NONE else self._epochs[index] for index in partners[row].tolist()]
            return self._compute(
                product, self._epochs[int(epochs[row])], surface[0] if surface else None, others
            )

        file, verdict = self._file(product), self._verdict[epochs]
        return update_product(self.series, file, entries, verdict, compute, progress)

    def _base(self, product: Product) -> list[EpochRef] | None:
        """Return the epochs of the surface of a product, none if it has no time; None if not measured yet."""
        if not isinstance(product.section.surface, SurfaceTime):
            return []
        return [
            self._epochs[index] for index in self._surface_epochs(product.section.surface).tolist()
        ] or None

    def surface_scans(self, product: Product, cells: Bools) -> SurfaceScans | None:
        """Return the scans that a product counts from at cells (ny, nx); None if it counts from none.

        Raises StationError if they have not been measured yet.
        """
        base = self._base(product)
        if base is None:
            raise StationError(
                f"product {product.section.name}: the time of its surface is not over, or has no usable scan"
            )
        return SurfaceScans(self, base, cells) if base else None

    def _file(self, product: Product) -> ProductFile:
        section = product.section
        if section.kind == "profile":
            (line,) = product.lines.values()
            return ProductFile(
                section.key, section.name, section.kind, product.recipe, DISTANCE,
                line.x_m, line.y_m, (), line.distance_m,
            )  # fmt: skip
        rows, columns = np.array([np.argwhere(cells).mean(axis=0) for cells in product.places.values()]).T
        return ProductFile(
            section.key, section.name, section.kind, product.recipe, PLACE,
            self.grid.west_m + (columns + 0.5) * self.grid.cell_m,
            self.grid.north_m - (rows + 0.5) * self.grid.cell_m,
            tuple(product.places),
        )  # fmt: skip

    def _partners(self, product: Product) -> Ints:
        """Return the epochs 24 and 72 h before each epoch (n, 2), NONE where there is none; for snow only."""
        if product.section.kind != "snow_depth":
            return np.empty((len(self._measured), 0), np.int64)
        return np.stack([self._earlier(hours) for hours in NEW_SNOW_H], axis=-1)

    def _surface_epochs(self, span: SurfaceTime) -> Ints:
        """Return the usable epochs of a time span that make its surface, good ones if there are any.

        They have the reference of the last one. None until the span is over: as long as it grows, each scan
        would change all values.
        """
        from_s, to_s = span.from_.timestamp(), span.to.timestamp()
        time_s = self._epochs.time_s[self._usable]
        within = self._usable[(time_s >= from_s) & (time_s <= to_s)]
        if not len(within) or self._epochs.time_s[-1] <= to_s:
            return np.empty(0, np.int64)
        within = within[self._verdict[within] == self._verdict[within].min()]
        within = within[self._versions[within] == self._versions[within[-1]]]
        spread = np.linspace(0, len(within) - 1, min(len(within), SURFACE_SCANS))
        return np.asarray(within[np.round(spread).astype(np.int64)])

    def _earlier(self, hours: float) -> Ints:
        """Return the usable epoch about as many hours before each epoch (n,)."""
        wanted_s = self._epochs.time_s[self._measured] - hours * HOUR_S
        time_s = self._epochs.time_s[self._usable]
        if not len(time_s):
            return np.full(len(wanted_s), NONE)
        after = np.searchsorted(time_s, wanted_s).clip(1, max(len(time_s) - 1, 1))
        candidates = np.stack([after - 1, np.minimum(after, len(time_s) - 1)])
        distance_s = np.abs(time_s[candidates] - wanted_s)
        nearest = np.take_along_axis(candidates, distance_s.argmin(axis=0)[None], axis=0)[0]
        is_near = distance_s.min(axis=0) <= TIME_TOLERANCE * hours * HOUR_S
        return np.where(is_near, self._usable[nearest], NONE)

    def _sources(self, index: int, base: list[bytes], partners: list[int]) -> bytes:
        """Return the name of the epoch file, or the hash of those of all epochs that its values depend on."""
        own = bytes(self._epochs.epoch_file[index])
        names = [
            *base,
            *(b"" if other == NONE else bytes(self._epochs.epoch_file[other]) for other in partners),
        ]
        if not any(names):
            return own
        return hashlib.sha256(b"|".join([own, *names])).hexdigest().encode()

    def _compute(
        self, product: Product, epoch: EpochRef, scans: SurfaceScans | None, earlier: list[EpochRef | None]
    ) -> Row:
        section = product.section
        base = CountedFrom(scans, product.rasters.get("surface"))
        if section.kind == "profile":
            (line,) = product.lines.values()
            along = profile(self, line, epoch)
            return {name: v for of, estimate in along.items() for name, v in parts_of(of, estimate).items()}
        values: dict[str, list[Estimate]] = {}
        coverage = []
        for place, cells in product.places.items():
            if section.kind == "contour":
                estimates = contour(self, product.lines[place], epoch, section.height_m, base)
            else:
                estimates, observed = place_quantities(
                    self, section, product.rasters, cells, epoch, base, earlier
                )
                coverage.append(observed)
            for name, estimate in estimates.items():
                values.setdefault(name, []).append(estimate)
        return _columns(values, np.array(coverage))


def _columns(values: dict[str, list[Estimate]], coverage: Floats) -> Row:
    """Return the variables of quantities in all places (n,)."""
    columns: Row = {"coverage": coverage} if len(coverage) else {}
    for name, estimates in values.items():
        parts = ("value", "random_variance", "systematic_variance")
        columns |= parts_of(
            name, Estimate(*(np.array([getattr(estimate, part) for estimate in estimates]) for part in parts))
        )
    return columns


def parts_of(name: str, estimate: Estimate) -> Row:
    """Return the variables of a quantity (n,): value, and one sigma of everything and of its two parts."""
    variances = estimate.variance, estimate.random_variance, estimate.systematic_variance
    sigmas = (np.sqrt(np.maximum(variance, 0)) for variance in variances)
    parts = zip(SIGMAS, sigmas, strict=True)
    return {name: np.asarray(estimate.value), **{f"{name}_{part}": sigma for part, sigma in parts}}
