"""A scanner that was moved is news once, from the stored series alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.archive import store
from station.archive.layout import Series
from station.archive.series import build_series
from station.config import read_site
from station.errors import StoreError
from station.quantities import Grid, Measurement, Shared
from station.science.shared import GLOBAL
from station.service import health, moved
from station.service.once import process_scans
from station.simulation.station import named, simulate

GRID = Grid(0.0, 20.0, 10.0, 3, 2)
START_S = 1_763_683_200.0  # 2025-11-21, a midnight
STEP = np.radians(0.02)


def epoch(hour, pose, **changes):
    flat = np.zeros(GRID.shape, np.float32)
    names = ("elevation_m", "change_m", "uncertainty_m", "random_uncertainty_m", "spread_m")
    rasters = dict.fromkeys(names, flat) | {"count": flat.astype(np.int32)}
    size = len(GLOBAL)
    estimate = np.concatenate([pose, np.zeros(size - len(pose))])
    names, units = zip(*GLOBAL, strict=True)
    return replace(
        store.Epoch(
            start_s=START_S + 3600 * hour,
            end_s=START_S + 3600 * hour + 900,
            scan_id=f"scan {hour}",
            measurement=Measurement.of(GRID, flat.astype(np.uint8), **rasters),
            shared=Shared(names, units, estimate, np.eye(size) * 1e-12, np.zeros(size)),
            verdict="good",
            verdict_reason="",
            numbers={},
            provenance={"adjustment": "joint", "sop_id": "sop-1", "reference_version": "1"},
        ),
        **changes,
    )


@pytest.fixture
def poses():
    """Hourly scans, knocked before that of hour 20."""
    pose = np.random.default_rng(1).normal(0, 1, (26, 6)) * ([15e-6] * 3 + [5e-4] * 3)
    pose[20:, 0] += STEP
    return pose


@pytest.fixture
def site(tmp_path, monkeypatch):
    series = Series(tmp_path, "hef", GRID, None)
    monkeypatch.setattr(moved, "series_of", lambda _: series)
    return SimpleNamespace(station=SimpleNamespace(data=tmp_path))


def write(site, epochs):
    series = moved.series_of(site)
    for one in epochs:
        store.write_epoch(series, one)
    build_series(series)


def heard(site, monkeypatch, poses, known, hours):
    """What is said as scans come one by one, by the hour of the scan."""
    said, known = {}, list(known)
    for hour in hours:
        known = sorted([*known, hour])
        series = START_S + 3600.0 * np.array(known), poses[known]
        monkeypatch.setattr(moved, "_poses", lambda _, held=series: held)
        if text := moved.moved_by(site, START_S + 3600 * hour)[1]:
            said[hour] = text
    return said


def test_it_is_news_once_with_the_scan_that_shows_it(site, monkeypatch, poses):
    said = heard(site, monkeypatch, poses, range(10), range(10, 26))
    assert list(said) == [24]
    assert said[24].startswith("scanner tilted by 0.0")
    assert "between 2025-11-21 19:00 and 2025-11-21 20:00 UTC" in said[24]
    assert "shifted" not in said[24]


def test_late_scans_bring_the_news_too(site, monkeypatch, poses):
    """The first scans come last, as when they are done again with their reference."""
    assert len(heard(site, monkeypatch, poses, range(10, 26), range(10))) == 1


def test_the_stored_series_tells_the_same(site, poses):
    write(site, (epoch(hour, pose) for hour, pose in enumerate(poses)))
    text = moved.moved(site)
    assert "between 2025-11-21 19:00 and 2025-11-21 20:00 UTC" in text
    assert moved.moved_by(site, START_S + 3600 * 3) == (text, "")
    assert health._moved(site) == text


def test_other_sops_and_scans_that_were_not_adjusted_are_not_compared(site, poses):
    other = {"adjustment": "joint", "sop_id": "sop-2", "reference_version": "1"}
    alone = {"adjustment": "none", "sop_id": "sop-1", "reference_version": "1"}
    wild = np.full(6, 0.5)
    mixed = [epoch(hour, pose) for hour, pose in enumerate(poses[:20])]
    mixed += [epoch(hour, wild, provenance=alone) for hour in range(20, 23)]
    mixed += [epoch(hour, wild, verdict="unusable") for hour in range(23, 26)]
    write(site, mixed)
    assert moved.moved(site) == ""
    write(site, (epoch(hour, pose, provenance=other) for hour, pose in enumerate(poses[20:], 26)))
    assert moved.moved(site) == ""


def test_a_damaged_series_is_said(site):
    (site.station.data / "series.nc").write_bytes(b"no series")
    with pytest.raises(StoreError, match="cannot be read"):
        moved.moved(site)
    assert "cannot be read" in health._moved(site)


@pytest.mark.slow
def test_a_knock_of_a_simulated_station_is_heard(tmp_path, caplog):
    """Tilted by 0.02°, turned by 0.01° and shifted by 5 mm between two scans: told once, sizes right."""
    folder = tmp_path / "station"
    simulate(folder, named("moved", hours=30))
    site = read_site(folder / "site.toml")
    process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None)
    (line,) = [record.getMessage() for record in caplog.records if "moved=" in record.getMessage()]
    assert "between 2025-07-15 14:00 and 2025-07-15 15:00" in line
    tilt, turn = (float(line.split(word)[1].split()[0]) for word in ("tilted by ", "turned by "))
    assert tilt == pytest.approx(0.02, abs=0.008)
    assert turn == pytest.approx(0.01, abs=0.003)
    assert health.status(site)["moved"].startswith("scanner tilted")
