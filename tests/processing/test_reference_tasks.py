"""What a reference is made of."""

from types import SimpleNamespace

import pytest

from station.processing.reference_tasks import _sop_scan_count

SCANS = [SimpleNamespace(name=f"a/250715_0{hour}0000.laz") for hour in range(3)]


@pytest.mark.parametrize(
    ("mode", "named", "expected"),
    [
        ("relative", [None], 1),  # the first scan under the SOP
        ("relative", ["250715_010000"], 1),
        ("relative", ["250101_000000"], 0),
        ("absolute", ["250715_010000"], None),
        (None, ["250715_010000"], None),
    ],
)
def test_scans_of_the_sop_are_counted_where_tilt_counts_from_one(mode, named, expected):
    site = SimpleNamespace(
        inclination=mode and SimpleNamespace(mode=mode),
        registration=None,
        sop=[SimpleNamespace(scan=scan) for scan in named],
    )
    assert _sop_scan_count(site, SCANS) == expected
