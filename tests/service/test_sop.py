"""`station sop`: solved on a map and off it, written for the site file, looked at."""

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
from station.readers.sop import read_matrix
from station.science import pose
from station.science.registration import Features, solve
from station.service.sop import describe_chain, describe_solution, known_scanner, show_sop, solve_sop

CRS = "EPSG:32632"
PLACE_M = np.array([635_000.0, 5_185_000.0, 3_000.0])
TURN = Rotation.from_euler("ZYX", [40.0, -31.0, 2.0], degrees=True).as_matrix()
HEAD = ["name", "x", "y", "z", "ref_x", "ref_y", "ref_z", "normal_x", "normal_y", "normal_z", "sigma"]


def surveyed(tmp_path, *, noise_m=0.0, planes=4):
    """Features up to 3 km away, their references on the map by PROJ alone; and in the level frame."""
    rng = np.random.default_rng(2)
    to_map = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84"
        f" +lon_0={LONGITUDE_DEG} +lat_0={LATITUDE_DEG} +h_0=3000"
        " +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=32 +ellps=WGS84"
    )
    azimuth, distance = rng.uniform(0, 2 * np.pi, 14), rng.uniform(300, 3000, 14)
    local = np.stack([distance * np.sin(azimuth), distance * np.cos(azimuth), rng.uniform(-600, 300, 14)], -1)
    scan = local @ TURN + noise_m * rng.normal(size=(14, 3))
    normal = rng.normal(size=(14, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    beside = local + 0.5 * np.cross(normal, rng.normal(size=(14, 3)))
    ends = [np.stack(to_map.transform(*one.T), axis=-1) for one in (local, beside, beside + normal)]
    path = tmp_path / "features.csv"
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(HEAD)
        for i in range(14):
            plane = i >= 14 - planes
            on_map, across = (ends[1][i], ends[2][i] - ends[1][i]) if plane else (ends[0][i], ["", "", ""])
            rows.writerow([f"f{i}", *scan[i], *on_map, *across, 0.02])
    at = np.arange(14) >= 14 - planes
    reference, normal = np.where(at[:, None], beside, local), normal * at[:, None]
    return path, Features(("f",) * 14, scan, reference, normal, np.full(14, 0.02))


LONGITUDE_DEG, LATITUDE_DEG, _ = Transformer.from_crs(CRS, "EPSG:4979", always_xy=True).transform(*PLACE_M)


def test_on_a_map(tmp_path):
    """It leads where the station's own way to the map leads, in curvature and scale too."""
    table, _ = surveyed(tmp_path)
    found = solve_sop(table, tmp_path / "sop.dat", None, CRS)
    sop = read_matrix(tmp_path / "sop.dat")
    assert sop[:3, 3] == pytest.approx(PLACE_M, abs=1e-4)
    frame = pose.frame_on_map(sop, CRS, 3500.0)
    grid_north = Proj(CRS).get_factors(LONGITUDE_DEG, LATITUDE_DEG).meridian_convergence
    turn = Rotation.from_euler("Z", grid_north, degrees=True).as_matrix() @ TURN
    assert frame.to_local[:3, :3] == pytest.approx(turn, abs=1e-7)
    assert found.chain.lean_deg == pytest.approx(np.degrees(np.arccos(TURN[2, 2])), abs=1e-5)
    assert found.observations == 10 * 3 + 4
    assert max(one.residual_m for one in found.features) < 2e-3
    assert "f13" in describe_solution(found)


def test_a_map_is_no_rigid_frame(tmp_path):
    """Without its name the same table leaves decimetres: curvature and scale."""
    table, _ = surveyed(tmp_path)
    found = solve_sop(table, tmp_path / "sop.dat", None, None)
    assert max(one.residual_m for one in found.features) > 0.1


def test_covariance_is_written_beside(tmp_path):
    table, level = surveyed(tmp_path, noise_m=0.02)
    found = solve_sop(table, tmp_path / "sop.dat", None, CRS)
    lines = (tmp_path / "sop-covariance.csv").read_text().splitlines()
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    names, values = rows[0][1:], np.array([row[1:] for row in rows[1:]], dtype=float)
    assert names == ["turn_east", "turn_north", "turn_up", "shift_east", "shift_north", "shift_up"]
    # As in the level frame, whose axes are turned by the map's convergence.
    convergence_deg = Proj(CRS).get_factors(LONGITUDE_DEG, LATITUDE_DEG).meridian_convergence
    turn = np.kron(np.eye(2), Rotation.from_euler("z", -convergence_deg, degrees=True).as_matrix())
    assert abs(convergence_deg) > 1
    assert values == pytest.approx(turn.T @ solve(level).covariance @ turn, rel=1e-5, abs=1e-14)
    assert values != pytest.approx(solve(level).covariance, rel=1e-2, abs=1e-14)
    assert np.sqrt(np.diag(values)[3:]) == pytest.approx(found.shift_sigma_m, rel=1e-6)
    assert np.degrees(np.sqrt(np.diag(values)[:3])) == pytest.approx(found.turn_sigma_deg, rel=1e-6)
    assert found.reference_variance == pytest.approx(1.0, abs=0.6)
    with pytest.raises(ConfigError, match=r"sop\.dat: is there already; nothing is overwritten"):
        solve_sop(table, tmp_path / "sop.dat", None, CRS)


def test_noise_of_the_scanner_is_added(tmp_path):
    """Of a VZ-6000: 10 mm along the beam, 0.12 mrad / 4 and 0.0008° across; by its range and beam."""
    table, level = surveyed(tmp_path, noise_m=0.02)
    found = solve_sop(table, tmp_path / "sop.dat", None, CRS, known_scanner("riegl-vz-6000"))
    range_m = np.linalg.norm(level.scan_m, axis=1, keepdims=True)
    beam = level.scan_m / range_m
    across_m2 = (range_m[:, :, None] * np.hypot(0.12e-3 / 4, np.radians(0.0008))) ** 2
    outer = beam[:, :, None] * beam[:, None, :]
    noise_m2 = 0.01**2 * outer + across_m2 * (np.eye(3) - outer)
    wanted = solve(replace(level, scan_covariance_m2=noise_m2))
    assert found.reference_variance == pytest.approx(wanted.reference_variance, rel=0.05)
    assert found.shift_sigma_m == pytest.approx(np.sqrt(np.diag(wanted.covariance))[3:], rel=0.03)
    with pytest.raises(ConfigError, match="--scanner vz: not known; take one of riegl-vz-6000"):
        known_scanner("vz")


@pytest.mark.parametrize("crs", ["EPSG:4326", "nonsense"])
def test_no_map(tmp_path, crs):
    table, _ = surveyed(tmp_path)
    with pytest.raises(ConfigError, match=f"--crs {crs}: "):
        solve_sop(table, tmp_path / "sop.dat", None, crs)
    assert not (tmp_path / "sop.dat").exists()


def test_show(tmp_path):
    """Place and lean through a POP made by PROJ; and how the next SOP differs."""
    pop = pose.tangent_frame(
        np.array(Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(10.8, 46.8, 3200.0))
    )
    one, other = np.eye(4), np.eye(4)
    one[:3, :3] = Rotation.from_euler("x", -30, degrees=True).as_matrix()  # leans towards north
    other[:3, :3] = Rotation.from_euler("z", 5, degrees=True).as_matrix() @ one[:3, :3]
    other[:3, 3] = (3.0, 4.0, 0.0)
    for name, matrix in (("pop", pop), ("one", one), ("other", other)):
        np.savetxt(tmp_path / f"{name}.dat", matrix, fmt="%.12f")
    told = show_sop([tmp_path / "one.dat", tmp_path / "other.dat"], tmp_path / "pop.dat", CRS)
    assert told[0].latitude_longitude_height == pytest.approx([46.8, 10.8, 3200.0], abs=1e-6)
    on_map = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(10.8, 46.8)
    assert told[0].map_m == pytest.approx([*on_map, 3200.0], abs=1e-3)
    assert (told[0].lean_deg, told[0].lean_towards_deg) == pytest.approx((30.0, 0.0), abs=1e-6)
    assert told[0].x_axis_azimuth_deg == pytest.approx(90.0)
    assert told[0].omega_phi_kappa_deg == pytest.approx([-30.0, 0.0, 0.0], abs=1e-6)
    assert told[0].differs is None
    assert told[1].lean_towards_deg == pytest.approx(355.0, abs=1e-3)
    assert told[1].differs.turned_deg == pytest.approx(5.0)
    axes = np.degrees(2 * np.arcsin(np.sin(np.radians(30)) * np.sin(np.radians(2.5))))
    assert told[1].differs.axis_turned_deg == pytest.approx(axes)
    assert told[1].differs.moved_m == pytest.approx(5.0)
    assert "turned 5.000°" in describe_chain(told[1])


def test_the_commands(tmp_path):
    table, _ = surveyed(tmp_path)

    def run(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "station.cli", "sop", *map(str, arguments)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip

    done = run("solve", table, "--out", tmp_path / "sop.dat", "--crs", CRS, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["observations"] == 34
    shown = run("show", tmp_path / "sop.dat", "--crs", CRS)
    assert "scanner at       635000.000 5185000.000 3000.000" in shown.stdout
    again = run("solve", table, "--out", tmp_path / "sop.dat", "--crs", CRS)
    assert (again.returncode, again.stdout) == (78, "")
    assert "nothing is overwritten" in again.stderr


def test_real_matrices(shared_data):
    """Mammoth's seasons differ by 0.35° and 2.82°, and the mount leans by 33.8°."""
    seasons = ["2020-2021", "2021-2022", "2023-2024"]
    files = [shared_data / f"mammoth/{season}-SOP.dat" for season in seasons]
    told = show_sop(files, shared_data / "mammoth/2023-2024-POP.dat", None)
    assert told[1].differs.turned_deg == pytest.approx(0.35, abs=0.01)
    assert told[2].differs.turned_deg == pytest.approx(2.82, abs=0.01)
    assert told[2].lean_deg == pytest.approx(33.8, abs=0.1)
    assert told[2].latitude_longitude_height[:2] == pytest.approx([37.64, -119.03], abs=0.01)
