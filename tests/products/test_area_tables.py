"""Change of areas: stored and computed statistics, CSV, and the choice of epochs."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

import station
from station.errors import ConfigError, StationError
from station.products.area_tables import (
    Span,
    area_records,
    as_csv,
    as_text,
    describe_epoch,
    find_epoch,
    parse_time,
)

ALL = Span.parse(None, None)


@pytest.fixture
def other_polygons(tmp_path, small):
    """Polygons that the service does not know: one equal to an area of the site, and a new one."""
    boxes = [
        small.box("rises", 632050, 5185850, 632200, 5185950),
        small.box("new", 632000, 5185900, 632100, 5186000),
    ]
    (tmp_path / "other.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": boxes}))
    return tmp_path / "other.geojson"


def test_computed_statistics_equal_those_of_areas_nc(site, other_polygons):
    stored = [record for record in area_records(site, None, ALL, "reference") if record.area == "rises"]
    computed = [
        record for record in area_records(site, other_polygons, ALL, "reference") if record.area == "rises"
    ]
    assert len(stored) == len(computed) == 6
    for expected, actual in zip(stored, computed, strict=True):
        assert (actual.start, actual.size_m2) == (expected.start, expected.size_m2)
        assert actual.statistics == pytest.approx(expected.statistics, nan_ok=True)
        assert actual.statistics["coverage"] < 1  # it has voids


def test_areas_nc_of_outdated_polygons_is_not_used(site, small):
    """The area was redrawn and the service has not updated areas.nc yet."""
    moved = [
        small.box("rises", 632300, 5185650, 632500, 5185800),
        small.box(small.EVIL, 632300, 5185650, 632500, 5185800),
    ]
    site.areas.file.write_text(json.dumps({"type": "FeatureCollection", "features": moved}))
    records = list(area_records(site, None, ALL, "reference"))[-2:]
    assert records[0].verdict == "good"
    difference = list(area_records(site, None, ALL, "previous"))[-1]
    assert difference.verdict == "degraded"  # that of the previous epoch
    assert records[0].statistics == records[1].statistics
    assert records[0].statistics["mean_change"] == pytest.approx(-0.30, abs=0.01)


@pytest.mark.integration
def test_change_between_any_two_epochs(site, other_polygons):
    """The area rises by 5 cm per hour; sigma compared with `station.variance` of the observed cells."""
    hourly = [
        record for record in area_records(site, other_polygons, ALL, "previous") if record.area == "rises"
    ]
    assert len(hourly) == 5
    assert [record.statistics["mean_change"] for record in hourly] == pytest.approx([0.05] * 5, abs=0.008)
    span = Span.parse("2025-11-21T02:00", "2025-11-21T04:30")
    for against in ("251121_000000", "2025-11-21T00:07", "251121_000000.laz"):
        records = [
            record for record in area_records(site, other_polygons, span, against) if record.area == "rises"
        ]
        assert [record.start.hour for record in records] == [2, 3, 4]
        changes_m = [record.statistics["mean_change"] for record in records]
        assert changes_m == pytest.approx([0.10, 0.15, 0.20], abs=0.008)
    with station.open(site.station.data) as ds:
        observed = np.isfinite(ds.elevation_change[[0, 2]].values).all(axis=0)
    inside = np.zeros(observed.shape, bool)
    inside[5:15, 5:20] = True
    observed_variance_m2 = station.variance(site.station.data, inside * observed / inside.sum(), 2, 0)
    observed_sigma_m = np.sqrt(observed_variance_m2)
    assert observed_sigma_m < records[0].statistics["mean_change_uncertainty"] < 3 * observed_sigma_m


def test_csv_of_areas(site, small):
    rows = list(csv.DictReader(io.StringIO(as_csv(area_records(site, None, ALL, "reference")))))
    assert len(rows) == 12
    times = [rows[0][column] for column in ("start_utc", "time_utc", "end_utc")]
    assert times == ["2025-11-21T00:00:00.000Z", "2025-11-21T00:07:30.000Z", "2025-11-21T00:15:00.000Z"]
    assert rows[1]["area"] == small.EVIL
    assert [row["verdict"] for row in rows[:3]] == ["degraded", "degraded", "good"]
    for row in rows:
        mean, sigma = float(row["mean_change_m"]), float(row["mean_change_sigma_m"])
        assert float(row["mean_change_low95_m"]) == pytest.approx(mean - 1.96 * sigma, rel=1e-4)
        assert float(row["volume_change_m3"]) == pytest.approx(mean * float(row["area_size_m2"]), rel=1e-4)
    assert "rises" in as_text(area_records(site, None, ALL, "reference"))
    record = next(iter(area_records(site, None, ALL, "reference")))
    assert "\x1b" not in as_text([replace(record, area="\x1b[2Jtongue")])
    assert as_text([]) == "no epoch with a change in this span"


def test_epochs_are_found_by_scan_or_time(site, series, small):
    assert find_epoch(series, "251121_040000").start.hour == 4
    assert find_epoch(series, small.EVIL).start.hour == 3
    assert find_epoch(series, "2025-11-21T01:20").start.hour == 1
    assert find_epoch(series, "2025-11-21T02:20+01:00").start.hour == 1
    assert find_epoch(series, "last").start.hour == 5
    assert describe_epoch(site, "2025-11-21T01:20").endswith("epoch of 2025-11-21 01:00:00 UTC")
    assert describe_epoch(site, "reference") == describe_epoch(site, "previous") == ""
    with pytest.raises(StationError, match="no epoch within 12 h of 2024-01-01"):
        find_epoch(series, "2024-01-01")
    with pytest.raises(StationError, match="neither a stored scan"):
        find_epoch(series, "yesterday")
    with pytest.raises(StationError, match="is not a time"):
        parse_time("31.12.2025")
    span = Span.parse("2025-11-21", "2025-11-21")
    assert len(list(area_records(site, None, span, "reference"))) == 12
    assert not list(area_records(site, None, Span.parse("2025-11-22", None), "reference"))


def test_areas_are_required(site):
    with pytest.raises(ConfigError, match="give a GeoJSON"):
        next(area_records(site.model_copy(update={"areas": None}), None, ALL, "reference"))
