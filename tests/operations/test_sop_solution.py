"""`station sop`: solution on a map and in a local frame, its files, and the pose under given SOPs."""

import csv
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from pyproj import Proj, Transformer
from scipy.spatial.transform import Rotation

from station.errors import ConfigError
from station.operations.sop_solution import (
    format_pose,
    format_solution,
    scanner_by_model,
    solve_sop,
    summarise_sops,
)
from station.readers.sop import read_matrix
from station.science.geometry import pose
from station.science.geometry.registration import Features, solve

CRS = "EPSG:32632"
POSITION_M = np.array([635_000.0, 5_185_000.0, 3_000.0])
ROTATION = Rotation.from_euler("ZYX", [40.0, -31.0, 2.0], degrees=True).as_matrix()
HEAD = ["name", "x", "y", "z", "ref_x", "ref_y", "ref_z", "normal_x", "normal_y", "normal_z", "sigma"]


def write_features(tmp_path, *, noise_m=0.0, planes=4):
    """Write a table of 14 features up to 3 km away; return its path and the features in the level frame.

    PROJ alone transforms their references to the map.
    """
    rng = np.random.default_rng(2)
    to_map = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84"
        f" +lon_0={LONGITUDE_DEG} +lat_0={LATITUDE_DEG} +h_0=3000"
        " +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=32 +ellps=WGS84"
    )
    azimuth, distance = rng.uniform(0, 2 * np.pi, 14), rng.uniform(300, 3000, 14)
    local = np.stack([distance * np.sin(azimuth), distance * np.cos(azimuth), rng.uniform(-600, 300, 14)], -1)
    scan = local @ ROTATION + noise_m * rng.normal(size=(14, 3))
    normal = rng.normal(size=(14, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    on_plane = local + 0.5 * np.cross(normal, rng.normal(size=(14, 3)))
    point, foot, tip = (
        np.stack(to_map.transform(*points.T), axis=-1) for points in (local, on_plane, on_plane + normal)
    )
    path = tmp_path / "features.csv"
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(HEAD)
        for i in range(14):
            if i >= 14 - planes:
                table.writerow([f"f{i}", *scan[i], *foot[i], *(tip[i] - foot[i]), 0.02])
            else:
                table.writerow([f"f{i}", *scan[i], *point[i], "", "", "", 0.02])
    is_plane = (np.arange(14) >= 14 - planes)[:, None]
    reference, normal = np.where(is_plane, on_plane, local), normal * is_plane
    return path, Features(("f",) * 14, scan, reference, normal, np.full(14, 0.02))


LONGITUDE_DEG, LATITUDE_DEG, _ = Transformer.from_crs(CRS, "EPSG:4979", always_xy=True).transform(*POSITION_M)


def test_solution_on_a_map_agrees_with_the_transformation_of_scans(tmp_path):
    """Curvature and scale of the map are included."""
    table, _ = write_features(tmp_path)
    solution = solve_sop(table, tmp_path / "sop.dat", None, CRS)
    sop = read_matrix(tmp_path / "sop.dat")
    assert sop[:3, 3] == pytest.approx(POSITION_M, abs=1e-4)
    frame = pose.scanner_to_map_directly(sop, CRS, 3500.0)
    grid_north = Proj(CRS).get_factors(LONGITUDE_DEG, LATITUDE_DEG).meridian_convergence
    rotation = Rotation.from_euler("Z", grid_north, degrees=True).as_matrix() @ ROTATION
    assert frame.to_local[:3, :3] == pytest.approx(rotation, abs=1e-7)
    assert solution.pose.tilt_deg == pytest.approx(np.degrees(np.arccos(ROTATION[2, 2])), abs=1e-5)
    assert solution.observations == 10 * 3 + 4
    assert max(feature.residual_m for feature in solution.features) < 2e-3
    assert "f13" in format_solution(solution)


def test_map_taken_for_a_local_frame_has_residuals_of_decimetres(tmp_path):
    """They are the curvature and scale of the map."""
    table, _ = write_features(tmp_path)
    solution = solve_sop(table, tmp_path / "sop.dat", None, None)
    assert max(feature.residual_m for feature in solution.features) > 0.1


def test_covariance_is_written_next_to_the_sop(tmp_path):
    table, level = write_features(tmp_path, noise_m=0.02)
    solution = solve_sop(table, tmp_path / "sop.dat", None, CRS)
    lines = (tmp_path / "sop-covariance.csv").read_text().splitlines()
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    names, values = rows[0][1:], np.array([row[1:] for row in rows[1:]], dtype=float)
    assert names == ["turn_east", "turn_north", "turn_up", "shift_east", "shift_north", "shift_up"]
    # That of the level frame, rotated by the convergence of the map.
    convergence_deg = Proj(CRS).get_factors(LONGITUDE_DEG, LATITUDE_DEG).meridian_convergence
    rotation = np.kron(np.eye(2), Rotation.from_euler("z", -convergence_deg, degrees=True).as_matrix())
    assert abs(convergence_deg) > 1
    assert values == pytest.approx(rotation.T @ solve(level).covariance @ rotation, rel=1e-5, abs=1e-14)
    assert values != pytest.approx(solve(level).covariance, rel=1e-2, abs=1e-14)
    assert np.sqrt(np.diag(values)[3:]) == pytest.approx(solution.shift_sigma_m, rel=1e-6)
    assert np.degrees(np.sqrt(np.diag(values)[:3])) == pytest.approx(solution.rotation_sigma_deg, rel=1e-6)
    assert solution.reference_variance == pytest.approx(1.0, abs=0.6)
    with pytest.raises(ConfigError, match=r"sop\.dat: already exists; nothing is overwritten"):
        solve_sop(table, tmp_path / "sop.dat", None, CRS)


def test_scanner_noise_is_added(tmp_path):
    """VZ-6000: 10 mm along the beam; 0.12 mrad / 4 and 0.0008° across it, times the range."""
    table, level = write_features(tmp_path, noise_m=0.02)
    solution = solve_sop(table, tmp_path / "sop.dat", None, CRS, scanner_by_model("riegl-vz-6000"))
    range_m = np.linalg.norm(level.scan_m, axis=1, keepdims=True)
    beam = level.scan_m / range_m
    across_m2 = (range_m[:, :, None] * np.hypot(0.12e-3 / 4, np.radians(0.0008))) ** 2
    outer = beam[:, :, None] * beam[:, None, :]
    noise_m2 = 0.01**2 * outer + across_m2 * (np.eye(3) - outer)
    expected = solve(replace(level, scan_covariance_m2=noise_m2))
    assert solution.reference_variance == pytest.approx(expected.reference_variance, rel=0.05)
    assert solution.shift_sigma_m == pytest.approx(np.sqrt(np.diag(expected.covariance))[3:], rel=0.03)
    with pytest.raises(ConfigError, match="--scanner vz: unknown; choose one of riegl-vz-6000"):
        scanner_by_model("vz")


@pytest.mark.parametrize("crs", ["EPSG:4326", "nonsense"])
def test_unusable_crs_raises_config_error(tmp_path, crs):
    table, _ = write_features(tmp_path)
    with pytest.raises(ConfigError, match=f"--crs {crs}: "):
        solve_sop(table, tmp_path / "sop.dat", None, crs)
    assert not (tmp_path / "sop.dat").exists()


def test_pose_under_two_sops_and_their_difference(tmp_path):
    """Position and tilt through a POP computed by PROJ."""
    pop = pose.tangent_frame(
        np.array(Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(10.8, 46.8, 3200.0))
    )
    first, second = np.eye(4), np.eye(4)
    first[:3, :3] = Rotation.from_euler("x", -30, degrees=True).as_matrix()  # tilted towards north
    second[:3, :3] = Rotation.from_euler("z", 5, degrees=True).as_matrix() @ first[:3, :3]
    second[:3, 3] = (3.0, 4.0, 0.0)
    for name, matrix in (("pop", pop), ("first", first), ("second", second)):
        np.savetxt(tmp_path / f"{name}.dat", matrix, fmt="%.12f")
    poses = summarise_sops([tmp_path / "first.dat", tmp_path / "second.dat"], tmp_path / "pop.dat", CRS)
    assert poses[0].latitude_longitude_height == pytest.approx([46.8, 10.8, 3200.0], abs=1e-6)
    on_map = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(10.8, 46.8)
    assert poses[0].map_m == pytest.approx([*on_map, 3200.0], abs=1e-3)
    assert (poses[0].tilt_deg, poses[0].tilt_azimuth_deg) == pytest.approx((30.0, 0.0), abs=1e-6)
    assert poses[0].x_axis_azimuth_deg == pytest.approx(90.0)
    assert poses[0].omega_phi_kappa_deg == pytest.approx([-30.0, 0.0, 0.0], abs=1e-6)
    assert poses[0].difference is None
    assert poses[1].tilt_azimuth_deg == pytest.approx(355.0, abs=1e-3)
    assert poses[1].difference.rotation_deg == pytest.approx(5.0)
    axis_rotation_deg = np.degrees(2 * np.arcsin(np.sin(np.radians(30)) * np.sin(np.radians(2.5))))
    assert poses[1].difference.axis_rotation_deg == pytest.approx(axis_rotation_deg)
    assert poses[1].difference.shift_m == pytest.approx(5.0)
    assert "rotated 5.000°" in format_pose(poses[1])


@pytest.mark.integration
def test_commands_solve_and_show(tmp_path):
    table, _ = write_features(tmp_path)

    def run(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "station", "sop", *map(str, arguments)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip

    solved = run("solve", table, "--out", tmp_path / "sop.dat", "--crs", CRS, "--json")
    assert solved.returncode == 0, solved.stderr
    assert json.loads(solved.stdout)["observations"] == 34
    shown = run("show", tmp_path / "sop.dat", "--crs", CRS)
    assert "scanner at       635000.000 5185000.000 3000.000" in shown.stdout
    repeated = run("solve", table, "--out", tmp_path / "sop.dat", "--crs", CRS)
    assert (repeated.returncode, repeated.stdout) == (78, "")
    assert "nothing is overwritten" in repeated.stderr


def test_poses_of_mammoth_mountain(shared_data):
    """The seasons differ by 0.35° and 2.82°, and the mount is tilted by 33.8°."""
    seasons = ["2020-2021", "2021-2022", "2023-2024"]
    files = [shared_data / f"mammoth/{season}-SOP.dat" for season in seasons]
    poses = summarise_sops(files, shared_data / "mammoth/2023-2024-POP.dat", None)
    assert poses[1].difference.rotation_deg == pytest.approx(0.35, abs=0.01)
    assert poses[2].difference.rotation_deg == pytest.approx(2.82, abs=0.01)
    assert poses[2].tilt_deg == pytest.approx(33.8, abs=0.1)
    assert poses[2].latitude_longitude_height[:2] == pytest.approx([37.64, -119.03], abs=0.01)
