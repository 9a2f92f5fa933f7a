"""What the pictures of a scan need, taken while it is in memory: reading it again is five times the work."""

from __future__ import annotations

from pathlib import Path

from station.archive.layout import Series
from station.archive.store import Epoch
from station.config import Site
from station.products.gallery import kept_base
from station.products.look import Look, look_at


def page_folder(site: Site) -> Path:
    """Return the folder of the station's page."""
    return site.station.data / "page"


def look_in_memory(site: Site, series: Series, epoch: Epoch) -> Look | None:
    """See an epoch as its pictures will; None where it has no change, or only the store can tell.

    It is stored by now, and nothing that goes wrong here may cost it.
    """
    version = epoch.provenance["reference_version"]
    if not version:
        return None
    try:
        base = kept_base(series, page_folder(site), version, site.products.quicklook_width_px)
        return look_at(epoch.measurement, base, points=True)
    except Exception:  # noqa: BLE001 - the page is made from the store then, and tells what is wrong
        return None
