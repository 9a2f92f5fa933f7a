"""`events.geojson`: events of a store, live and rebuilt, with late and damaged files, and their volume."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.epochs import random_epoch
from support.series import copied
from support.shared_parameters import SCANNER, random_shared

from station.archive import epochs
from station.archive.derived import computed_rasters
from station.archive.derived.event_table import (
    FOUND_NAME,
    decode_blocks,
    encode_blocks,
    read_events,
)
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.index import list_epochs
from station.archive.series.virtual import build_series
from station.quantities import Grid, Quality, Reference
from station.queries import block_sums, events
from station.queries.blocks import BlockQueries
from station.queries.events import LEAST_HISTORY, EventQueries

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=5.0, nx=60, ny=50)
RANDOM_M = 0.02
SHARED = random_shared(1, GRID)
HOURS, EVENT_HOUR = 14, 10
Y_M, X_M = GRID.y_m[:, None] - GRID.north_m, GRID.x_m[None, :] - GRID.west_m
DEPOSIT = (X_M - 180) ** 2 + (Y_M + 160) ** 2 < 20**2
SCAR = (X_M - 80) ** 2 + (Y_M + 60) ** 2 < 15**2
SURFACE_M = 0.8 * DEPOSIT - 1.0 * SCAR


def deposit_and_scar(hour):
    return SURFACE_M if hour >= EVENT_HOUR else np.zeros(GRID.shape)


def edge(hour):
    """Three cells that beams hit otherwise: the mean of a block changes by many of its sigma."""
    jump_m = np.zeros(GRID.shape)
    jump_m[25, 30:33] = 1.0 * (hour >= EVENT_HOUR)
    return jump_m


def slow_snowfall(hour):
    return np.full(GRID.shape, 0.02 * max(hour - EVENT_HOUR, 0))


def make_epoch(hour, surface=deposit_and_scar):
    epoch = random_epoch(
        hour,
        GRID,
        np.full(GRID.shape, RANDOM_M),
        quality=np.where(X_M < 20, int(Quality.STABLE_GROUND), 0) * np.ones(GRID.shape, int),
        scatter_m=RANDOM_M,
        shared=SHARED,
        scalars=SCANNER,
        provenance={"adjustment": "joint", "reference_version": "1"},
    )
    change_m = epoch.measurement.change_m + (surface(hour) - hour / 10).ravel().astype(np.float32)
    return replace(epoch, measurement=replace(epoch.measurement, change_m=change_m))


def write(series, hours, surface=deposit_and_scar):
    for hour in hours:
        epochs.write_epoch(series, make_epoch(hour, surface))
    build_series(series)


def copy_scans(base, series, hours):
    """Let the scans of some hours arrive in another store."""
    paths = sorted((base.folder / "epochs").rglob("*.nc"))
    for hour in hours:
        target = series.folder / paths[hour].relative_to(base.folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(paths[hour], target)
    build_series(series)


def update(series):
    searched = []
    needed = EventQueries(series, BlockQueries(series), 3600.0).update(lambda: searched.append(1))
    return len(searched), needed


def table(series):
    return (series.folder / "events.geojson").read_text()


def empty_store(folder):
    folder.mkdir()
    series = Series(folder, "hef", GRID, "EPSG:32632")
    surface = Reference.from_elevation(GRID, "1", 2800 + 0.3 * (Y_M - X_M))
    write_reference(series, replace(surface, random_variance_m2=np.full(GRID.shape, 1e-4, np.float32)))
    return series


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    series = empty_store(tmp_path_factory.mktemp("events") / "store")
    write(series, range(HOURS))
    update(series)
    return series


@pytest.fixture
def stored(base, tmp_path):
    return copied(base, tmp_path / "store")


def test_scar_and_deposit_are_a_pair_with_the_true_volumes(base):
    scar, deposit = sorted(read_events(base.folder), key=lambda event: event.volume_m3)
    assert (scar.kind, deposit.kind, scar.partner, deposit.partner) == (
        "paired",
        "paired",
        deposit.id,
        scar.id,
    )
    for event, surface_m in ((scar, -1.0 * SCAR), (deposit, 0.8 * DEPOSIT)):
        true_m3 = surface_m.sum() * 25
        assert abs(event.volume_m3 - true_m3) < 1.96 * event.volume_sigma_m3
        assert event.volume_sigma_m3 < 0.1 * abs(true_m3)
        assert event.area_m2 == pytest.approx(np.count_nonzero(surface_m) * 25, rel=0.6)
    assert deposit.balance_m3 == pytest.approx(scar.volume_m3 + deposit.volume_m3, abs=0.02)
    assert (deposit.east_m, deposit.north_m) == pytest.approx((632_180, 5_185_840), abs=6)
    assert deposit.confirmed[11:13] == f"{(int(deposit.begin[11:13]) + 1):02}"


def test_an_edge_that_is_hit_otherwise_is_no_event(tmp_path, monkeypatch):
    series = empty_store(tmp_path / "store")
    write(series, range(HOURS), edge)
    update(series)
    assert read_events(series.folder) == []
    (series.folder / FOUND_NAME).unlink()
    monkeypatch.setattr(events, "agreement_sigmas", lambda *_: events.LEAST_AGREEMENT + 1)
    update(series)
    assert len(read_events(series.folder)) == 1  # the means of blocks alone would say so


@pytest.mark.integration
def test_slow_snowfall_is_counted_from_the_scans_before_it(tmp_path):
    series = empty_store(tmp_path / "store")
    hours = 25
    write(series, range(hours), slow_snowfall)
    update(series)
    (snow,) = read_events(series.folder)
    assert (snow.kind, snow.state) == ("snowfall", "active")
    times = [f"{epoch.start:%Y-%m-%dT%H}" for epoch in list_epochs(series)]
    after, begin = (times.index(time[:13]) for time in (snow.after, snow.begin))
    assert after <= EVENT_HOUR < begin
    true_m3 = 0.02 * (hours - 1.5 - EVENT_HOUR) * snow.area_m2
    assert abs(snow.volume_m3 - true_m3) < 1.96 * snow.volume_sigma_m3
    assert snow.volume_sigma_m3 < 0.2 * true_m3


@pytest.mark.integration
def test_the_second_scan_tells_an_event_and_no_scan_before(base, tmp_path):
    series = empty_store(tmp_path / "store")
    copy_scans(base, series, range(EVENT_HOUR + 1))
    update(series)
    assert read_events(series.folder) == []
    copy_scans(base, series, [EVENT_HOUR + 1])
    update(series)
    assert {event.state for event in read_events(series.folder)} == {"active"}
    assert len(read_events(series.folder)) == 2


@pytest.mark.integration
def test_live_equals_anew_and_a_late_scan(base, tmp_path):
    """Scan by scan, and with one scan that comes last; each searches only windows that changed."""
    live = empty_store(tmp_path / "live")
    copy_scans(base, live, range(EVENT_HOUR - 1))
    update(live)
    for hour in range(EVENT_HOUR, HOURS):
        copy_scans(base, live, [hour])
        assert update(live)[0] == 1
    assert table(live) != table(base)
    copy_scans(base, live, [EVENT_HOUR - 1])
    assert update(live)[0] == HOURS - EVENT_HOUR + 1
    assert table(live) == table(base)


@pytest.mark.integration
def test_an_interrupted_search_of_a_whole_series_continues(base, tmp_path, monkeypatch):
    monkeypatch.setattr("station.queries.events.SEARCHES_KEPT", 2)
    series = empty_store(tmp_path / "store")
    copy_scans(base, series, range(HOURS))
    searched = []

    def stop_in_the_fourth():
        searched.append(1)
        if len(searched) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        EventQueries(series, BlockQueries(series), 3600.0).update(stop_in_the_fourth)
    windows = HOURS - LEAST_HISTORY - 1
    assert update(series)[0] == windows - 2
    assert table(series) == table(base)


@pytest.mark.parametrize("name", ["events.geojson", FOUND_NAME])
def test_a_damaged_file_is_built_again(stored, base, name):
    path = stored.folder / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    update(stored)
    assert table(stored) == table(base)


def test_the_sums_that_the_next_scan_needs_are_named(stored):
    assert len(update(stored)[1]) == HOURS


def test_sums_of_scans_that_were_read_back_are_kept_for_the_next_search(base, tmp_path, monkeypatch):
    """As those kept while a scan was written are: reading two days of scans back takes half a minute."""
    series = empty_store(tmp_path / "store")
    copy_scans(base, series, range(HOURS - 1))
    update(series)
    read = []
    monkeypatch.setattr(
        block_sums, "open_raster", lambda *place: read.append(place) or computed_rasters.open_raster(*place)
    )
    copy_scans(base, series, [HOURS - 1])
    assert update(series)[0] == 1
    assert {path.name for path, *_ in read} == {series_path(base, HOURS - 1).name}


def series_path(series, hour):
    return sorted((series.folder / "epochs").rglob("*.nc"))[hour]


def test_an_outline_is_that_of_its_blocks(base):
    features = json.loads(table(base))["features"]
    assert len(features) == 2
    for feature in features:
        assert feature["geometry"]["type"] in {"Polygon", "MultiPolygon"}


def test_blocks_are_read_as_written():
    blocks = np.random.default_rng(0).random((37, 53)) < 0.2
    assert np.array_equal(decode_blocks(encode_blocks(blocks), blocks.shape), blocks)
