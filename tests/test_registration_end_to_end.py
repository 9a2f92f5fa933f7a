"""The owner's registration of each scan, with poses like those of a real station."""

import subprocess
import sys
from dataclasses import replace

import laspy
import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from station import open as open_series
from station.config import read_site
from station.inbox.journal_reader import JournalReader
from station.processing.staleness import late_inputs, plan_reprocessing
from station.simulation.scenario import small
from station.simulation.station import simulate

pytestmark = pytest.mark.integration

# Poses of a VZ-2000 at Kijkduin against its first scan: rotations [µrad], translation [mm].
# Source: github.com/tum-rsa/topo4d, examples, Apache-2.0.
POSES = (
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (70.16, -40.84, -4.14, 0.035, -1.598, 0.070),
    (421.73, -593.30, -67.03, 0.579, -5.302, -2.102),
    (84.18, -110.80, 30.52, -0.085, -0.149, -0.105),
)
REGISTRATION = """
[registration]
suffix = "-reg.txt"
into = "scanner"
use = "{use}"
sigma_m = 0.002
sigma_deg = 0.0005
"""


def matrix_of(pose):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", np.array(pose[:3]) * 1e-6).as_matrix()
    matrix[:3, 3] = np.array(pose[3:]) * 1e-3
    return matrix


@pytest.fixture(scope="module")
def stations(tmp_path_factory):
    """Return a function that simulates a station whose scanner moves, with matrices of a kind."""
    root = tmp_path_factory.mktemp("registered")

    def build(name, use, matrices):
        folder = root / name
        simulate(folder, replace(small(hours=4), avalanche_m=0.0, melt_m_per_h=0.0, reference_scans=2))
        if use:
            with (folder / "site.toml").open("a") as site:
                site.write(REGISTRATION.format(use=use))
        paths = sorted((folder / "inbox").glob("*.laz"))
        for path, pose, matrix in zip(paths, POSES, matrices, strict=True):
            las, back = laspy.read(path), np.linalg.inv(matrix_of(pose))
            if use:
                las.x, las.y, las.z = back[:3, :3] @ np.stack([las.x, las.y, las.z]) + back[:3, 3:]
                las.write(path)
                np.savetxt(path.with_name(f"{path.stem}-reg.txt"), matrix, fmt="%.12f")
        command = [sys.executable, "-m", "station", "process", folder / "site.toml", *paths]
        result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
        assert result.returncode == 0, result.stdout + result.stderr
        with xr.open_dataset(folder / "data" / "processing.nc") as processing:
            return open_series(folder / "data"), processing.load()

    return build


def test_registered_scans_are_placed_as_if_the_scanner_had_not_moved(stations):
    """All but the rounding of points to 0.25 mm, cells that a point at their edge leaves, and the log."""
    expected, _ = stations("still", "", [np.eye(4)] * 4)
    series, processing = stations("start", "start", [matrix_of(pose) for pose in POSES])
    assert (series["verdict"] == 0).all()
    same = (series["point_count"] == expected["point_count"]).to_numpy()
    assert same.mean() > 0.99
    difference_m = (series["elevation_change"] - expected["elevation_change"]).to_numpy()[same]
    assert np.nanmedian(np.abs(difference_m)) < 2e-3
    assert (processing["registration_rotation"] < 0.01).all()  # what the simulated mount does itself


def test_a_wrong_registration_that_is_given_differs_from_the_own_estimate(stations):
    series, processing = stations("wrong", "given", [np.eye(4)] * 4)
    expected_deg = np.degrees(np.linalg.norm(np.array(POSES[2][:3]) * 1e-6))
    assert float(processing["registration_rotation"][2]) == pytest.approx(expected_deg, rel=0.1)
    assert [str(value) for value in processing["adjustment"].values] == ["none"] * 4
    reasons = [str(value) for value in series["verdict_reason"].values]
    assert "registration differs by 0.04" in reasons[2]
    assert not any("registration differs" in reason for reason in reasons[:2])


def test_matrices_that_come_later_or_change_are_reasons_to_process_again(tmp_path):
    folder = tmp_path / "late"
    simulate(folder, replace(small(hours=1), reference_scans=1))
    with (folder / "site.toml").open("a") as file:
        file.write(REGISTRATION.format(use="start"))
    site, (scan,) = read_site(folder / "site.toml"), (folder / "inbox").glob("*.laz")
    command = [sys.executable, "-m", "station", "process", folder / "site.toml", scan]
    matrix = scan.with_name(f"{scan.stem}-reg.txt")

    def processed():
        result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
        assert result.returncode == 0, result.stdout + result.stderr
        with JournalReader(site.station.data / "journal.sqlite") as journal:
            return journal.rows()

    rows = processed()
    assert "registration missing: placed by the SOP" in rows[0].reason
    assert late_inputs(site, rows, lambda: None) == []
    matrix.write_text("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n")
    assert late_inputs(site, rows, lambda: None) == [scan.name]
    rows = processed()
    assert "registration unusable: placed by the SOP" in rows[0].reason
    assert "is a reflection" in rows[0].reason
    np.savetxt(matrix, np.eye(4))
    assert late_inputs(site, rows, lambda: None) == []
    (task,) = plan_reprocessing(site, rows, set(), (-np.inf, np.inf), lambda: None).tasks
    assert "other registration" in task.reasons
    assert processed()[0].verdict == "good"
