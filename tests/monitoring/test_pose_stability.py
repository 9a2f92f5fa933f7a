"""Steps of the scanner pose, detected in the stored series and reported once."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.series.virtual import build_series
from station.config import read_site
from station.errors import StoreError
from station.monitoring import pose_stability, status
from station.operations.batch import process_scans
from station.quantities import Grid, Measurement, SharedParameters
from station.science.uncertainty.parameters import GLOBAL
from station.simulation.scenario import small
from station.simulation.station import simulate

GRID = Grid(0.0, 20.0, 10.0, 3, 2)
START_S = 1_763_683_200.0  # 2025-11-21, a midnight
STEP = np.radians(0.02)


def epoch(hour, pose, **changes):
    flat = np.zeros(GRID.shape, np.float32)
    names = ("elevation_m", "change_m", "uncertainty_m", "systematic_uncertainty_m", "spread_m")
    rasters = dict.fromkeys(names, flat) | {"count": flat.astype(np.int32)}
    size = len(GLOBAL)
    estimate = np.concatenate([pose, np.zeros(size - len(pose))])
    names, units = zip(*GLOBAL, strict=True)
    return replace(
        epochs.Epoch(
            start_s=START_S + 3600 * hour,
            end_s=START_S + 3600 * hour + 900,
            scan_id=f"scan {hour}",
            measurement=Measurement.from_rasters(GRID, flat.astype(np.uint8), **rasters),
            shared=SharedParameters(names, units, estimate, np.eye(size) * 1e-12, np.zeros(size)),
            verdict="good",
            verdict_reason="",
            scalars={},
            provenance={"adjustment": "joint", "sop_id": "sop-1", "reference_version": "1"},
        ),
        **changes,
    )


@pytest.fixture
def poses():
    """Hourly poses; the scanner is knocked before hour 20."""
    pose = np.random.default_rng(1).normal(0, 1, (26, 6)) * ([15e-6] * 3 + [5e-4] * 3)
    pose[20:, 0] += STEP
    return pose


@pytest.fixture
def site(tmp_path, monkeypatch):
    series = Series(tmp_path, "hef", GRID, None)
    monkeypatch.setattr(pose_stability, "series_for", lambda _: series)
    return SimpleNamespace(station=SimpleNamespace(data=tmp_path))


def write(site, written):
    series = pose_stability.series_for(site)
    for scan in written:
        epochs.write_epoch(series, scan)
    build_series(series)


def reported_steps(site, monkeypatch, poses, stored_hours, hours):
    """Return the reports by hour of the scan, for scans stored one by one."""
    reports, stored_hours = {}, list(stored_hours)
    for hour in hours:
        stored_hours = sorted([*stored_hours, hour])
        series = START_S + 3600.0 * np.array(stored_hours), poses[stored_hours]
        monkeypatch.setattr(pose_stability, "_read_poses", lambda _, result=series: result)
        if text := pose_stability.step_shown_by(site, START_S + 3600 * hour)[1]:
            reports[hour] = text
    return reports


def test_step_is_reported_once_by_the_scan_that_shows_it(site, monkeypatch, poses):
    reports = reported_steps(site, monkeypatch, poses, range(10), range(10, 26))
    assert list(reports) == [24]
    assert reports[24].startswith("scanner tilted by 0.0")
    assert "between 2025-11-21 19:00 and 2025-11-21 20:00 UTC" in reports[24]
    assert "shifted" not in reports[24]


def test_late_scans_report_the_step_too(site, monkeypatch, poses):
    """The first scans are stored last, as in a reprocessing with a new reference."""
    assert len(reported_steps(site, monkeypatch, poses, range(10, 26), range(10))) == 1


@pytest.mark.integration
def test_stored_series_gives_the_same_step(site, poses):
    write(site, (epoch(hour, pose) for hour, pose in enumerate(poses)))
    text = pose_stability.latest_step(site)
    assert "between 2025-11-21 19:00 and 2025-11-21 20:00 UTC" in text
    assert pose_stability.step_shown_by(site, START_S + 3600 * 3) == (text, "")
    assert status._last_pose_step(site) == text


@pytest.mark.integration
def test_other_sops_and_unadjusted_scans_are_not_compared(site, poses):
    other = {"adjustment": "joint", "sop_id": "sop-2", "reference_version": "1"}
    unadjusted = {"adjustment": "none", "sop_id": "sop-1", "reference_version": "1"}
    wrong_pose = np.full(6, 0.5)
    mixed = [epoch(hour, pose) for hour, pose in enumerate(poses[:20])]
    mixed += [epoch(hour, wrong_pose, provenance=unadjusted) for hour in range(20, 23)]
    mixed += [epoch(hour, wrong_pose, verdict="unusable") for hour in range(23, 26)]
    write(site, mixed)
    assert pose_stability.latest_step(site) == ""
    write(site, (epoch(hour, pose, provenance=other) for hour, pose in enumerate(poses[20:], 26)))
    assert pose_stability.latest_step(site) == ""


def test_damaged_series_is_reported(site):
    (site.station.data / "series.nc").write_bytes(b"no series")
    with pytest.raises(StoreError, match="cannot be read"):
        pose_stability.latest_step(site)
    assert "cannot be read" in status._last_pose_step(site)


@pytest.mark.slow
def test_simulated_pose_step_is_reported_with_its_size(tmp_path, caplog):
    """The scanner is tilted by 0.02°, turned by 0.01° and shifted by 5 mm between two scans."""
    folder = tmp_path / "station"
    moved = replace(
        small(hours=21), melt_m_per_h=0.0, avalanche_m=0.0, reference_scans=4,
        moved_hour=12.5, moved_deg=0.02, moved_m=0.005,
    )  # fmt: skip
    simulate(folder, moved)
    (folder / "site.toml").write_text((folder / "site.toml").read_text() + "[products]\npage = false\n")
    site = read_site(folder / "site.toml")
    process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None)
    (line,) = [record.getMessage() for record in caplog.records if "moved=" in record.getMessage()]
    assert "between 2025-07-15 12:00 and 2025-07-15 13:00" in line
    tilt, rotation = (float(line.split(word)[1].split()[0]) for word in ("tilted by ", "turned by "))
    assert tilt == pytest.approx(0.02, abs=0.008)
    assert rotation == pytest.approx(0.01, abs=0.003)
    assert status.status(site)["moved"].startswith("scanner tilted")
