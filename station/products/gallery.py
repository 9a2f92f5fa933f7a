"""Maps of the recent epochs as files: which are kept, and those that lack are drawn."""

from __future__ import annotations

import hashlib
import json
import time
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from station import __version__
from station.archive.layout import Series, written_whole
from station.archive.store import Row
from station.products.colours import round_up
from station.products.look import Base, Look, base_of, look_at
from station.products.maps import Caption, change_map, encoded, points_map, sigma_map
from station.quantities import Floats, Grid

ALL_FOR = timedelta(days=2)  # before the newest epoch; then the last map of each day …
DAILY_FOR = timedelta(days=60)  # … and before that the last of each month
DAY_S = 86_400.0
MOST_DRAWN = 8  # at a time: an archive that was there before the page is shown bit by bit
TOGETHER = 2  # pictures; to encode them takes most of the time
GRACE_S = 3600.0  # a page that is open somewhere may still name a map that is kept no longer
SIGMAS_TO_THE_END = 10.0


class Measured(NamedTuple):
    """An epoch that has a reference; thousands are made for a page."""

    rows: Sequence[Row]
    at: int  # its place among these
    start: datetime
    version: str  # of the reference
    verdict: str  # what the caption says of it
    look: Look | None = None  # where it need not be read

    @property
    def row(self) -> Row:
        """Return where it lies."""
        return self.rows[self.at]


@dataclass(frozen=True)
class Style:
    """How maps are drawn; maps of another style are drawn anew."""

    station: str
    width_px: int
    limit_m: float | None  # None: fixed once, by the first epoch that is drawn


@dataclass(frozen=True)
class Hung:
    """A map that is there, relative to the gallery's folder."""

    start: datetime
    file: str


@dataclass(frozen=True)
class Gallery:
    """What there is to show: change by time, and for the newest epoch what goes with it."""

    change: list[Hung]
    sigma: str | None
    points: str | None
    limit_m: float | None
    size: tuple[int, int]  # of a map [pixels]


def hang(
    series: Series,
    folder: Path,
    found: list[Measured],
    style: Style,
    progress: Callable[[], None],
) -> Gallery:
    """Draw the maps that lack, newest first, and take down those that are kept no longer.

    `found` are the epochs that have a reference, in the order of time. Raises StoreError where something
    cannot be read or written.
    """
    if not found:
        return Gallery([], None, None, style.limit_m, (0, 0))
    limit_m = style.limit_m or _limit(series, folder, found[0])
    told = json.dumps([style.station, style.width_px, limit_m, __version__])
    tag = hashlib.sha256(told.encode()).hexdigest()[:8]
    place = folder / "maps"
    kept = [found[index] for index in thinned(np.array([one.start.timestamp() for one in found]))]
    drawn, hung = 0, []
    for one in reversed(kept):
        row = one.row
        name = f"{Path(row.epoch_file).stem}_{tag}.webp"
        last = one is found[-1]
        if not all((place / file).is_file() for file in _names(name, last=last)):
            if drawn == MOST_DRAWN:
                continue
            caption = Caption(style.station, f"{row.start:%Y-%m-%d %H:%M} UTC", one.verdict)
            look = one.look or look_at(
                row, kept_base(series, folder, one.version, style.width_px), points=last
            )
            _draw(look, place, caption, style.width_px, limit_m, name, last=last)
            drawn += 1
            progress()
        hung.append(Hung(row.start, f"maps/{name}"))
    hung.reverse()
    _, sigma, points = _names(Path(hung[-1].file).name, last=True)
    _take_down(place, {Path(one.file).name for one in hung} | {sigma, points})
    with Image.open(folder / hung[-1].file) as picture:
        return Gallery(hung, f"maps/{sigma}", f"maps/{points}", limit_m, picture.size)


def _names(name: str, *, last: bool) -> tuple[str, ...]:
    """Return the files of an epoch: its change, and for the newest its sigma and points."""
    stem = name.removesuffix(".webp")
    return (name, f"{stem}_sigma.webp", f"{stem}_points.webp") if last else (name,)


def thinned(start_s: Floats) -> list[int]:
    """Return which of some moments (n,) [s], in their order, are kept: fewer the older they are.

    Whole days grow too old for a map each: what is kept of a month was drawn as that of its day.
    """
    day = start_s // DAY_S
    month = start_s.astype("datetime64[s]").astype("datetime64[M]").astype(np.int64)
    young = start_s[-1] - start_s <= ALL_FOR.total_seconds()
    daily = ~young & (day[-1] - day <= DAILY_FOR.days)
    kept = [np.flatnonzero(young)]
    for some, of in ((daily, day), (~young & ~daily, month)):
        index = np.flatnonzero(some)
        kept.append(index[np.diff(of[index], append=np.inf) != 0])
    return [int(index) for index in np.sort(np.concatenate(kept))]


def _draw(
    look: Look, place: Path, caption: Caption, width_px: int, limit_m: float, name: str, *, last: bool
) -> None:
    names = _names(name, last=last)
    drawings: list[Callable[[], Image.Image]] = [
        lambda: change_map(look, caption, limit_m, width_px, "the reference"),
        lambda: sigma_map(look, caption, limit_m, width_px),
        lambda: points_map(look, caption, width_px),
    ]
    with ThreadPoolExecutor(TOGETHER) as pool:
        pictures = pool.map(lambda draw: encoded(draw()), drawings[: len(names)])
        for file, picture in zip(names, pictures, strict=True):
            put(place / file, picture)


def put(path: Path, content: bytes) -> None:
    """Replace a file as a whole; one that is the same already is left as it is."""
    try:
        if path.read_bytes() == content:
            return
    except OSError:
        pass
    with written_whole(path) as beside:
        beside.write_bytes(content)


def kept_base(series: Series, folder: Path, version: str, pixels: int) -> Base:
    """Return the base of a reference's version; kept beside the maps it takes half a second off each."""
    path = folder / f".terrain_{version}_{pixels}.npz"
    grid = series.grid
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            if np.array_equal(file["grid"], [grid.west_m, grid.north_m, grid.cell_m, grid.nx, grid.ny]):
                top, bottom, left, right, factor = (int(n) for n in file["part"])
                west_m, north_m, cell_m = (float(n) for n in file["place"])
                shade = np.where(file["shade"] == 0, np.float32(np.nan), (file["shade"] - 1.0) / 254.0)
                ny, nx = shade.shape
                part = Grid(west_m, north_m, cell_m, nx, ny)
                rows, columns = slice(top, bottom), slice(left, right)
                return Base(version, factor, rows, columns, shade.astype(np.float32), part)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        pass  # not there yet, or damaged: made anew
    base = base_of(series, version, pixels)
    shade = np.where(np.isfinite(base.shade), 1 + 254 * np.nan_to_num(base.shade), 0).round().astype(np.uint8)
    with written_whole(path) as beside, beside.open("wb") as file:
        np.savez_compressed(
            file,
            grid=[grid.west_m, grid.north_m, grid.cell_m, grid.nx, grid.ny],
            part=[base.rows.start, base.rows.stop, base.columns.start, base.columns.stop, base.factor],
            place=[base.grid.west_m, base.grid.north_m, base.grid.cell_m],
            shade=shade,
        )
    return base


def _limit(series: Series, folder: Path, first: Measured) -> float:
    """Return where the colours of change end [m]: fixed once, by the first epoch there is then."""
    path = folder / "limit.json"
    try:
        return float(json.loads(path.read_text(encoding="ascii"))["change_limit_m"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    limit_m = default_limit(series, first.row, first.version)
    put(path, json.dumps({"change_limit_m": limit_m}).encode("ascii"))
    return limit_m


def default_limit(series: Series, row: Row, version: str) -> float:
    """Return ten times the median sigma of an epoch's cells [m], rounded up."""
    look = look_at(row, base_of(series, version, max(series.grid.shape)))
    if not look.seen.any():
        return 1.0
    return round_up(SIGMAS_TO_THE_END * float(np.median(look.sigma_m[look.seen])))


def _take_down(place: Path, kept: set[str]) -> None:
    for path in place.glob("*.webp"):
        if path.name not in kept and time.time() - path.stat().st_mtime > GRACE_S:
            path.unlink(missing_ok=True)
