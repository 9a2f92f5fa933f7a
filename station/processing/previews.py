"""Preview of an epoch recorded while it is written; reading it back would take seven times as long."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from station.archive.netcdf_layout import Series
from station.archive.raster_io import Array
from station.config import Site
from station.products.gallery import cached_base_map
from station.products.overview import Overview, OverviewBuilder


def page_folder(site: Site) -> Path:
    """Return the folder of the web page of the station."""
    return site.station.data / "page"


class PreviewRecorder:
    """Recorder of the overview of an epoch while the epoch is written.

    An error in here must not lose the epoch: the page is then built from the store, and reports the error.
    """

    def __init__(self, site: Site, series: Series, version: str) -> None:
        """Prepare for an epoch processed with a version of the reference; with version '' record nothing."""
        self._builder: OverviewBuilder | None = None
        if version:
            self._try(lambda: self._start(site, series, version))

    def _start(self, site: Site, series: Series, version: str) -> None:
        base_map = cached_base_map(series, page_folder(site), version, site.products.quicklook_width_px)
        self._builder = OverviewBuilder(base_map, points=True)

    def add(self, rows: slice, rasters: Mapping[str, Array]) -> None:
        """Add some rows of the rasters; `epochs.write_epoch` calls this while writing."""
        if (builder := self._builder) is not None:
            self._try(lambda: builder.add(rows, rasters))

    @property
    def overview(self) -> Overview | None:
        """Overview of the recorded rows; None if nothing was recorded or an error occurred."""
        builder = self._builder
        return None if builder is None else self._try(builder.build)

    def _try(self, step: Callable[[], Overview | None]) -> Overview | None:
        try:
            return step()
        except Exception:  # noqa: BLE001 - the page is then built from the store, and reports the error
            self._builder = None
            return None
