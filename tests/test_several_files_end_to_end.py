"""From folders of tiles and scan positions to the series, by the lines of docs/how-to/your-own-files.md."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import laspy
import numpy as np
import pytest
import xarray as xr
from support import tiny_station

from station import open as open_series
from station.simulation.scenario import small
from station.simulation.station import simulate

pytestmark = pytest.mark.integration

TILES = 3
DAY = "2025-07-15 Hütte Süd"  # names are of any language, and may have spaces
COMPARED = ("point_count", "elevation", "elevation_change", "elevation_change_uncertainty")
CELL_M, SIZE_M, COUNT = 0.5, 10.0, 20_000
RANGE_SIGMA_M = {"first": 0.003, "Säule 2": 0.3}
SITE = """
[station]
id = "positions"
data = "data"
[scans]
inbox = "inbox"
name = "%Y-%m-%d Hütte Süd/ScanPos*"
settle_s = 0
[epoch]
name = "%Y-%m-%d"
files = 2
[[sop]]
from = 2025-01-01T00:00:00Z
file = "first.txt"
files = "*/ScanPos001*"
[[sop]]
from = 2025-01-01T00:00:00Z
file = "Säule 2.txt"
files = "*/ScanPos002*"
scanner = { model = "riegl-vz-1000", range_sigma_m = 0.3 }
[scanner]
model = "riegl-vz-400i"
[grid]
bounds_m = { west = 0, south = 0, east = 10, north = 10 }
cell_m = 0.5
[adjustment]
method = "none"
"""


def station(*arguments):
    return subprocess.run([sys.executable, "-m", "station", *map(str, arguments)],
                          capture_output=True, text=True, check=False, timeout=600)  # fmt: skip


def tiled(folder, *, method="joint", hours=3):
    """Return a simulated station whose scans wait as tiles, each with a third of the lines, in a folder."""
    tiny_station.build(folder, method=method, hours=hours)
    text = (folder / "site.toml").read_text()
    text = re.sub(r'name = "%y%m%d_%H%M%S".*', 'name = "%Y-%m-%d Hütte Süd/*_%H%M%S_*"', text)
    text += '\n[epoch]\nname = "%y%m%d_%H%M%S"\nfiles = 3\nwait_s = 3600\n'
    (folder / "site.toml").write_text(text)
    day = folder / tiny_station.PENDING / DAY
    day.mkdir()
    for path in sorted((folder / tiny_station.PENDING).glob("*.laz")):
        whole = laspy.read(path)
        order = np.argsort(whole.gps_time, kind="stable")
        for number, indices in enumerate(np.array_split(order, TILES)):
            tile = laspy.LasData(whole.header, whole.points[np.sort(indices)])
            tile.write(day / f"{path.stem}_{number}.laz")
        path.with_name(f"{path.stem}-incl.txt").rename(day / f"{path.stem}_1-incl.txt")
        path.unlink()
    return folder


def deliver(folder):
    """Move all tiles into the inbox; return them."""
    day = folder / "inbox" / DAY
    (folder / tiny_station.PENDING / DAY).rename(day)
    return sorted(day.glob("*.laz"))


def without_log(folder):
    path = folder / "site.toml"
    path.write_text(re.sub(r"\[inclination\]\n(?:[^\[\n].*\n|\n)*", "", path.read_text()))
    return folder


@pytest.mark.parametrize("has_log", [False, True])
def test_tiles_of_a_scan_are_measured_as_the_whole_scan(tmp_path, has_log):
    """Without a log to the quantum; a log is laid over other samples of the head's azimuth."""
    whole = tiny_station.build(tmp_path / "whole", method="joint", hours=3)
    folder = tiled(tmp_path / "tiles")
    for path in (whole / tiny_station.PENDING).iterdir():
        path.rename(whole / "inbox" / path.name)
    scans = {whole: sorted((whole / "inbox").glob("*.laz")), folder: deliver(folder)}
    for site, files in scans.items():
        result = station("process", (site if has_log else without_log(site)) / "site.toml", *files)
        assert result.returncode == 0, result.stdout + result.stderr
    expected, actual = open_series(whole / "data"), open_series(folder / "data")
    assert [str(name) for name in actual.scan_id.values] == [str(name) for name in expected.scan_id.values]
    assert np.isfinite(expected["elevation_change"]).any()
    np.testing.assert_array_equal(actual["verdict"], expected["verdict"])
    if not has_log:
        np.testing.assert_array_equal(actual["point_count"], expected["point_count"])
        for name in ("elevation_change_uncertainty", "elevation_change"):
            np.testing.assert_allclose(actual[name], expected[name], rtol=0, atol=2**-10)
        return
    same = (actual["point_count"] == expected["point_count"]).to_numpy()
    assert same.mean() > 0.995  # a point on the edge of a cell
    for name in ("elevation_change_uncertainty", "elevation_change"):
        difference_m = (actual[name] - expected[name]).to_numpy()[same]
        sigma_m = expected["elevation_change_uncertainty"].to_numpy()[same]
        step_m = sigma_m / 4  # of stored values, at most: the two may be rounded to different sides
        assert np.nanmax(np.abs(difference_m) - step_m) < 0.02
        assert np.sqrt(np.nanmean((difference_m / sigma_m) ** 2)) < 0.05


def test_live_epochs_of_a_killed_service_are_those_of_one_run(tmp_path):
    """Tiles arrive in any order while the service is killed; copies and touched files change nothing."""
    expected = tiled(tmp_path / "expected", hours=4)
    assert station("process", expected / "site.toml", *deliver(expected)).returncode == 0
    live, random = tiled(tmp_path / "live", hours=4), np.random.default_rng(5)
    pending = live / tiny_station.PENDING / DAY
    day = live / "inbox" / DAY
    day.mkdir()
    arrivals = sorted(path for path in pending.iterdir() if path.suffix == ".laz")
    for log in pending.glob("*.txt"):
        log.rename(day / log.name)
    # Scans in their order, each tile in any: a reference is made of the first scans that are complete.
    order = [3 * scan + tile for scan in range(4) for tile in random.permutation(TILES)]
    service = None
    for step, index in enumerate(order):
        if service is None:
            service = start(live)
        arrivals[index].rename(day / arrivals[index].name)
        time.sleep(random.uniform(0.2, 1.5))
        if step % 4 == 3:
            service.send_signal(signal.SIGKILL)
            service.wait()
            service = None
    service = start(live)
    try:
        wait_for(lambda: stored(live) == 4 and changes(live) == 4, live)
        files = sorted(path.name for path in (live / "data" / "epochs").rglob("*.nc"))
        (day / "250715_010000_copy.laz").write_bytes((day / "250715_010000_0.laz").read_bytes())
        os.utime(day / "250715_020000_1.laz")
        wait_for(lambda: (live / "log").read_text().count("verdict=same") == 2, live)
        assert files == sorted(path.name for path in (live / "data" / "epochs").rglob("*.nc"))
    finally:
        service.send_signal(signal.SIGTERM)
        service.wait()
    one, other = open_series(expected / "data"), open_series(live / "data")
    for name in COMPARED:
        np.testing.assert_array_equal(one[name], other[name], name)


def start(folder):
    with (folder / "log").open("a") as log:
        return subprocess.Popen([sys.executable, "-m", "station", "run", folder / "site.toml"], stderr=log)


def stored(folder):
    path = folder / "data" / "series.nc"
    return open_series(folder / "data").sizes["time"] if path.exists() else 0


def changes(folder):
    return int(np.isfinite(open_series(folder / "data")["elevation_change"]).any(("y", "x")).sum())


def wait_for(condition, folder, seconds=180):
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        try:
            if condition():
                return
        except (OSError, ValueError, KeyError):
            pass  # it is being written
        time.sleep(0.2)
    raise AssertionError((folder / "log").read_text()[-3000:])


def sop(yaw_deg, x_m, y_m, z_m):
    s, c = np.sin(np.radians(yaw_deg)), np.cos(np.radians(yaw_deg))
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, z_m], [0, 0, 0, 1.0]])


SHIFT = sop(12.0, 1.0, -2.0, 0.5)


@pytest.mark.parametrize("into", ["", "project", "scanner"])
def test_scan_positions_are_placed_by_their_sops(tmp_path, into):
    """Counts are exact and means right to the storage quantum, by an own transformation with numpy.

    With `into` they are placed by matrices beside the scans, in the frame that it states. Random sigma is
    that of two instruments, of which each saw its part of the shots of a cell.
    """
    random = np.random.default_rng(3)
    sops = {"first": sop(30.0, -4.0, -3.0, 2.0), "Säule 2": sop(-75.0, 14.0, 12.0, 1.5)}
    day = tmp_path / "inbox" / DAY
    day.mkdir(parents=True)
    on_map, variance_m2 = [], []
    for number, (name, matrix) in enumerate(sops.items(), start=1):
        of_file = sop(0.0, 0.0, 0.0, 0.0) if into else matrix
        np.savetxt(tmp_path / f"{name}.txt", of_file if into != "scanner" else SHIFT, fmt="%.12f")
        if into:
            beside = matrix if into == "project" else np.linalg.inv(SHIFT) @ matrix
            np.savetxt(day / f"ScanPos{number:03d}.dat", beside, fmt="%.12f")
        x_m, y_m = random.uniform(0.01, SIZE_M - 0.01, (2, COUNT))
        z_m = 0.3 * np.sin(x_m / 4) + 0.1 * y_m + random.normal(0, 0.005, COUNT)
        points_m = np.stack([x_m, y_m, z_m])
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales = [0.0001] * 3
        scan = laspy.LasData(header)
        scan.x, scan.y, scan.z = matrix[:3, :3].T @ (points_m - matrix[:3, 3:])
        scan.return_number, scan.number_of_returns = np.ones((2, COUNT), np.uint8)
        scan.write(day / f"ScanPos{number:03d}.laz")
        stored_m = np.stack([scan.x, scan.y, scan.z])
        on_map.append(matrix[:3, :3] @ stored_m + matrix[:3, 3:])
        slope = np.stack([-0.075 * np.cos(x_m / 4), np.full(COUNT, -0.1), np.ones(COUNT)])
        range_m = np.linalg.norm(stored_m, axis=0)
        along = ((matrix[:3, :3] @ stored_m) / range_m * slope).sum(axis=0)  # height by meter of range
        sampling_m2 = CELL_M**2 * (slope[:2] ** 2).sum(axis=0) / 12
        variance_m2.append((RANGE_SIGMA_M[name] * along) ** 2 + sampling_m2)
    section = f'[registration]\nsuffix = ".dat"\ninto = "{into}"\nsigma_m = 0.01\nsigma_deg = 0.001\n'
    (tmp_path / "site.toml").write_text(SITE + (section if into else ""))
    result = station("process", tmp_path / "site.toml", *day.glob("*.laz"))
    assert result.returncode == 0, result.stdout + result.stderr
    points_m = np.hstack(on_map)
    column, row = (points_m[:2] / CELL_M).astype(int)
    shape = round(SIZE_M / CELL_M), round(SIZE_M / CELL_M)
    cell = (shape[0] - 1 - row) * shape[1] + column
    count = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)
    mean_m = np.bincount(cell, points_m[2], shape[0] * shape[1]).reshape(shape) / count
    with xr.open_dataset(next((tmp_path / "data" / "epochs").rglob("*.nc"))) as epoch:
        stored = epoch.isel(time=0) if "time" in epoch.dims else epoch
        np.testing.assert_array_equal(stored["point_count"], count)
        total_m, systematic_m = (
            stored[f"elevation_change{part}_uncertainty"].to_numpy() for part in ("", "_systematic")
        )
        rounding_m = np.sqrt(total_m**2 - systematic_m**2) / 8 * (1 + 1 / 32) + 2**-13
        height_error_m = np.abs(stored["elevation_outside_reference"].to_numpy() - mean_m)
        assert (height_error_m <= rounding_m).all()
        assert float(stored["point_total"]) == 2 * COUNT
        expected_m2 = np.bincount(cell, np.hstack(variance_m2)).reshape(shape) / count**2
        assert np.median((total_m**2 - systematic_m**2) / expected_m2) == pytest.approx(1.0, abs=0.05)
        assert "2025-07-15" in str(stored["scan_id"].values)


def test_a_corrupt_tile_sets_its_epoch_aside_and_no_other(tmp_path):
    """Not even if the SOP was solved from it: the others lack its tilt then, and say so."""
    folder = tiled(tmp_path / "cut", method="none")
    tiles = deliver(folder)
    tiles[1].write_bytes(tiles[1].read_bytes()[:3000])
    tiles[3].unlink()
    result = station("process", folder / "site.toml", *tiles[:3], *tiles[4:])
    assert result.returncode == 3, result.stdout + result.stderr
    assert f"250715_000000: set aside: {DAY}/{tiles[1].name}: cut off or corrupt" in result.stdout
    assert "250715_010000: degraded (2 of 3 files of the epoch" in result.stdout
    assert "250715_020000: degraded (log of 250715_000000, the scan of the SOP, not usable" in result.stdout
    assert (folder / "data" / "set_aside" / "250715_000000.txt").is_file()


def test_two_positions_are_adjusted_as_the_one_scan_that_they_are_halves_of(tmp_path):
    """The second half of each scan, seen from a scanner that stands elsewhere and looks elsewhere."""
    whole = tmp_path / "whole"
    simulate(whole, replace(small(hours=3), reference_scans=2))
    halves = shutil.copytree(without_log(whole), tmp_path / "halves")
    between = sop(63.0, 3.0, -2.0, 1.0)
    np.savetxt(halves / "sop2.dat", np.loadtxt(halves / "sop.dat") @ between, fmt="%.14f")
    text = (halves / "site.toml").read_text().replace('name = "%y%m%d_%H%M%S"', 'name = "%y%m%d_%H%M%S_*"')
    section = re.sub(r"scan = .*\n", "", re.search(r"\[\[sop\]\]\n(?:[^\[\n].*\n)*", text)[0])
    both = f'{section}files = "*_A*"\n' + section.replace("sop.dat", "sop2.dat") + 'files = "*_B*"\n'
    text = re.sub(r"\[\[sop\]\]\n(?:[^\[\n].*\n)*", lambda _: both, text)
    (halves / "site.toml").write_text(f'{text}\n[epoch]\nname = "%y%m%d_%H%M%S"\nfiles = 2\n')
    back = np.linalg.inv(between)
    for path in sorted((halves / "inbox").glob("*.laz")):
        scan = laspy.read(path)
        is_second = np.arange(len(scan.points)) >= len(scan.points) // 2
        for letter, chosen in (("A", ~is_second), ("B", is_second)):
            half = laspy.LasData(scan.header, scan.points[chosen])
            if letter == "B":
                half.x, half.y, half.z = back[:3, :3] @ np.stack([half.x, half.y, half.z]) + back[:3, 3:]
            half.write(path.with_name(f"{path.stem}_{letter}.laz"))
        path.unlink()
    for site in (whole, halves):
        result = station("process", site / "site.toml", *sorted((site / "inbox").glob("*.laz")))
        assert result.returncode == 0, result.stdout + result.stderr
    expected, actual = open_series(whole / "data"), open_series(halves / "data")
    assert (actual["verdict"] == 0).all()
    counts = actual["point_count"].to_numpy() == expected["point_count"].to_numpy()
    assert counts.mean() > 0.9995  # a point on the edge of a cell, rounded to 0.25 mm in another frame
    difference_m = (actual["elevation_change"].to_numpy() - expected["elevation_change"].to_numpy())[counts]
    sigma_m = expected["elevation_change_uncertainty"].to_numpy()[counts]
    assert np.isfinite(difference_m).sum() > 20_000
    assert np.nanstd(difference_m) < 0.006
    assert np.nanstd(difference_m / sigma_m) < 0.25


def test_sigma_contains_the_errors_of_positions_against_each_other(tmp_path):
    """The same files as tiles of one position, and as three positions.

    They did not move against each other: sigma counts less than the usual 0.008 degree, and not none.
    """
    sigma_rad = []
    for name in ("tiles", "positions"):
        folder = without_log(tiled(tmp_path / name))
        if name == "positions":
            path = folder / "site.toml"
            entry = re.search(r"\[\[sop\]\]\n(?:[^\[\n].*\n|\n)*", path.read_text())[0]
            entries = []
            for number in range(TILES):
                shutil.copy(folder / "sop.dat", folder / f"sop{number}.dat")
                files = f'file = "sop{number}.dat"\nfiles = "*_{number}.laz"'
                entries.append(re.sub(r"scan = .*", "", entry.replace('file = "sop.dat"', files)))
            path.write_text(path.read_text().replace(entry, "".join(entries)))
        result = station("process", folder / "site.toml", *deliver(folder))
        assert result.returncode == 0, result.stdout + result.stderr
        last = max((folder / "data" / "epochs").rglob("*.nc"))
        with xr.open_dataset(last) as epoch:
            covariance = np.squeeze(epoch["shared_parameter_covariance"].to_numpy())
        sigma_rad.append(np.sqrt(covariance[0, 0]))
    added_rad = np.sqrt(sigma_rad[1] ** 2 - sigma_rad[0] ** 2)
    # Each third is seen by one of three, and by one of three in the two scans of the reference.
    assert 0.2 < np.degrees(added_rad) / (0.008 * np.sqrt(2 / 3 * (1 + 1 / 2))) < 0.8  # equations.md, 6.13
