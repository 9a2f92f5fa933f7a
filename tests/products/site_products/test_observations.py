"""Observations of others: columns named as those of the product's CSV."""

import pytest

from station.errors import ConfigError
from station.products.site_products.observations import ObservedValue, read_observations

UNITS = {"snow_depth": "m", "new_snow_24h": "m"}


def test_rows_may_have_sigma_and_place_and_gaps(tmp_path):
    path = tmp_path / "gauge.csv"
    path.write_text(
        "time_utc,place,snow_depth_m,snow_depth_sigma_m,new_snow_24h_m\n"
        "2026-01-02T06:00,gauge,1.25,0.02,\n"
        "2026-01-02T07:00+01:00,,1.30,,0.05\n"
    )
    s = 1_767_333_600.0
    assert read_observations(path, UNITS) == [
        ObservedValue(s, "gauge", "snow_depth", 1.25, 0.02),
        ObservedValue(s, "", "new_snow_24h", 0.05, 0.0),
        ObservedValue(s, "", "snow_depth", 1.30, 0.0),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must begin with a line such as time_utc,snow_depth_m"),
        ("time_utc,depth\n", "must begin with a line such as"),
        ("time_utc,snow_depth_m\nyesterday,1\n", "line 2: .*write times as"),
        ("time_utc,snow_depth_m\n2026-01-02,deep\n", "line 2: .*numbers"),
    ],
)
def test_files_that_cannot_be_used_are_refused_with_the_line(tmp_path, text, message):
    path = tmp_path / "gauge.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_observations(path, UNITS)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_observations(tmp_path / "gauge.csv", UNITS)
