"""The whole thing in about a minute: a simulated station, processed, and what changed there."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from station.archive.aggregate import Aggregates
from station.archive.opened import open_series
from station.config import Site, read_site
from station.quantities import Quality
from station.service.journal import Entry, State
from station.service.once import one_line, process_scans
from station.service.pictures import page_folder
from station.service.tasks import series_of
from station.simulation.station import demo, simulate


def run_demo(folder: Path, hours: int) -> int:
    """Simulate a station in `folder`, process its scans, print what changed; return the exit status."""
    err = Console(stderr=True)
    scenario = demo(hours=hours)
    with err.status(f"simulating {hours} hourly scans in {folder} …"):
        simulate(folder, scenario)
    site = read_site(folder / "site.toml")
    scans = sorted(site.scans.inbox.glob("*.laz"))
    with Progress(console=err) as progress:
        task = progress.add_task("processing", total=len(scans) + scenario.reference_scans)

        def tell(entry: Entry) -> None:
            if entry.state in {State.SET_ASIDE, State.LATER} or entry.verdict == "degraded":
                progress.console.print(one_line(entry), markup=False)
            progress.advance(task)

        status = process_scans(site, scans, tell)
        progress.update(task, completed=len(scans) + scenario.reference_scans)
    with open_series(site.station.data) as series, xr.open_dataset(folder / "truth.nc") as truth:
        Console(width=None if sys.stdout.isatty() else 100).print(_what_changed(site, series, truth))
    print(f"\n{site.station.data / 'series.nc'}")
    print(
        f"open it:  {sys.executable} -c \"import station; print(station.open('"
        + str(site.station.data)
        + "'))\""
    )
    page = page_folder(site) / "index.html"
    print(f"the page: {page.absolute().as_uri()}")
    return status


def _what_changed(site: Site, series: xr.Dataset, truth: xr.Dataset) -> Table:
    """Compare the mean change of the glacier with the truth, scan by scan."""
    found = Aggregates(series_of(site))
    in_truth = [str(scan_id) for scan_id in truth.scan_id.values]
    zero = truth.change.values[[in_truth.index(scan_id) for scan_id in found.reference().scan_ids]].mean(
        axis=0
    )
    ice = truth.ice.values > 0.5
    table = Table(title="Mean change of the glacier", caption="against the mean of the reference's scans")
    for name in ("scan", "measured, m", "± 1 σ, m", "true, m", "cells changed at 95 %"):
        table.add_column(name, justify="left" if name == "scan" else "right", no_wrap=True)
    for i, scan_id in enumerate(str(one) for one in series.scan_id.values):
        seen = ice & np.isfinite(series.elevation_change[i].values)
        measured = found.area(seen, found.row(i))
        true_m = (truth.change.values[in_truth.index(scan_id)] - zero)[seen].mean()
        certain = (series.quality[i].values[seen].astype(int) & Quality.CHANGE_SIGNIFICANT) > 0
        told = (
            f"{measured.mean_m:+.3f}",
            f"{measured.mean_sigma_m:.3f}",
            f"{true_m:+.3f}",
            f"{100 * certain.mean():.0f} %",
        )
        table.add_row(scan_id, *told)
    return table
