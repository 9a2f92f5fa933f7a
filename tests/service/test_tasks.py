"""What a scan gets that lacks something: a verdict with reasons, a larger sigma, or a place aside."""

import os
import re
import shutil
from dataclasses import replace

import laspy
import netCDF4
import numpy as np
import pytest

from station.config import read_site
from station.errors import ConfigError, NotReadyError, ScanError
from station.pipeline import to_map
from station.readers.scan import utc_interval
from station.science.shared import LINES_A_KNOT
from station.service import references, tasks
from station.service.gather import gather
from station.service.places import arrival_of
from station.simulation.motion import sensor_faults
from station.simulation.station import simulate, tiny

SCENARIO = replace(tiny(hours=2), avalanche_m=0.0, melt_m_per_h=0.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "station"
    simulate(folder, SCENARIO)
    return folder


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "station")


def site_of(folder, *changes):
    path = folder / "site.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return read_site(path)


def processed(folder, *changes, scan=1, **how):
    """Outcome of one scan, and the standard deviation of the lean it is left with."""
    site = site_of(folder, *changes)
    scans = sorted(site.scans.inbox.glob("*.laz"))
    outcome = tasks.process(site, arrival_of(site, scans[scan]), lambda: None, **how)
    with netCDF4.Dataset(site.station.data / outcome.epoch) as file:
        variance = np.diagonal(file["shared_parameter_covariance"][0])
    return outcome, np.sqrt(variance)


def log_of(folder, scan=1):
    return sorted((folder / "inbox").glob("*-incl.txt"))[scan]


def test_all_there_is_good(folder):
    outcome, _ = processed(folder)
    assert (outcome.verdict, outcome.reason) == ("good", "")


def test_lines_are_passed_when_their_shots_were_taken(folder):
    """Though true north lies 1.3° beside grid north, which the head passes in 2.6 s here."""
    site = site_of(folder)
    scan = arrival_of(site, min(site.scans.inbox.glob("*.laz")))
    with tasks.opened(site, scan.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        found = gather(site, reader, scan.log, start, end)
        shots = next(iter(reader.blocks()))
    points = to_map(shots, found.pose)
    offset_m = tuple(axis - at for axis, at in zip(points, found.setup.position_m, strict=True))
    far = np.hypot(*offset_m[:2]) > 200
    line = (found.told.of.knots_before(offset_m)[far] * LINES_A_KNOT).astype(int)
    late_s = found.told.lines.time_s[line] - shots.time_s[far]
    assert abs(np.median(late_s)) < 0.3
    assert np.quantile(np.abs(late_s), 0.95) < 1.0


def test_no_log(folder):
    _, with_log = processed(folder)
    log_of(folder).unlink()
    outcome, without = processed(folder)
    assert outcome.verdict == "degraded"
    assert "inclination log missing" in outcome.reason
    assert without[0] > 3 * with_log[0]


def change_log(folder, change):
    path = log_of(folder)
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *change(rows)]) + "\n")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[: len(rows) // 2], "inclination log covers"),
        (lambda rows: rows[:100] + rows[180:], "has a gap of"),
        (lambda rows: ["x,y,z"] * 100 + rows[100:], "rows dropped"),
        (lambda rows: rows[:5], "good rows"),
        (
            lambda rows: [f"{float(r.split(',')[0]) + 90000},{r.split(',', 1)[1]}" for r in rows],
            "another time",
        ),
        (lambda rows: ["?"] * len(rows), "inclination log unusable"),
        (
            lambda rows: [f"{float(r.split(',')[0]) + 30},{r.split(',', 1)[1]}" for r in rows],
            "inclination log covers",
        ),
        (
            lambda rows: [f"{row.split(',')[0]},10.0,-1.3" if n % 3 else row for n, row in enumerate(rows)],
            "lean out of the inclination sensor's range of 10 degree in 67% of its log",
        ),
    ],
    ids=["short", "gap", "bad rows", "few", "other time", "unreadable", "half a minute late", "pegged"],
)
def test_a_poor_log(folder, change, says):
    change_log(folder, change)
    outcome, _ = processed(folder)
    assert outcome.verdict == "degraded"
    assert says in outcome.reason


def test_spikes_in_the_log_do_no_harm(folder):
    good, _ = processed(folder)
    rows = log_of(folder).read_text().splitlines()
    for row in range(20, len(rows), 40):
        rows[row] = rows[row].split(",")[0] + ",9.999,-9.999"
    log_of(folder).write_text("\n".join(rows) + "\n")
    spiked, _ = processed(folder)
    assert spiked.verdict == "good"
    assert spiked.figures["sigma_median_m"] == pytest.approx(good.figures["sigma_median_m"], rel=0.05)


def test_a_station_that_asks_for_no_log_lacks_none(folder):
    """Nor one whose mount leans farther than the sensor reaches, as at Mammoth Mountain."""
    change_log(folder, lambda rows: [f"{row.split(',')[0]},-10.0,10.0" for row in rows])
    outcome, _ = processed(folder, ("required = true", "required = false"))
    assert outcome.verdict == "good"
    log_of(folder).unlink()
    outcome, _ = processed(folder)
    assert outcome.verdict == "good"


def test_a_clock_that_is_off_is_told_where_the_mount_tells_it(folder):
    """Waves of 4° as a leaning mount shows them: the clock of the second log is 6 s late."""
    turn = np.radians(np.linspace(97, 245, 10_000))
    for scan, late_s in ((0, 0.0), (1, 6.0)):
        path = log_of(folder, scan)
        head, *rows = path.read_text().splitlines()
        time_s, roll, pitch = np.array([[float(v) for v in row.split(",")] for row in rows]).T
        share = (time_s - time_s[0] - 6) / 300  # the log begins 6 s before the scan
        azimuth_rad = np.interp(share, np.linspace(0, 1, len(turn)), turn)
        roll, pitch = roll + 4 * np.cos(azimuth_rad), pitch + 4 * np.sin(azimuth_rad)
        rows = [f"{t + late_s:.4f},{r:.3f},{p:.3f}" for t, r, p in zip(time_s, roll, pitch, strict=True)]
        path.write_text("\n".join([head, *rows]) + "\n")
    outcome, _ = processed(folder)
    assert outcome.verdict == "degraded"
    told = re.search(r"clock of the inclination log ([+-][\d.]+) s off, known to ([\d.]+) s", outcome.reason)
    clocks = [sensor_faults(SCENARIO, scan).clock_s for scan in (0, 1)]
    assert float(told[1]) == pytest.approx(6 + clocks[1] - clocks[0], abs=0.6)
    assert float(told[2]) < 0.5


def test_no_weather_and_waiting_for_it(folder):
    (folder / "weather.dat").unlink()
    outcome, without = processed(folder)
    assert outcome.verdict == "degraded"
    assert "weather" in outcome.reason
    assert without[7] == pytest.approx(4.0)  # ppm of the range, against 0.8 with weather
    with pytest.raises(NotReadyError, match="weather"):
        processed(folder, patient=True)
    for path in (folder / "inbox").iterdir():
        os.utime(path, (1.7e9, 1.7e9))  # it came long ago
    assert processed(folder, patient=True)[0].verdict == "degraded"


@pytest.mark.parametrize(
    ("keep", "verdict", "says"),
    [
        (lambda away_m, _: away_m < 400, "degraded", "nothing beyond 400 m: fog"),
        (lambda away_m, _: away_m < 125, "unusable", "of what scans usually see"),
        (lambda _, share: share < 0.6, "degraded", "partial sweep: nothing seen at azimuth"),
    ],
    ids=["fog", "dense fog", "partial sweep"],
)
def test_a_scan_that_sees_less_than_the_reference_did(folder, keep, verdict, says):
    site = read_site(folder / "site.toml")
    first, path = sorted(site.scans.inbox.glob("*.laz"))
    references.build_reference(site, [arrival_of(site, first)], "1", lambda: None)
    full, _ = processed(folder)
    assert (full.verdict, full.reason) == ("good", "")
    scan = laspy.read(path)
    share = (np.asarray(scan.gps_time) - scan.gps_time.min()) / np.ptp(scan.gps_time)
    scan.points = scan.points[keep(np.hypot(scan.x, scan.y), share)]
    scan.write(path)
    outcome, _ = processed(folder)
    assert outcome.verdict == verdict
    assert says in outcome.reason
    assert outcome.reason.count(";") == 0
    assert outcome.epoch  # whatever the verdict, what is there is stored


def test_points_without_time_get_the_mean_lean(folder):
    outcome, _ = processed(folder, ('frame = "scanner"', 'frame = "scanner"\npoint_time = "none"'))
    assert outcome.verdict == "good"  # the site file says so


def test_the_log_of_the_sops_scan_is_gone(folder):
    log_of(folder, 0).unlink()
    outcome, _ = processed(folder)
    assert outcome.verdict == "degraded"
    assert "the scan of the SOP, not found" in outcome.reason


def test_wrong_frame(folder):
    """Scanner's frame taken for the map: nothing falls on the grid."""
    with pytest.raises(ScanError, match=r"no point falls on the grid: wrong scans\.frame"):
        processed(folder, ('frame = "scanner"', 'frame = "map"'))


def test_an_sop_that_leads_nowhere_near_the_map(folder):
    site = site_of(folder)
    origin = next(
        line for line in (folder / "site.toml").read_text().splitlines() if line.startswith("origin")
    )
    with pytest.raises(ConfigError, match=r"give map\.origin or map\.pop"):
        processed(folder, (origin, ""))
    assert site.map.origin is not None


def test_the_same_inputs_are_stored_once_and_other_bytes_anew(folder):
    first, _ = processed(folder)
    again, _ = processed(folder)
    assert (again.epoch, again.revision) == (first.epoch, 1)
    other = sorted((folder / "inbox").glob("*.laz"))
    shutil.copy(other[0], folder / "other.laz")
    other[1].write_bytes((folder / "other.laz").read_bytes())
    anew, _ = processed(folder)
    assert anew.revision == 2
    assert anew.epoch != first.epoch


def test_scans_are_never_followed_through_links(folder):
    scan = sorted((folder / "inbox").glob("*.laz"))[1]
    scan.rename(folder / "elsewhere.laz")
    scan.symlink_to(folder / "elsewhere.laz")
    with pytest.raises(ScanError, match="not a regular file"):
        processed(folder)


def test_reference_from_a_geotiff(folder, made):
    rasterio = pytest.importorskip("rasterio")
    import xarray as xr

    site = read_site(made / "site.toml")
    grid = site.grid_cells
    with xr.open_dataset(made / "truth.nc") as truth:
        elevation = truth.unchanged_elevation.values.astype(np.float32)
    place = rasterio.Affine(grid.cell_m, 0.0, grid.west_m, 0.0, -grid.cell_m, grid.north_m)
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", width=grid.nx, height=grid.ny, count=1, dtype="float32",
        crs="EPSG:32632", transform=place, nodata=-9999.0,
    ) as tif:  # fmt: skip
        tif.write(np.nan_to_num(elevation, nan=-9999.0), 1)
    outcome, _ = processed(folder, ("scans = 1 ", 'scans = "dem.tif" '))
    assert outcome.reference.startswith("dem-")
    assert abs(outcome.figures["change_median_m"]) < 0.2
