"""A small site for tests of the service: a map frame, so that nothing but a grid is needed."""

from __future__ import annotations

import pytest

from station.config import read_site

SITE = """
[station]
id = "test"
data = "data"
[scans]
inbox = "inbox"
frame = "map"
settle_s = {settle_s}
polling = {polling}
expected_every_s = {expected_every_s}
[map]
crs = "EPSG:32632"
[grid]
bounds_m = {{ west = 0, south = 0, east = 10, north = 10 }}
{more}
"""


@pytest.fixture
def write_site(tmp_path):
    def write(*, settle_s=60.0, polling="false", expected_every_s=3600.0, more=""):
        (tmp_path / "inbox").mkdir(exist_ok=True)
        (tmp_path / "data").mkdir(exist_ok=True)
        path = tmp_path / "site.toml"
        text = SITE.format(settle_s=settle_s, polling=polling, expected_every_s=expected_every_s, more=more)
        path.write_text(text)
        return path

    return write


@pytest.fixture
def make_site(write_site):
    return lambda **settings: read_site(write_site(**settings))
