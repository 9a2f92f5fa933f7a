"""What is made of a scan for people and other tools, in a child process, from archive and journal."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from station.config import Site
from station.errors import StationError
from station.products.export import export
from station.products.page import Told, write_page
from station.service.health import queue
from station.service.journal import Journal
from station.service.late_log import late_log
from station.service.moved import moved_by
from station.service.pictures import page_folder
from station.service.tasks import Outcome, Progress, series_of


@dataclass(frozen=True)
class Shown:
    """What came of showing a scan."""

    news: str  # how the scanner was moved, if this scan shows it
    fault: str  # why the page or a file could not be made


def show(site: Site, outcome: Outcome | None, progress: Progress) -> Shown:
    """Bring the page up to what is stored, and write the newest change as GeoTIFF, as the site asks for.

    `outcome` is of a scan just stored, which may show that the scanner was moved.
    """
    progress()
    faults, news = list[str](), ""
    try:
        if site.adjusts and (site.station.data / "series.nc").is_file():
            moved, news = moved_by(site, outcome.start_utc_s if outcome else None)
            faults = [*([f"moved: {moved}"] if moved else []), *filter(None, [late_log(site)])]
            progress()
        _show(site, outcome, faults, progress)
    except StationError as error:
        return Shown(news, str(error))
    return Shown(news, "")


def _show(site: Site, outcome: Outcome | None, faults: list[str], progress: Progress) -> None:
    wanted = site.products
    if wanted.page:
        series, folder, told = series_of(site), page_folder(site), _told(site, outcome, faults)
        write_page(series, folder, told, wanted.quicklook_width_px, wanted.change_limit_m, progress)
    if wanted.geotiff and (site.station.data / "reference.nc").is_file():
        export(site, "geotiff", None, site.station.data / "geotiff")


def _told(site: Site, outcome: Outcome | None, faults: list[str]) -> Told:
    found = queue(site)
    with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
        seconds = journal.seconds()
    return Told(
        name=site.station.name,
        institution=site.station.institution,
        written_s=round(time.time(), 1),
        expected_every_s=site.scans.expected_every_s,
        waiting=found["waiting"],
        set_aside=sorted(found["set_aside"], key=lambda one: str(one["since"])),
        faults=[*found["faults"], *faults],
        seconds={name.rpartition(".")[0] or name: took for name, took in seconds.items()},
        looks={Path(outcome.epoch).name: outcome.look} if outcome and outcome.look else {},
    )
