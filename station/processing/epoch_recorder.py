"""What is derived from an epoch while it is written; reading it back would take seven times as long."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from station.archive.netcdf_layout import Series
from station.archive.raster_io import Array
from station.config import Site
from station.products.gallery import cached_base_map
from station.products.overview import Overview, OverviewBuilder
from station.products.viewer.value_tiles import CellTiles, write_cells
from station.queries.block_sums import EpochSummer, keep_epoch_sums


def page_folder(site: Site) -> Path:
    """Return the folder of the web page of the station."""
    return site.station.data / "page"


class EpochRecorder:
    """Recorder of the overview, the tiles and the sums of blocks of an epoch while the epoch is written.

    An error in here must not lose the epoch: page and blocks are then built from the store, and report the
    error.
    """

    def __init__(self, site: Site, series: Series, version: str, *, with_preview: bool = True) -> None:
        """Prepare for an epoch processed with a version of the reference; with version '' record nothing."""
        self._series, self._page_folder = series, page_folder(site)
        self._tiles: CellTiles | None = None
        self._builder: OverviewBuilder | None = None
        self._summer: EpochSummer | None = None
        if version:
            self._summer = EpochSummer(series.grid)
        if version and with_preview:
            self._try_preview(lambda: self._start_preview(site, version))

    def _start_preview(self, site: Site, version: str) -> None:
        width_px = site.products.quicklook_width_px
        base_map = cached_base_map(self._series, self._page_folder, version, width_px)
        self._builder = OverviewBuilder(base_map)
        if base_map.factor > 1:
            self._tiles = CellTiles(base_map)

    def add(self, rows: slice, rasters: Mapping[str, Array]) -> None:
        """Add some rows of the rasters; `epochs.write_epoch` calls this while writing."""
        if (builder := self._builder) is not None:
            self._try_preview(lambda: builder.add(rows, rasters))
        if (tiles := self._tiles) is not None:
            self._try_preview(lambda: tiles.add(rows, rasters))
        if (summer := self._summer) is not None:
            self._try_sums(lambda: summer.add(rows, rasters))

    def keep(self, epoch_path: Path) -> None:
        """Keep the sums of the blocks, and the tiles of the page, when the epoch was written."""
        if (tiles := self._tiles) is not None:
            self._try_preview(lambda: write_cells(self._page_folder, epoch_path.name, tiles))
        if (summer := self._summer) is not None:
            self._try_sums(lambda: keep_epoch_sums(self._series, epoch_path, summer))

    @property
    def overview(self) -> Overview | None:
        """Overview of the recorded rows; None if nothing was recorded or an error occurred."""
        builder = self._builder
        return None if builder is None else self._try_preview(builder.build)

    def _try_preview(self, step: Callable[[], Overview | None]) -> Overview | None:
        try:
            return step()
        except Exception:  # noqa: BLE001 - the page is then built from the store, and reports the error
            self._builder = self._tiles = None
            return None

    def _try_sums(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception:  # noqa: BLE001 - the blocks are then read from the store, which reports the error
            self._summer = None
