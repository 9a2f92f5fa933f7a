"""`station demo`: simulate a station, process its scans, print its changes; takes about a minute."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from station.archive.reference_files import read_reference
from station.config import Site, read_site
from station.inbox.journal_reader import Entry, State
from station.operations.batch import format_entry, process_scans
from station.processing.epoch_recorder import page_folder
from station.processing.site_files import series_for
from station.products.area_tables import area_cells
from station.products.epoch_table import read_epoch_table
from station.products.web.page_areas import newest_value, usable_area_series
from station.products.web.page_text import format_number, format_utc
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
    with xr.open_dataset(folder / "truth.nc") as truth:
        Console(width=None if sys.stdout.isatty() else 100).print(_area_table(site, truth))
    print(f"\n{site.station.data / 'series.nc'}")
    print(
        f"open it:  {sys.executable} -c \"import station; print(station.open('"
        + str(site.station.data)
        + "'))\""
    )
    page = page_folder(site) / "index.html"
    print(f"the page: {page.absolute().as_uri()}")
    return status


def _area_table(site: Site, truth: xr.Dataset) -> Table:
    """Return a table of the newest change of each area, as the page shows it, next to the true one."""
    series = series_for(site)
    epochs, reference, cells = read_epoch_table(series), read_reference(series), area_cells(site, None)
    scan_ids = [str(scan_id) for scan_id in truth.scan_id.values]
    of_reference = [scan_ids.index(scan_id) for scan_id in (reference.scan_ids if reference else ())]
    true_change_m = truth.change.values - truth.change.values[of_reference].mean(axis=0)
    table = Table(
        title="Change of the areas since the reference",
        caption="± is the 95 % interval, systematic errors included. The page and areas.nc show the same.",
    )
    for name in ("area", "time, UTC", "mean, m", "true, m", "volume, m³"):
        table.add_column(name, justify="left" if name == "area" else "right", no_wrap=True)
    for value in map(newest_value, usable_area_series(series, epochs)):
        if value.start_s is not None:
            scan_id = epochs.texts["scan_id"][int(np.searchsorted(epochs.start_s, value.start_s))]
            true_m = true_change_m[scan_ids.index(scan_id)][cells[value.name]].mean()
            table.add_row(
                value.name,
                format_utc(value.start_s),
                f"{format_number(value.mean_m, 3, sign=True)} ± {format_number(value.mean_half_m, 3)}",
                format_number(true_m, 3, sign=True),
                f"{format_number(value.volume_m3, 0, sign=True)} ± {format_number(value.volume_half_m3, 0)}",
            )
    return table
