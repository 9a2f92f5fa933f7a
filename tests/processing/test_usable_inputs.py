"""Broken areas, flags, stable ground and weather: the last good version is used, the fault reported."""

from __future__ import annotations

import hashlib
import json
import os

import pytest

from station.config import read_site
from station.errors import ConfigError, NotReadyError, StoreError
from station.monitoring.alarm_rules import evaluate_rules
from station.monitoring.status import format_status, status
from station.processing import usable_inputs
from station.processing.site_files import polygon_cells, site_file_sha256
from station.processing.usable_inputs import usable_site
from station.readers.inclination import read_inclination
from station.readers.regular_file import open_regular
from station.service import publishing

FILES = {"areas": "areas.geojson", "flags": "flags.csv", "stable": "stable.geojson"}
SECTIONS = """
[areas]
file = "areas.geojson"
[flags]
file = "flags.csv"
[adjustment]
stable = "stable.geojson"
[weather]
file = "weather.dat"
columns = { temperature_c = "T", humidity_pct = "RH", pressure_hpa = "P" }
"""
WEATHER = (
    '"TOA5"\n"TIMESTAMP","T","RH","P"\n"TS","Deg C","%","hPa"\n"","Avg","Avg","Avg"\n"2025-07-15",1,50,700\n'
)


def polygons(size_m):
    ring = [[200, 0], [200, size_m], [200 + size_m, 0], [200, 0]]
    feature = {
        "type": "Feature",
        "properties": {"name": "a"},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    return json.dumps({"type": "FeatureCollection", "features": [feature]})


@pytest.fixture
def site(make_site, tmp_path):
    for name in ("areas.geojson", "stable.geojson"):
        (tmp_path / name).write_text(polygons(300))
    (tmp_path / "flags.csv").write_text("from,to,reason\n2025-01-01,2025-01-02,crane\n")
    (tmp_path / "weather.dat").write_text(WEATHER)
    return make_site(more=SECTIONS)


def used_files(site):
    return {
        "areas": site.areas and site.areas.file,
        "flags": site.flags and site.flags.file,
        "stable": site.adjustment.stable,
    }


def test_files_that_the_site_file_names_may_be_links(site, tmp_path):
    """As configuration management makes them; links in an inbox are rejected."""
    stable, target = tmp_path / "stable.geojson", tmp_path / "rock.geojson"
    cells = polygon_cells(stable, site)
    stable.rename(target)
    stable.symlink_to(target)
    assert site_file_sha256(stable) == hashlib.sha256(target.read_bytes()).hexdigest()
    assert polygon_cells(usable_site(site, save=True).adjustment.stable, site).tolist() == cells.tolist()
    target.unlink()
    with pytest.raises(NotReadyError, match=r"rock\.geojson cannot be read: No such file"):
        site_file_sha256(stable)


def as_garbage(path):
    path.write_text('{"type": "Feat')


def as_pipe(path):
    path.unlink()
    os.mkfifo(path)


def as_folder(path):
    path.unlink()
    path.mkdir()


def as_nothing(path):
    path.unlink()


def as_giant(path):
    with path.open("r+b") as file:
        file.truncate(usable_inputs.MAX_BYTES + 1)


@pytest.mark.parametrize("break_file", [as_garbage, as_pipe, as_folder, as_nothing, as_giant])
def test_last_good_version_of_a_broken_file_is_used(site, tmp_path, break_file):
    originals = {key: tmp_path / name for key, name in FILES.items()}
    contents = {key: path.read_bytes() for key, path in originals.items()}
    science_hash = site.science_hash
    good = usable_site(site, save=True)
    assert (used_files(good), good.input_faults) == (originals, ())
    for path in originals.values():
        break_file(path)
    usable = usable_site(site, save=True)
    assert {key: path.read_bytes() for key, path in used_files(usable).items()} == contents
    assert [fault.split(": ")[0] for fault in usable.input_faults] == [
        str(tmp_path / name) for name in FILES.values()
    ]
    assert all(fault.endswith("its last good version is used") for fault in usable.input_faults)
    assert usable.science_hash == science_hash


def test_file_that_was_never_good_is_left_out(site, tmp_path):
    for name in FILES.values():
        as_garbage(tmp_path / name)
    usable = usable_site(site, save=True)
    assert used_files(usable) == {"areas": None, "flags": None, "stable": "auto"}
    assert len(usable.input_faults) == 3
    assert usable.input_faults[1].endswith(
        "flags.csv: must begin with the line from,to,reason: it is not used"
    )


def test_corrected_file_replaces_its_copy(site, tmp_path):
    usable_site(site, save=True)
    (tmp_path / "areas.geojson").write_text(polygons(400))
    assert usable_site(site).input_faults == ()
    assert site.last_good("areas").read_text() == polygons(300)
    usable_site(site, save=True)
    assert site.last_good("areas").read_text() == polygons(400)


def test_good_files_are_used_although_they_cannot_be_copied(site, monkeypatch):
    def full(_):
        raise StoreError("no space left on the device")

    monkeypatch.setattr(usable_inputs, "atomic_write", full)
    assert usable_site(site, save=True).input_faults == ()


def test_station_restarts_without_an_optional_file_only_if_it_was_good_before(site, tmp_path):
    as_nothing(tmp_path / "areas.geojson")
    with pytest.raises(ConfigError, match=r"areas\.file: no such file"):
        read_site(site.path)
    (tmp_path / "areas.geojson").write_text(polygons(300))
    usable_site(site, save=True)
    as_nothing(tmp_path / "areas.geojson")
    assert len(usable_site(read_site(site.path)).input_faults) == 1


def test_faults_are_reported_in_status_page_and_alarms(site, tmp_path):
    usable_site(site, save=True)

    def faults():
        report = status(site)
        alarms = evaluate_rules(site, since_utc_s=0.0, assessed_until_utc_s=None, now_s=1.8e9)
        texts = [alarm.text for alarm in alarms if alarm.key == "inputs"]
        assert all(fault in format_status(report) for fault in report["faults"])
        assert publishing._page_context(usable_site(site), None, []).faults == report["faults"]
        assert texts == (["; ".join(report["faults"])] if report["faults"] else [])
        return report["faults"]

    assert faults() == []
    as_garbage(tmp_path / "areas.geojson")
    as_pipe(tmp_path / "weather.dat")
    areas, weather = faults()
    assert "areas.geojson: not valid GeoJSON" in areas
    assert weather.startswith(
        "weather log unusable: weather.dat cannot be read: it is a pipe, folder or device"
    )


def test_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="it is a pipe"):
        open_regular(tmp_path / "pipe")
    with pytest.raises(NotReadyError, match="it is a pipe"):
        read_inclination(tmp_path / "pipe")
