"""Answers of the web server: right, as the store has them, and limited."""

import netCDF4
import numpy as np
import pytest
import rasterio

import station
from station.errors import StationError
from station.products.epoch_table import read_area_series
from station.products.web import answers

RISES = "632050,5185850,632200,5185850,632200,5185950,632050,5185950"  # the area of this name


def change(site, **parameters):
    return answers.polygon_change(site.station.data, {"polygon": RISES, **parameters}, lambda: None)


def test_polygon_has_the_values_of_the_same_area(site, series):
    answer = change(site, **{"from": "2025-11-21", "to": "2025-11-21"})
    (stored,) = [area for area in read_area_series(series) if area.name == "rises"]
    assert answer["area_size_m2"] == stored.size_m2 == 15_000.0
    assert len(answer["epochs"]) == 6
    for name in ("mean_change", "mean_change_uncertainty", "volume_change", "coverage"):
        assert [row[name] for row in answer["epochs"]] == pytest.approx(
            stored.columns[name].tolist(), rel=1e-12
        )
    assert [row["mean_change"] for row in answer["epochs"]] == pytest.approx(
        [0.05 * (hour + 1) for hour in range(6)], abs=0.006
    )
    assert [row["verdict"] for row in answer["epochs"]] == ["degraded", "good"] * 3


def test_newest_epoch_by_default_and_a_difference_of_two(site):
    (newest,) = change(site)["epochs"]
    assert newest["start_utc"] == "2025-11-21T05:00:00.000Z"
    (difference,) = change(site, against="2025-11-21T01:00")["epochs"]
    assert difference["mean_change"] == pytest.approx(0.20, abs=0.008)
    mask = np.zeros((45, 60), bool)
    mask[5:15, 5:20] = True
    sigma_m = station.variance(site.station.data, mask, 5, 1) ** 0.5
    # cells that were not seen are interpolated, which adds to sigma
    assert sigma_m < difference["mean_change_uncertainty"] < 1.5 * sigma_m


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"polygon": ""}, "at least three corners"),
        ({"polygon": "1,2,3,4"}, "at least three corners"),
        ({"polygon": "a,b,c,d,e,f"}, "at least three corners"),
        ({"polygon": "nan,0,1,1,2,0"}, "at least three corners"),
        ({"polygon": "1e999,0,1,1,2,0"}, "at least three corners"),
        ({"polygon": "-1e300,-1e300,1e300,-1e300,1e300,1e300"}, "at least three corners"),
        ({"polygon": "0,0,1,1,0,1,1,0"}, "Self-intersection"),
        ({"polygon": ",".join(["0"] * 1002)}, "at most 500"),
        ({"polygon": "0,0,1,0,1,1"}, "no cell of the grid"),
        ({"from": "yesterday"}, "is not a time"),
        ({"against": "../../etc/passwd"}, "neither a stored scan"),
    ],
)
def test_wrong_requests_are_refused_with_a_message(site, parameters, message):
    with pytest.raises(StationError, match=message):
        change(site, **parameters)


def test_too_many_epochs_are_refused(site, monkeypatch):
    monkeypatch.setattr(answers, "MAX_EPOCHS", 5)
    with pytest.raises(StationError, match="6 epochs in this span, at most 5"):
        change(site, **{"from": "2025-11-21"})
    assert len(change(site, **{"from": "2025-11-21T01:00"})["epochs"]) == 5


def test_epochs_are_listed(site):
    listed = answers.epoch_list(site.station.data, {"from": "2025-11-21T04:00"}, lambda: None)
    assert [row["start_utc"] for row in listed] == ["2025-11-21T04:00:00Z", "2025-11-21T05:00:00Z"]


def test_part_of_the_series_as_netcdf(site, tmp_path):
    parameters = {
        "box": "632100,5185800,632200,5185900",
        "from": "2025-11-21T02:00",
        "to": "2025-11-21T03:00",
    }
    answers.netcdf_part(site.station.data, tmp_path / "part.nc", parameters, lambda: None)
    series = station.open(site.station.data)
    expected = series.elevation_change.isel(time=[2, 3], x=slice(10, 20), y=slice(10, 20)).values
    with netCDF4.Dataset(tmp_path / "part.nc") as file:
        actual = np.ma.filled(file["elevation_change"][:], np.nan)
    np.testing.assert_array_equal(actual, expected)


def test_map_as_geotiff(site, tmp_path):
    parameters = {"epoch": "2025-11-21T02:00", "box": "632100,5185800,632200,5185900"}
    answers.geotiff_part(site.station.data, tmp_path / "part.tif", parameters, lambda: None)
    expected = station.open(site.station.data).elevation_change.isel(time=2, x=slice(10, 20), y=slice(10, 20))
    with rasterio.open(tmp_path / "part.tif") as raster:
        np.testing.assert_array_equal(raster.read(1), expected.values)
        assert raster.bounds == (632_100.0, 5_185_800.0, 632_200.0, 5_185_900.0)
        assert raster.crs.to_epsg() == 32632
    with pytest.raises(StationError, match="not a variable of a map"):
        answers.geotiff_part(site.station.data, tmp_path / "x.tif", {"variable": "../x"}, lambda: None)


def test_files_are_limited(site, tmp_path, monkeypatch):
    monkeypatch.setattr(answers, "MAX_VALUES", 6 * 45 * 60 - 1)
    with pytest.raises(StationError, match="16,200 values"):
        answers.netcdf_part(site.station.data, tmp_path / "x.nc", {"from": "2025-11-21"}, lambda: None)
    for box in ("1,2,3", "0,0,nan,1", "5,5,1,1"):
        with pytest.raises(StationError, match="west,south,east,north"):
            answers.geotiff_part(site.station.data, tmp_path / "x.tif", {"box": box}, lambda: None)
    assert not list(tmp_path.glob("*x.*"))
