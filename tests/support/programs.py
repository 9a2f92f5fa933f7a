"""Other programs that read what this one writes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from station.sections.results import MetadataSection


def tool(name):
    """Return the path of a program; without it, skip the test."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return path


def run(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)


def readers_python():
    """Return the interpreter of an environment with cf-python, Iris and others; without one, skip the test.

    They pin libraries, and so have an environment of their own: `STATION_READERS` is its interpreter.
    """
    python = os.environ.get("STATION_READERS")
    if python is None:
        pytest.skip("no environment of other readers: see .ci/run")
    return Path(python)


PRIORITIES = ("high_priorities", "medium_priorities", "low_priorities")


def findings(report, *paths, convention="cf:1.11", priorities=PRIORITIES):
    """Return the objections of the compliance checker to files: path, check, messages."""
    checker = shutil.which("compliance-checker", path=f"{sys.prefix}/bin") or tool("compliance-checker")
    subprocess.run(
        [checker, f"--test={convention}", "--format=json_new", f"--output={report}", *paths],
        capture_output=True,
        check=False,
        timeout=120,
    )
    results = json.loads(report.read_text())
    assert set(results) == set(map(str, paths))
    return [
        (path, check["name"], check["msgs"])
        for path, result in results.items()
        for priority in priorities
        for check in result[convention][priority]
        if check["msgs"]
    ]


def filled_metadata():
    """Return the global attributes of a site that fills in every key of [metadata]."""
    texts = dict.fromkeys(MetadataSection.model_fields, "text") | {
        "keywords": ("ice", "laser"),
        "license": "CC-BY-4.0",
        "creator_email": "a@example.org",
        "creator_orcid": "0000-0002-1825-0097",
        "publisher_email": "b@example.org",
        "publisher_url": "https://example.org",
        "doi": "10.5281/zenodo.1",
    }
    return (*MetadataSection(**texts).attributes.items(), ("time_coverage_resolution", "PT3600S"))


def recommendations(report, *paths):
    """Return what ACDD 1.3 recommends and files lack: file, check, messages.

    What it "highly recommends" includes a standard name for variables that have none in CF.
    """
    found = findings(report, *paths, convention="acdd:1.3", priorities=("medium_priorities",))
    return [(Path(path).name, check, messages) for path, check, messages in found]


def gdal_value(path, variable="elevation_change", band=4):
    """Return a value at a map position, as GDAL reads it."""
    place = "-valonly", "-b", str(band), "-geoloc", f"NETCDF:{path}:{variable}", "632055", "5185955"
    return float(run(tool("gdallocationinfo"), *place).stdout)


def assert_gdal_knows_the_place(path):
    """Position, orientation and projection of the grid of the tests of the archive."""
    info = json.loads(run(tool("gdalinfo"), "-json", f"NETCDF:{path}:elevation_change").stdout)
    assert info["geoTransform"] == [632000.0, 10.0, 0.0, 5186000.0, 0.0, -10.0]
    assert 'ID["EPSG",32632]' in info["coordinateSystem"]["wkt"]
    assert len(info["bands"]) == 4
