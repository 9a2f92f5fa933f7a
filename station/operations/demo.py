"""`station demo`: simulate a station, process its scans, print its changes; takes about a minute."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from station.archive.series.lazy import open_series
from station.config import Site, read_site
from station.inbox.journal_reader import Entry, State
from station.operations.batch import format_entry, process_scans
from station.processing.epoch_recorder import page_folder
from station.processing.site_files import series_for
from station.quantities import Quality
from station.queries.aggregates import Aggregates
from station.simulation.station import demo, simulate


def run_demo(folder: Path, hours: int) -> int:
    """Simulate a station in `folder`, process its scans, print the changes; return the exit status."""
    stderr = Console(stderr=True)
    scenario = demo(hours=hours)
    with stderr.status(f"simulating {hours} hourly scans in {folder} …"):
        simulate(folder, scenario)
    site = read_site(folder / "site.toml")
    scans = sorted(site.scans.inbox.glob("*.laz"))
    with Progress(console=stderr) as progress:
        task = progress.add_task("processing", total=len(scans) + scenario.reference_scans)

        def report(entry: Entry) -> None:
            if entry.state in {State.SET_ASIDE, State.LATER} or entry.verdict == "degraded":
                progress.console.print(format_entry(entry), markup=False)
            progress.advance(task)

        status = process_scans(site, scans, report)
        progress.update(task, completed=len(scans) + scenario.reference_scans)
    with open_series(site.station.data) as series, xr.open_dataset(folder / "truth.nc") as truth:
        Console(width=None if sys.stdout.isatty() else 100).print(_change_table(site, series, truth))
    print(f"\n{site.station.data / 'series.nc'}")
    print(
        f"open it:  {sys.executable} -c \"import station; print(station.open('"
        + str(site.station.data)
        + "'))\""
    )
    page = page_folder(site) / "index.html"
    print(f"the page: {page.absolute().as_uri()}")
    return status


def _change_table(site: Site, series: xr.Dataset, truth: xr.Dataset) -> Table:
    """Return a table of the mean change of the glacier, measured and true, per scan [m]."""
    aggregates = Aggregates(series_for(site))
    truth_scans = [str(scan_id) for scan_id in truth.scan_id.values]
    reference_change_m = truth.change.values[
        [truth_scans.index(scan_id) for scan_id in aggregates.reference().scan_ids]
    ].mean(axis=0)
    ice = truth.ice.values > 0.5
    table = Table(title="Mean change of the glacier", caption="against the mean of the reference's scans")
    for name in ("scan", "measured, m", "± 1 σ, m", "true, m", "cells changed at 95 %"):
        table.add_column(name, justify="left" if name == "scan" else "right", no_wrap=True)
    for index, scan_id in enumerate(str(value) for value in series.scan_id.values):
        observed = ice & np.isfinite(series.elevation_change[index].values)
        measured = aggregates.area(observed, aggregates.find_epoch(index))
        true_m = (truth.change.values[truth_scans.index(scan_id)] - reference_change_m)[observed].mean()
        significant = (series.quality[index].values[observed].astype(int) & Quality.CHANGE_SIGNIFICANT) > 0
        columns = (
            f"{measured.mean_m:+.3f}",
            f"{measured.mean_sigma_m:.3f}",
            f"{true_m:+.3f}",
            f"{100 * significant.mean():.0f} %",
        )
        table.add_row(scan_id, *columns)
    return table
