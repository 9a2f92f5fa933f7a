"""What the pictures of a scan need, taken as it is written: reading it again is seven times the work."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from station.archive.layout import Series
from station.archive.rasters import Array
from station.config import Site
from station.products.gallery import kept_base
from station.products.look import Look, Looking


def page_folder(site: Site) -> Path:
    """Return the folder of the station's page."""
    return site.station.data / "page"


class Watched:
    """An epoch seen as its pictures will show it, while it is written.

    Nothing that goes wrong here may cost the epoch: the page is made from the store then, and tells why.
    """

    def __init__(self, site: Site, series: Series, version: str) -> None:
        """Prepare for an epoch that was measured from a version of the reference; without one for none."""
        self._looking: Looking | None = None
        if version:
            self._try(lambda: self._begin(site, series, version))

    def _begin(self, site: Site, series: Series, version: str) -> None:
        base = kept_base(series, page_folder(site), version, site.products.quicklook_width_px)
        self._looking = Looking(base, points=True)

    def add(self, rows: slice, rasters: Mapping[str, Array]) -> None:
        """See some rows, as `store.write_epoch` shows them."""
        if (looking := self._looking) is not None:
            self._try(lambda: looking.add(rows, rasters))

    @property
    def look(self) -> Look | None:
        """What has been seen; None where nothing was to be, or something went wrong."""
        looking = self._looking
        return None if looking is None else self._try(looking.look)

    def _try(self, step: Callable[[], Look | None]) -> Look | None:
        try:
            return step()
        except Exception:  # noqa: BLE001 - the page is made from the store then, and tells what is wrong
            self._looking = None
            return None
