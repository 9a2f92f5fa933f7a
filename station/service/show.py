"""What is made of a scan for people and other tools, in a child process, from archive and journal."""

from __future__ import annotations

import time
from pathlib import Path

from station.config import Site
from station.products.export import export
from station.products.page import Told, write_page
from station.service.health import status
from station.service.journal import Journal
from station.service.tasks import Progress, series_of


def show(site: Site, progress: Progress) -> None:
    """Bring the page up to what is stored, and write the newest change as GeoTIFF, as the site asks for.

    Raises StoreError where something cannot be read or written.
    """
    progress()
    wanted = site.products
    if wanted.page:
        series, folder = series_of(site), page_folder(site)
        write_page(series, folder, _told(site), wanted.quicklook_width_px, wanted.change_limit_m, progress)
    if wanted.geotiff and (site.station.data / "reference.nc").is_file():
        export(site, "geotiff", None, site.station.data / "geotiff")


def page_folder(site: Site) -> Path:
    """Return the folder of the station's page."""
    return site.station.data / "page"


def _told(site: Site) -> Told:
    found = status(site)
    with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
        seconds = journal.seconds()
    return Told(
        name=site.station.name,
        institution=site.station.institution,
        written_s=round(time.time(), 1),
        expected_every_s=site.scans.expected_every_s,
        waiting=found["waiting"],
        set_aside=sorted(found["set_aside"], key=lambda one: str(one["since"])),
        faults=found["faults"] + ([f"moved: {found['moved']}"] if found["moved"] else []),
        seconds={Path(name).stem: took for name, took in seconds.items()},
    )
