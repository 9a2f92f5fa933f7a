"""Publishing: the station page and GeoTIFF of the newest epoch, written in a worker process."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from station.config import Site
from station.errors import StationError
from station.inbox.journal_reader import JournalReader
from station.monitoring.alarm_state import MAX_LOG, active_since, recent_messages
from station.monitoring.log_clock import log_clock_offset
from station.monitoring.pose_stability import step_shown_by
from station.monitoring.status import queue_status
from station.processing.epoch_recorder import page_folder
from station.processing.scan_tasks import StoredResult
from station.processing.site_files import series_for
from station.processing.workers.worker_process import Progress
from station.products.export import export
from station.products.page import PageContext, write_page
from station.scan_names import scan_id


@dataclass(frozen=True)
class PublishResult:
    """What publishing reports."""

    warning: str  # the movement of the scanner, if this scan revealed it
    fault: str  # why the page or a file could not be written
    input_faults: tuple[str, ...] = ()  # why optional files cannot be used


def publish(site: Site, result: StoredResult | None, progress: Progress) -> PublishResult:
    """Update the page and write the newest change as GeoTIFF, as configured; return warning and fault.

    `result` belongs to a scan just stored, which may reveal that the scanner was moved.
    """
    progress()
    faults, warning = list[str](), ""
    try:
        if site.adjusts and (site.station.data / "series.nc").is_file():
            last_step, warning = step_shown_by(site, result.start_utc_s if result else None)
            faults = [
                *([f"moved: {last_step}"] if last_step else []),
                *filter(None, [log_clock_offset(site)]),
            ]
            progress()
        _write_products(site, result, faults, progress)
    except StationError as error:
        return PublishResult(warning, str(error), site.input_faults)
    return PublishResult(warning, "", site.input_faults)


def _write_products(site: Site, result: StoredResult | None, faults: list[str], progress: Progress) -> None:
    products = site.products
    if products.page:
        series, folder, context = series_for(site), page_folder(site), _page_context(site, result, faults)
        write_page(series, folder, context, products.quicklook_width_px, products.change_limit_m, progress)
    if products.geotiff and (site.station.data / "reference.nc").is_file():
        export(site, "geotiff", None, site.station.data / "geotiff")


def _page_context(site: Site, result: StoredResult | None, faults: list[str]) -> PageContext:
    backlog = queue_status(site)
    with JournalReader(site.station.data / "journal.sqlite") as journal:
        durations_s, measured_again = journal.durations_s(), journal.measured_again(MAX_LOG)
    data = site.station.data
    return PageContext(
        name=site.station.name,
        institution=site.station.institution,
        written_s=round(time.time(), 1),
        expected_every_s=site.scans.expected_every_s,
        waiting=backlog["waiting"],
        set_aside=sorted(backlog["set_aside"], key=lambda scan: str(scan["since"])),
        faults=[*backlog["faults"], *faults],
        durations_s={scan_id(name): duration_s for name, duration_s in durations_s.items()},
        language=site.products.language,
        alarms=[{"text": text, "since_s": since_s} for text, since_s in active_since(data).items()],
        alarm_log=recent_messages(data),
        measured_again=measured_again,
        overviews={Path(result.epoch).name: result.overview} if result and result.overview else {},
    )
