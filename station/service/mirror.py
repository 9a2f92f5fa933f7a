"""The mirror: descriptions of the series for the cloud and for data servers, renewed by the service."""

from __future__ import annotations

from dataclasses import replace

from station.config import Site
from station.errors import StationError
from station.processing.site_files import series_for
from station.processing.workers.worker_process import Progress
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import pending, select, split

PERIODS = {"references": "1D"}  # of each file: one for all days would be rewritten with each epoch


def update_mirror(site: Site, progress: Progress) -> str:
    """Renew the files of the mirror whose epochs have changed; return why some could not be, or ''.

    Each file is replaced atomically.
    """
    faults = []
    for kind in site.mirror.formats if site.mirror else ():
        progress()
        try:
            _renew(site, kind, progress)
        except (StationError, OSError) as error:
            faults.append(f"{kind}: {error}")
    return "; ".join(faults)


def _renew(site: Site, kind: str, progress: Progress) -> None:
    assert site.mirror is not None  # noqa: S101 - the caller's case
    file_format, every = FORMATS[kind], PERIODS.get(kind)
    selection = select(series_for(site), Span.parse(None, None))
    if kind == "references":
        selection = replace(selection, url=site.mirror.url or site.station.data.resolve().as_uri())
    folder = site.mirror.folder
    folder.mkdir(parents=True, exist_ok=True)
    out = folder if every else folder / f"{site.station.id}{file_format.suffix}"
    parts = pending(selection, split(selection, out, file_format.suffix, every), file_format.read_fingerprint)
    for _ in file_format.write(selection, parts, lambda _: progress(), lambda _: progress()):
        progress()
