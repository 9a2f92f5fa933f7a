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
from station.quantities import Bools, Floats, Ints
from station.queries.aggregates import Aggregates, ObservedArea
from station.queries.epoch_cells import bounding_box
from station.queries.site_products.profile_lines import Line
from station.science.analysis.product_estimates import (
    Estimate,
    crest,
    crossing,
    gained,
    thickness_between,
    water_equivalent,
)
from station.sections.product import ProductSection, SurfaceTime

HOUR_S = 3600.0
NEW_SNOW_H = (24, 72)
TIME_TOLERANCE = 1 / 12  # of the hours of new snow: 2 h of 24 h
NONE = -1  # no such epoch
FORMAT = "1"  # of the computation, part of the recipe

Row = dict[str, Floats]


@dataclass(frozen=True)
class Product:
    """A product of the site file with what it refers to, on the grid."""

    section: ProductSection
    places: dict[str, Bools]  # cells (ny, nx) by name
    line: Line | None = None
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
        self._datum = np.broadcast_to(0.0, series.grid.shape)  # heights count from it
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
        if isinstance(product.section.surface, SurfaceTime) and NONE in partners[:, 0]:
            delete_products(self.series, [product.section.key])  # its surface has not been measured yet
            return None
        sources = [
            self._sources(*indices) for indices in zip(epochs.tolist(), partners.tolist(), strict=True)
        ]
        entries = Entries(
            self._epochs.start_s[epochs],
            self._end_s[epochs],
            np.array(sources, f"S{TEXT_LENGTH['text']}"),
            self._versions[epochs],
        )

        def compute(row: int) -> Row:
            others = [None if index == NONE else self._epochs[index] for index in partners[row].tolist()]
            return self._compute(product, self._epochs[int(epochs[row])], others)

        file, verdict = self._file(product), self._verdict[epochs]
        return update_product(self.series, file, entries, verdict, compute, progress)

    def _file(self, product: Product) -> ProductFile:
        section, line = product.section, product.line
        if section.kind == "profile" and line is not None:
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
        """Return the epochs that the values of each epoch (n,) depend on, NONE where there is none.

        That of the surface (n, 1), of snow also those 24 and 72 h before (n, 3).
        """
        surface = product.section.surface
        base = self._surface_epoch(surface) if isinstance(surface, SurfaceTime) else NONE
        columns = [np.full(len(self._measured), base)]
        if product.section.kind == "snow_depth":
            columns += [self._earlier(hours) for hours in NEW_SNOW_H]
        return np.stack(columns, axis=-1)

    def _surface_epoch(self, span: SurfaceTime) -> int:
        """Return the usable epoch nearest to the middle of a time span, a good one if there is any.

        NONE until the span is over: as long as it grows, each scan would change all values.
        """
        from_s, to_s = span.from_.timestamp(), span.to.timestamp()
        time_s = self._epochs.time_s[self._usable]
        within = self._usable[(time_s >= from_s) & (time_s <= to_s)]
        if not len(within) or self._epochs.time_s[-1] <= to_s:
            return NONE
        distance_s = np.abs(self._epochs.time_s[within] - (from_s + to_s) / 2)
        return int(within[np.lexsort([distance_s, self._verdict[within]])[0]])

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

    def _sources(self, index: int, partners: list[int]) -> bytes:
        """Return the name of the epoch file, or the hash of those of an epoch and its partners."""
        names = [b"" if other == NONE else bytes(self._epochs.epoch_file[other]) for other in partners]
        own = bytes(self._epochs.epoch_file[index])
        if not any(names):
            return own
        return hashlib.sha256(b"|".join([own, *names])).hexdigest().encode()

    def _compute(self, product: Product, epoch: EpochRef, partners: list[EpochRef | None]) -> Row:
        kind, line = product.section.kind, product.line
        if kind == "profile" and line is not None:
            return self._profile(line, epoch)
        if kind == "contour" and line is not None:
            return _columns({"distance": [self._contour(line, epoch, product.section.height_m)]}, np.empty(0))
        values: dict[str, list[Estimate]] = {}
        coverage = []
        for cells in product.places.values():
            estimates, observed = self._place(product, cells, epoch, partners)
            coverage.append(observed)
            for name, estimate in estimates.items():
                values.setdefault(name, []).append(estimate)
        return _columns(values, np.array(coverage))

    def _place(
        self, product: Product, cells: Bools, epoch: EpochRef, partners: list[EpochRef | None]
    ) -> tuple[dict[str, Estimate], float]:
        """Return the quantities of one place by name, and the share of it that was observed."""
        section, base = product.section, partners[0]
        if section.kind == "volume_between":
            return self._volume_between(product, cells, epoch)
        if section.kind == "volume_budget":
            return self._volume_budget(product, cells, epoch, base)
        if section.kind == "point":
            change, coverage = self._mean(cells, epoch)
            return {
                "elevation": self._mean(cells, epoch, surface_m=self._datum)[0],
                "elevation_change": change,
            }, coverage
        change, coverage = self._mean(cells, epoch, base, product.rasters.get("surface"))
        if section.kind == "snow_depth":
            depths = {"snow_depth": change.with_offset(section.offset_m, section.offset_sigma_m)}
            for hours, earlier in zip(NEW_SNOW_H, partners[1:], strict=True):
                name = f"new_snow_{hours}h"
                depths[name] = self._mean(cells, epoch, earlier)[0] if earlier else Estimate()
            return depths, coverage
        mass = water_equivalent(change, section.density_kg_m3 or 0.0, section.density_sigma_kg_m3)
        return {section.kind: mass if section.kind == "surface_mass_balance" else mass.scaled(-1.0)}, coverage

    def _mean(
        self, cells: Bools, epoch: EpochRef, other: EpochRef | None = None, surface_m: Floats | None = None
    ) -> tuple[Estimate, float]:
        """Return the mean change or height of a place with its voids interpolated, and its coverage."""
        area = self.observe(cells, epoch, other, surface_m)
        if area is None:
            return Estimate(), 0.0
        if epoch == other:
            return Estimate(0.0, 0.0, 0.0), area.coverage
        return self._sum(area, area.weights, area.value_m, area.void_m2), area.coverage

    def _sum(
        self, area: ObservedArea, weights: Floats, value_m: Floats, void_variance: float,
        derivative: Floats | float = 1.0,
    ) -> Estimate:  # fmt: skip
        random, total = self.sum_variance(area, weights * derivative)
        return Estimate(float(weights @ value_m), random, total - random + void_variance)

    def _volume_between(
        self, product: Product, cells: Bools, epoch: EpochRef
    ) -> tuple[dict[str, Estimate], float]:
        area = self.observe(cells, epoch, surface_m=self._datum)
        if area is None:
            return {"volume": Estimate()}, 0.0
        levels = {"low": -np.inf, "high": np.inf} | product.section.levels
        low_m, high_m = (
            product.rasters[key][area.cells] if key in product.rasters else np.array(levels[key])
            for key in ("low", "high")
        )
        thickness_m, derivative = thickness_between(area.value_m, low_m, high_m)
        size_m2 = np.count_nonzero(cells) * self.grid.cell_m**2
        volume = self._sum(area, size_m2 * area.weights, thickness_m, size_m2**2 * area.void_m2, derivative)
        return {"volume": volume}, area.coverage

    def _volume_budget(
        self, product: Product, cells: Bools, epoch: EpochRef, base: EpochRef | None
    ) -> tuple[dict[str, Estimate], float]:
        """Return gain, loss and net of an area; each cell counts in one class, so they close exactly."""
        area = self.observe(cells, epoch, base, product.rasters.get("surface"))
        if area is None:
            return dict.fromkeys(("deposition", "erosion", "net_change"), Estimate()), 0.0
        if epoch == base:
            return (
                dict.fromkeys(("deposition", "erosion", "net_change"), Estimate(0.0, 0.0, 0.0)),
                area.coverage,
            )
        bounds = bounding_box(cells, 0)
        observed = area.cells[bounds]
        change_m, random_m = np.full((2, *observed.shape), np.nan)
        change_m[observed], random_m[observed] = area.value_m, np.sqrt(np.sum(area.random_m2, axis=0))
        is_gain = gained(change_m, random_m)[observed]
        count = np.count_nonzero(cells)
        size_m2, in_voids = count * self.grid.cell_m**2, area.weights - 1 / count
        budget = {}
        for name, chosen in (
            ("deposition", is_gain),
            ("erosion", ~is_gain),
            ("net_change", np.ones_like(is_gain)),
        ):
            share = in_voids[chosen].sum() / in_voids.sum() if area.void_m2 else 0.0  # of the voids
            weights = size_m2 * np.where(chosen, area.weights, 0.0)
            budget[name] = self._sum(area, weights, area.value_m, (share * size_m2) ** 2 * area.void_m2)
        return budget, area.coverage

    def _profile(self, line: Line, epoch: EpochRef) -> Row:
        columns: Row = {}
        for name, surface_m in (("elevation", self._datum), ("elevation_change", None)):
            area = self.observe(line.cells, epoch, surface_m=surface_m)
            value, random_m2, systematic_m2 = np.full((3, len(line.distance_m)), np.nan)
            if area is not None:
                weights, complete = line.weights(area.cells)
                cell_random_m2, cell_systematic_m2 = self.cell_variances(area)
                value[complete] = (weights @ area.value_m)[complete]
                random_m2[complete] = (weights.power(2) @ cell_random_m2)[complete]
                systematic_m2[complete] = (weights @ np.sqrt(cell_systematic_m2))[complete] ** 2
            columns |= _parts(name, value, random_m2, systematic_m2)
        return columns

    def _contour(self, line: Line, epoch: EpochRef, height_m: float | str | None) -> Estimate:
        """Return the distance along a line at which the surface crosses a height, or of its crest [m]."""
        area = self.observe(line.cells, epoch, surface_m=self._datum)
        if area is None:
            return Estimate()
        interpolation, complete = line.weights(area.cells)
        profile_m = np.where(complete, interpolation @ area.value_m, np.nan)
        found = (
            crossing(line.distance_m, profile_m, height_m)
            if isinstance(height_m, float)
            else crest(line.distance_m, profile_m)
        )
        if found is None:
            return Estimate()
        random, total = self.sum_variance(area, found.sensitivity @ interpolation[found.samples])
        return Estimate(found.distance_m, max(random, found.scatter_variance), total - random)


def _columns(values: dict[str, list[Estimate]], coverage: Floats) -> Row:
    """Return the variables of quantities in all places (n,)."""
    columns: Row = {"coverage": coverage} if len(coverage) else {}
    for name, estimates in values.items():
        columns |= _parts(
            name,
            np.array([estimate.value for estimate in estimates]),
            np.array([estimate.random_variance for estimate in estimates]),
            np.array([estimate.systematic_variance for estimate in estimates]),
        )
    return columns


def _parts(name: str, value: Floats, random: Floats, systematic: Floats) -> Row:
    """Return the variables of a quantity: value, and one sigma of everything and of its two parts."""
    sigmas = (np.sqrt(np.maximum(variance, 0)) for variance in (random + systematic, random, systematic))
    return {name: value, **{f"{name}_{part}": sigma for part, sigma in zip(SIGMAS, sigmas, strict=True)}}
