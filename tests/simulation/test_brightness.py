"""Brightness in the files as different scanners and programs write it, read back with laspy."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import laspy
import numpy as np
import pytest

from station.config import read_site
from station.readers.las import LasScan
from station.scanners import SCANNERS
from station.simulation import files
from station.simulation.instrument.scan import SimulatedScan
from station.simulation.station import Station, small
from station.simulation.truth import grid_of
from station.simulation.world.air import group_refractivity_ppm

RANGE_M = np.array([100.0, 500.0, 1000.0, 2000.0])
BRIGHTNESS = np.array([0.5, 0.25, 0.1, 0.001])
DECIBEL = np.array([-3.0103, -6.0206, -10.0, -30.0])


def written(tmp_path, **settings):
    """Return the points of a scan of four echoes."""
    zero = np.zeros(4)
    scan = SimulatedScan(
        RANGE_M, zero, zero, np.arange(4.0), BRIGHTNESS, np.zeros((4, 3)), np.zeros(4, dtype=bool)
    )
    scenario = replace(small(), **settings)
    path = tmp_path / "scan.laz"
    files.write_scan(path, scan, scenario.start_utc_s, scenario)
    with LasScan(path) as reader:
        assert reader.header.point_count == 4
    return laspy.read(path)


def test_linear_is_sixteen_bits_of_reflectance(tmp_path):
    las = written(tmp_path)
    np.testing.assert_allclose(las.intensity / 65535, BRIGHTNESS, atol=1e-5)
    assert list(las.point_format.extra_dimension_names) == []


def test_raw_intensity_falls_with_the_square_of_the_range_and_saturates(tmp_path):
    las = written(tmp_path, intensity_reference_m=500.0)
    expected = np.minimum(BRIGHTNESS * np.array([25.0, 1.0, 0.25, 0.0625]), 1)
    np.testing.assert_allclose(las.intensity / 65535, expected, atol=1e-5)


def test_reflectance_stands_in_extra_bytes_as_riegl_writes_them(tmp_path):
    las = written(tmp_path, brightness="reflectance", intensity_reference_m=500.0)
    np.testing.assert_allclose(las["Reflectance"], DECIBEL, atol=0.0051)
    (dimension,) = las.point_format.extra_dimensions
    assert (dimension.dtype, dimension.scales.tolist()) == (np.dtype(np.int16), [0.01])
    assert dimension.description == "Echo signal reflectance [dB]"
    assert las.intensity[0] == 65535  # raw


def test_decibels_are_scaled_to_sixteen_bits(tmp_path):
    las = written(tmp_path, brightness="decibel")
    np.testing.assert_allclose(las.intensity / 65535 * 30 - 25, np.maximum(DECIBEL, -25), atol=0.001)


def test_eight_bits_and_no_brightness(tmp_path):
    np.testing.assert_array_equal(written(tmp_path, brightness="8bit").intensity, [128, 64, 26, 0])
    np.testing.assert_array_equal(written(tmp_path, brightness="none").intensity, [0, 0, 0, 0])


def test_snow_is_dark_at_1550_nm():
    scenario = replace(
        small(hours=1).without_errors(), lines=20, snowfall_m=0.3, snow_hours=(-1.0, 0.0), wavelength_nm=1550
    )
    snowy, bare = Station(scenario), Station(replace(scenario, snowfall_m=0.0))
    values = []
    for station in (snowy, bare):
        scan = station.scan(0)
        _, east, north = station.ground(0).with_slope(scan.true_m[:, 0], scan.true_m[:, 1])
        ray = scan.true_m - np.array(scenario.mount_position_m)
        cosine = (ray[:, 0] * east + ray[:, 1] * north - ray[:, 2]) / np.linalg.norm(ray, axis=1)
        reflectance = scan.intensity * np.sqrt(1 + east**2 + north**2) / cosine
        ice = station.valley.ice.at(scan.true_m[:, 0], scan.true_m[:, 1])
        gentle = (ice < 0.01) & (np.hypot(east, north) < np.tan(np.radians(35)))
        values.append((np.median(reflectance[gentle]), np.median(reflectance[ice > 0.99])))
    assert values[0] == pytest.approx((0.10, 0.10), abs=0.005)
    assert values[1] == pytest.approx((0.30, 0.10), abs=0.005)


@pytest.mark.parametrize(("wavelength_nm", "model"), [(1064, "riegl-vz-6000"), (1550, "riegl-vz-4000")])
def test_site_file_names_a_scanner_of_the_wavelength(tmp_path, wavelength_nm, model):
    scenario = replace(small(), wavelength_nm=wavelength_nm, air=False)
    files.write_site(tmp_path, scenario, grid_of(scenario))
    assert tomllib.loads((tmp_path / "site.toml").read_text())["scanner"]["model"] == model
    assert SCANNERS[model]["wavelength_um"] == pytest.approx(wavelength_nm / 1000, rel=1e-3)
    for name in ("stable.geojson", "areas.geojson"):
        ring_m = np.array([[0, 0], [9, 0], [0, 9], [0, 0]]) + 6e5
        files.write_polygons(tmp_path / name, {"a": ring_m}, scenario.mark.crs)
    files.write_matrix(tmp_path / "sop.dat", np.eye(4), "SOP")
    (tmp_path / "inbox").mkdir()
    read_site(tmp_path / "site.toml")


def test_air_is_that_of_the_wavelength():
    """IUGG (1999), standard air at 0 °C, 1013.25 hPa: 287.6155 + 4.8866/λ² + 0.068/λ⁴."""
    for wavelength_um, expected_ppm in ((1.064, 291.985), (1.55, 289.661)):
        actual_ppm = group_refractivity_ppm(0.0, 1013.25, 0.0, wavelength_um)
        assert actual_ppm == pytest.approx(expected_ppm, abs=0.001)
    air = Station(replace(small(), wavelength_nm=1550)).conditions(0).air
    assert air.wavelength_um == 1.55


@pytest.mark.parametrize(("brightness", "declared"), [("linear", "auto"), ("decibel", "decibel")])
def test_the_site_file_declares_decibels(tmp_path, brightness, declared):
    scenario = replace(small(hours=1), brightness=brightness)
    files.write_site(tmp_path, scenario, grid_of(scenario))
    assert tomllib.loads((tmp_path / "site.toml").read_text())["scans"]["intensity"] == declared
