"""The whole thing in about a minute: a simulated station, processed, and what changed there."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from station.archive.store import open_series
from station.config import read_site
from station.service.journal import Entry, State
from station.service.once import one_line, process_scans
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
            if entry.state is not State.STORED or entry.verdict != "good":
                progress.console.print(one_line(entry), markup=False)
            progress.advance(task)

        status = process_scans(site, scans, tell)
        progress.update(task, completed=len(scans) + scenario.reference_scans)
    with open_series(site.station.data) as series, xr.open_dataset(folder / "truth.nc") as truth:
        Console(width=None if sys.stdout.isatty() else 100).print(_what_changed(series, truth))
    print(f"\n{site.station.data / 'series.nc'}")
    print("open it:  python -c \"import station; print(station.open('" + str(site.station.data) + "'))\"")
    return status


def _what_changed(series: xr.Dataset, truth: xr.Dataset) -> Table:
    """Compare the change of the ice with the truth, hour by hour, and the cells that changed for certain."""
    table = Table(title="Mean change of the glacier against the reference (mean of its scans)")
    for name in ("scan", "measured [m]", "true [m]", "cells", "changed (95 %)"):
        table.add_column(name, justify="left" if name == "scan" else "right")
    ice = truth.ice.values > 0.5
    used = truth.change.values[:8].mean(axis=0) if truth.sizes["time"] >= 8 else truth.change.values[0]
    for i in range(series.sizes["time"]):
        change = series.elevation_change[i].values
        quality = series.quality[i].values.astype(int)
        seen = ice & np.isfinite(change)
        if not seen.any():
            continue
        true = (truth.change.values[i] - used)[seen].mean()
        certain = ((quality & 16) > 0) & seen
        table.add_row(
            str(series.scan_id.values[i]), f"{change[seen].mean():+.3f}", f"{true:+.3f}",
            f"{seen.sum():,}", f"{100 * certain.sum() / seen.sum():.0f} %",
        )  # fmt: skip
    return table
