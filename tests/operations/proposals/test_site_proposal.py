"""`station init --from FOLDER` writes a site file that measures the scans in the folder."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import laspy
import numpy as np
import pytest
from pyproj import CRS
from support import tiny_station

from station.config import read_site
from station.errors import ConfigError
from station.operations.proposals.site_proposal import _code, propose_site
from station.processing.scans.scan_files import inbox_scans
from station.readers.weather import read_weather

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def station_folder(tmp_path_factory):
    folder = tiny_station.build(tmp_path_factory.mktemp("proposal") / "station", hours=2)
    return folder / tiny_station.PENDING


@pytest.fixture
def source(station_folder, tmp_path):
    return shutil.copytree(station_folder, tmp_path / "scans")


def test_scans_without_anything_else_level_themselves(source, tmp_path):
    paths = propose_site(source, tmp_path / "site")
    site = read_site(paths[0])
    assert site.scans.inbox == source.resolve()
    assert (site.scans.frame, site.scans.name) == ("scanner", "%y%m%d_%H%M%S")
    assert site.inclination.mode == "absolute"
    assert site.map.crs is None
    assert not site.sop
    assert {path.name for path in (tmp_path / "site").iterdir()} == {"site.toml", "station-site.schema.json"}
    with pytest.raises(ConfigError, match="already exists"):
        propose_site(source, tmp_path / "site")


@pytest.mark.integration
def test_the_proposed_site_measures_the_scans(source, tmp_path):
    site, *_ = propose_site(source, tmp_path / "site")
    scans = sorted(source.glob("*.laz"))
    result = subprocess.run(
        [sys.executable, "-m", "station", "process", site, *scans],
        capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr + result.stdout
    assert result.stdout.count("good") + result.stdout.count("degraded") == 2


def test_matrices_weather_and_polygons_are_found(source, tmp_path, shared_data):
    for path in sorted(shared_data.glob("mammoth/*.dat"))[:4]:
        shutil.copy(path, source)
    (source / "weather.txt").write_text(
        "STATIONS_ID;MESS_DATUM;  QN;PP_10;TT_10;TM5_10;RF_10;TD_10;eor\n"
        "3;202507150010;3;684.5;-1.5;-1.0;51.0;-1.6;eor\n"
    )
    path, *matrices = propose_site(source, tmp_path / "site")
    assert [path.name for path in matrices] == ["2020-2021-SOP.dat", "2019-2020-SOP.dat", "POP.dat"]
    assert '# file = "2019-2020-SOP.dat"' in path.read_text()
    site = read_site(path)
    assert CRS.from_user_input(site.map.crs).to_epsg() == 32611  # Mammoth Mountain
    assert site.weather.format == "dwd"
    assert site.inclination.mode == "relative"
    expected = np.loadtxt(shared_data / "mammoth/2020-2021-SOP.dat")
    np.testing.assert_allclose(np.loadtxt(site.sop[0].file), expected, atol=1e-6)


def test_a_proposed_davis_log_can_be_read(source, tmp_path):
    (source / "weather.txt").write_text(
        "\t\tTemp\tOut\t\nDate\tTime\tOut\tHum\tBar  \n15/07/25\t 0:10\t-1.5\t51\t684.5\n"
    )
    site = read_site(propose_site(source, tmp_path / "site")[0])
    assert site.weather.format == "davis"
    assert len(read_weather(site.weather).time_utc_s) == 1


def test_a_log_with_plain_names_can_be_read(source, tmp_path):
    (source / "weather.csv").write_text("Zeit;Temperatur;Feuchte;Luftdruck\n2025-07-15 00:10;-1,5;51;684,5\n")
    log = read_weather(read_site(propose_site(source, tmp_path / "site")[0]).weather)
    assert log.temperature_c.tolist() == [-1.5]


def test_scans_on_the_map_and_other_names(tmp_path):
    points_m = np.random.default_rng(2).uniform(0, 50, (3, 500))
    points_m += np.array([[600_000.0], [5_100_000.0], [2000.0]])
    source = tmp_path / "scans"
    source.mkdir()
    lines = [" ".join(f"{value:.3f}" for value in point) for point in points_m.T]
    (source / "hut_2025-07-15_09-00-00.xyz").write_text("\n".join(lines) + "\n")
    path = propose_site(source, tmp_path / "site")[0]
    with pytest.raises(ConfigError, match="unknown to PROJ: name a projected CRS"):  # the file declares none
        read_site(path)
    path.write_text(path.read_text().replace("EPSG:…", "EPSG:32632"))
    site = read_site(path)
    assert (site.scans.frame, site.scans.name) == ("map", "*%Y-%m-%d_%H-%M-%S")
    assert site.grid.bounds_m.west == 600_000.0
    assert not site.sop


def test_a_folder_without_scans_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no scan lies in it"):
        propose_site(tmp_path, tmp_path / "site")


def test_scans_that_must_be_converted_get_the_recipe_of_the_manual(tmp_path):
    source = tmp_path / "Hütte Süd" / "hut.PROJ" / "ScanPos001.SCNPOS" / "scans"
    source.mkdir(parents=True)
    for hour in range(3):
        (source / f"250715_{hour:02d}0000.rxp").touch()
    site = read_site(propose_site(tmp_path / "Hütte Süd", tmp_path / "site")[0])
    assert (site.scans.suffix, site.scans.name) == (".rxp", "*/*/*/%y%m%d_%H%M%S")
    assert (site.inclination.wait_s, site.inclination.mode) == (0.0, "absolute")
    manual = (ROOT / "docs/how-to/your-own-files.md").read_text()
    recipe = next(text for text in re.findall(r"```toml\n(.*?)```", manual, re.DOTALL) if "pdal" in text)
    assert site.scans.convert == tuple(tomllib.loads(recipe)["scans"]["convert"])
    assert len(inbox_scans(site)) == 3


def test_scans_and_logs_of_a_riscan_project_lie_where_the_project_does(tmp_path, shared_data):
    scans = tmp_path / "site.RiSCAN" / "SCANS"
    scans.mkdir(parents=True)
    shutil.copy(shared_data / "riegl/project.rsp", scans.parent)
    shutil.copy(shared_data / "riegl/140123_202748-incl.txt", scans / "151120_150227-incl.txt")
    (scans / "151120_150227.laz").touch()
    site = read_site(propose_site(scans.parent, tmp_path / "site")[0])
    assert (site.scans.inbox, site.scans.name) == (scans.parent, "*/%y%m%d_%H%M%S")
    assert (site.inclination.suffix, site.inclination.mode) == ("-incl.txt", "relative")
    assert [sop.scan for sop in site.sop] == ["151120_150227", "151120_155528"]


def test_matrices_with_the_same_name_stay_apart(source, tmp_path):
    for folder, x_m in (("Süd", 1.0), ("Nörd", 2.0)):
        matrix = np.eye(4)
        matrix[0, 3] = x_m
        (source / folder).mkdir()
        np.savetxt(source / folder / "sop.dat", matrix)
    site, *matrices = propose_site(source, tmp_path / "site")
    assert sorted(np.loadtxt(path)[0, 3] for path in matrices) == [1.0, 2.0]
    assert len(read_site(site).sop) == 1  # the other one is a comment


@pytest.mark.integration
def test_pipes_links_and_garbage_are_no_finds(source, tmp_path):
    """A pipe would make whoever opens it wait for ever."""
    for name in ("a.txt", "b.dat", "c.rsp", "250716_000000.laz"):
        os.mkfifo(source / name)
    (source / "d.csv").symlink_to("/dev/zero")
    (source / "e.dat").write_bytes(np.random.default_rng(1).bytes(10_000))
    (source / "f.geojson").mkdir()
    (source / "g.smet").write_text("[" * 100_000)
    site = read_site(propose_site(source, tmp_path / "site")[0])
    assert (site.sop, site.weather, site.areas) == ((), None, None)


def test_scans_in_folders_and_of_several_files_are_found(source, tmp_path):
    day = source / "2025-07-15"
    day.mkdir()
    for number, path in enumerate(sorted(source.glob("*.laz")), start=1):
        path.rename(day / f"ScanPos{number:03d}.laz")
    site = read_site(propose_site(source, tmp_path / "site")[0])
    assert site.scans.name == "%Y-%m-%d/*"
    assert site.epoch.name == "%Y-%m-%d"
    assert [scan.name for scan in inbox_scans(site)] == ["2025-07-15"]
    for number in (2, 1):
        np.savetxt(source / f"ScanPos{number:03d}-SOP.dat", np.eye(4))
    site = read_site(propose_site(source, tmp_path / "positions")[0])
    assert [sop.files for sop in site.sop] == ["*ScanPos001*", "*ScanPos002*"]
    assert site.epoch.files == 2


def test_matrices_beside_scans_are_registrations(source, tmp_path):
    for path in source.glob("*.laz"):
        np.savetxt(path.with_suffix(".dat"), np.eye(4))
    site = read_site(propose_site(source, tmp_path / "site")[0])
    assert (site.registration.suffix, len(site.sop)) == (".dat", 1)
    (scan, *_) = inbox_scans(site)
    assert [path.suffix for path in scan.matrices] == [".dat"]


@pytest.mark.integration
def test_inclination_in_the_points_is_used(source, tmp_path):
    for log in source.glob("*-incl.txt"):
        log.unlink()
    for scan in source.glob("*.laz"):
        las = laspy.read(scan)
        las.add_extra_dims([laspy.ExtraBytesParams(axis, "float32") for axis in ("Roll", "Pitch")])
        las.write(scan)
    site = read_site(propose_site(source, tmp_path / "site")[0])
    assert (site.inclination.wait_s, site.inclination.mode) == (0.0, "absolute")


@pytest.mark.parametrize(
    ("wkt", "code"),
    [
        (
            CRS("EPSG:2193+7839").to_wkt(),
            "EPSG:2193",
        ),  # a map with heights, as LAS files of New Zealand declare
        (CRS("EPSG:32632").to_wkt(), "EPSG:32632"),
        ("no CRS", "EPSG:…"),
        ("", "EPSG:…"),
    ],
)
def test_the_map_of_a_scan_is_named_without_its_heights(wkt, code):
    assert _code(SimpleNamespace(crs_wkt=wkt)) == code
