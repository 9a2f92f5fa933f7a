"""A simulated station that is processed, with its truth."""

import numpy as np
import xarray as xr
from support.series import open_with_processing

import station
from station.config import read_site
from station.inbox.listing import ScanFile
from station.processing import reference_tasks, scan_tasks, store_tasks
from station.queries.aggregates import Aggregates
from station.queries.site_products.product_queries import Product, update_products
from station.queries.site_products.profile_lines import sample_line
from station.sections.product import ProductSection

REFERENCE = 3  # scans
BOX = 10  # cells of 10 m


class ProcessedStation:
    """A simulated station, processed from a scan on, optionally with changes of its site file."""

    def __init__(self, folder, *changes, first=None, reference=REFERENCE):
        first = reference if first is None else first
        self.folder, name = folder, "site"
        if changes:
            name = f"other-{len(list(folder.glob('*.toml')))}"
            text = (folder / "site.toml").read_text()
            for old, new in (*changes, ('data = "data"', f'data = "{name}"')):
                assert old in text
                text = text.replace(old, new)
            (folder / f"{name}.toml").write_text(text)
        self.site = read_site(folder / f"{name}.toml")
        scans = []
        for path in sorted(self.site.scans.inbox.glob("*.laz")):
            log = path.with_name(f"{path.stem}-incl.txt")
            log = log if self.site.inclination and log.is_file() else None
            status = path.stat()
            scans.append(ScanFile(path.name, path, log, status.st_size, status.st_mtime_ns))
        reference_tasks.build_reference_version(self.site, scans[:reference], "1", lambda: None)
        self.results = [scan_tasks.process(self.site, scan, lambda: None) for scan in scans[first:]]
        store_tasks.update_series(self.site, lambda: None)
        with open_with_processing(self.site.station.data) as series:
            self.series = series.load()
        truth = xr.open_dataset(folder / "truth.nc").load()
        before = truth.change[:reference].mean("time")
        self.true_change = (truth.change[first:] - before).values
        self.true_elevation = truth.elevation[first:].values
        self.stable = truth.stable_polygons.values.astype(bool)
        self.aggregates = Aggregates(scan_tasks.series_for(self.site))
        x, y = self.series.scanner_east.values[0], self.series.scanner_north.values[0]
        self.distance_m = np.hypot(self.series.x.values - x, self.series.y.values[:, None] - y)

    def error(self):
        return self.series.elevation_change.values - self.true_change

    def boxes(self, errors=None, *, everywhere=False):
        """Return error [m], sigma [m] and distance [m] of every 100 m box, by default off stable ground."""
        rows = []
        for scan, error in enumerate(self.error() if errors is None else errors):
            epoch = self.aggregates.find_epoch(scan)
            for top in range(0, error.shape[0] - BOX, 2 * BOX):
                for left in range(0, error.shape[1] - BOX, 2 * BOX):
                    box = np.s_[top : top + BOX, left : left + BOX]
                    observed = np.isfinite(error[box])
                    if observed.mean() < 0.6 or (self.stable[box].any() and not everywhere):
                        continue
                    weights = np.zeros(error.shape)
                    weights[box] = observed / observed.sum()
                    sigma = np.sqrt(self.aggregates.variance(weights, epoch))
                    rows.append((error[box][observed].mean(), sigma, self.distance_m[box].mean()))
        return np.array(rows).T

    def area_z(self):
        """Return the mean error of all cells off stable ground over its sigma, by scan."""
        z = []
        for scan, error in enumerate(self.error()):
            observed = np.isfinite(error) & ~self.stable
            variance = self.aggregates.variance(observed / observed.sum(), self.aggregates.find_epoch(scan))
            z.append(error[observed].mean() / np.sqrt(variance))
        return np.array(z)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def product_of(processed, places=None, **settings):
    """Return a product of a station in places, or along its line."""
    section = ProductSection.model_validate({"name": "product", **settings})
    series = scan_tasks.series_for(processed.site)
    line = sample_line(section.line, processed.site.grid_cells) if section.line else None
    product = Product(section, places or {"product": line.cells}, {"product": line} if line else {})
    update_products(series, [product], [section.key], lambda: None)
    return station.product(series.folder, "product")


def crossing_m(line, heights_m, level_m):
    """Return where a true profile crosses a level, between two of its samples; NaN if it does not."""
    above = heights_m > level_m
    changes = np.flatnonzero(above[1:] != above[:-1])
    if not len(changes):
        return np.nan
    first = changes[0]
    share = (level_m - heights_m[first]) / (heights_m[first + 1] - heights_m[first])
    return line.distance_m[first] + share * (line.distance_m[first + 1] - line.distance_m[first])


def squares_of(processed, side, spacing):
    """Return some 40 places of `side` x `side` cells, every `spacing` cells, off the stable ground.

    All scans saw them.
    """
    seen, places = np.isfinite(processed.error()).all(axis=0) & ~processed.stable, {}
    for top, left in np.ndindex(*(size // spacing for size in seen.shape)):
        cells = np.zeros(seen.shape, bool)
        cells[spacing * top :, spacing * left :][:side, :side] = True
        if seen[cells].all():
            places[f"{top} {left}"] = cells
    return dict(list(places.items())[:: max(len(places) // 40, 1)])
