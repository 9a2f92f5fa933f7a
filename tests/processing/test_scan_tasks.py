"""Processing of scans with missing or faulty inputs: verdict, reasons, sigma, or an error."""

import math
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace

import laspy
import netCDF4
import numpy as np
import pytest
from pyproj import CRS

from station.archive import tilt_offsets
from station.config import read_site
from station.errors import ConfigError, NotReadyError, ScanError
from station.operations import site_check
from station.processing import provenance, reference_tasks, scan_tasks
from station.processing.pipeline import to_map
from station.processing.scan_tasks import ScanHistory
from station.processing.scans import adjusted_scan, open_scans
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.scan_air import pressure_fault
from station.processing.scans.scan_files import scan_file
from station.quantities import Air, Quality
from station.science.adjustment import ground_response
from station.science.analysis.inclination_check import ClockOffset, LogCheck
from station.science.uncertainty.parameters import LINE_GROUPS_PER_KNOT
from station.simulation.instrument.motion import sensor_faults
from station.simulation.station import simulate, small

SCENARIO = replace(small(hours=2), avalanche_m=0.0, melt_m_per_h=0.0)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated") / "station"
    simulate(folder, SCENARIO)
    return folder


@pytest.fixture
def folder(simulated, tmp_path):
    return shutil.copytree(simulated, tmp_path / "station")


def edited_site(folder, *changes):
    path = folder / "site.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return read_site(path)


def process(folder, *changes, scan=1, **options):
    """Return the result of one scan and the sigma of its shared parameters."""
    site = edited_site(folder, *changes)
    scans = sorted(site.scans.inbox.glob("*.laz"))
    result = scan_tasks.process(site, scan_file(site, scans[scan]), lambda: None, **options)
    with netCDF4.Dataset(site.station.data / result.epoch) as file:
        variance = np.diagonal(file["shared_parameter_covariance"][0])
    return result, np.sqrt(variance)


def log_file(folder, scan=1):
    return sorted((folder / "inbox").glob("*-incl.txt"))[scan]


def test_complete_inputs_give_verdict_good(folder):
    result, _ = process(folder)
    assert (result.verdict, result.reason) == ("good", "")


@pytest.mark.parametrize(
    "content",
    ["one digit", *(pytest.param(text, marks=pytest.mark.integration) for text in ("", "[]", None))],
)
def test_damaged_tilt_offset_is_restored_from_the_epochs(folder, content):
    process(folder, scan=0)
    (path,) = (folder / "data" / "sop_tilt_offset").glob("*.json")
    intact = path.read_text()
    path.unlink()
    if content is not None:
        path.write_text(content if content != "one digit" else intact.replace("0.000", "0.001", 1))
        assert path.read_text() != intact
        assert tilt_offsets.damaged_tilt_offsets(folder / "data") == [path]
    site = edited_site(folder)
    scan = scan_file(site, max(site.scans.inbox.glob("*.laz")))
    with scan_tasks.open_scan_for(site, scan) as opened:
        load_scan_inputs(site, opened)
    assert path.read_text() == intact
    assert tilt_offsets.damaged_tilt_offsets(folder / "data") == []


@pytest.mark.parametrize(
    ("declared", "is_same"),
    [("EPSG:32632", True), ("EPSG:32632+5773", True), ("EPSG:32633", False), ("EPSG:4326", False)],
)
def test_map_that_a_scan_declares_must_be_that_of_the_site(declared, is_same):
    wkt = CRS.from_user_input(declared).to_wkt()
    with nullcontext() if is_same else pytest.raises(ScanError, match=r"map\.crs is WGS 84 / UTM zone 32N"):
        open_scans._require_same_map(wkt, "EPSG:32632")


def test_line_times_match_the_shots(folder):
    """True north deviates from grid north by 1.3°, which the head turns in 2.6 s."""
    site = edited_site(folder)
    scan = scan_file(site, min(site.scans.inbox.glob("*.laz")))
    with scan_tasks.open_scan_for(site, scan) as opened:
        inputs = load_scan_inputs(site, opened)
        shots = next(iter(inputs.shots(opened, "auto")))
    points = to_map(shots, inputs.pose)
    offset_m = tuple(
        points_m - origin_m for points_m, origin_m in zip(points, inputs.geometry.position_m, strict=True)
    )
    far = np.hypot(*offset_m[:2]) > 200
    line = (inputs.adjustment_inputs.params.knot_position(offset_m)[far] * LINE_GROUPS_PER_KNOT).astype(int)
    delay_s = inputs.adjustment_inputs.lines.time_s[line] - shots.time_s[far]
    assert abs(np.median(delay_s)) < 0.3
    assert np.quantile(np.abs(delay_s), 0.95) < 1.0


def test_missing_log_increases_the_tilt_sigma(folder):
    _, sigma_with_log = process(folder)
    log_file(folder).unlink()
    result, sigma = process(folder)
    assert result.verdict == "degraded"
    assert "inclination log missing" in result.reason
    assert sigma[0] > 3 * sigma_with_log[0]


@pytest.mark.integration
def test_errors_of_a_reference_follow_from_the_components_that_its_scans_show(folder):
    """Those of its first scans on the surface that is stored, not of a pass before: equations.md, 6.3."""
    site = edited_site(folder)
    scans = [scan_file(site, path) for path in sorted(site.scans.inbox.glob("*.laz"))]
    reference_tasks.build_reference_version(site, scans, "1", lambda: None)
    with netCDF4.Dataset(site.station.data / "reference_1.nc") as file:
        names, variance = file["parameter_name"][:], np.diag(file["shared_parameter_covariance"][:])
        component = file.component_refraction_ice
    hours = np.arange(len(scans))
    scans_of_the_weather = len(scans) ** 2 / np.exp(-np.abs(np.subtract.outer(hours, hours)) / 6).sum()
    stated = variance[list(names).index("refraction_ice")]
    assert stated == pytest.approx(component**2 / scans_of_the_weather, rel=0.01)


@pytest.mark.integration
def test_response_of_rough_ground_counts_from_the_state_in_the_scans_of_the_reference(folder, monkeypatch):
    """Its variance is a parabola of that state with the estimate as its vertex (equations.md, 6.8).

    All ground is taken to respond by 1 % more or less, which is little against the errors of the log: a log
    that shows the response would make less of it.
    """
    response_error = 0.01
    monkeypatch.setattr(ground_response, "RESPONSE_ERROR", 1e6)
    monkeypatch.setattr(ground_response, "MAX_RESPONSE_ERROR", response_error)
    monkeypatch.setattr(ground_response, "MAX_RESPONSE_TILT_RAD", 1.0)
    site = edited_site(folder)
    scans = [scan_file(site, path) for path in sorted(site.scans.inbox.glob("*.laz"))]
    reference_tasks.build_reference_version(site, scans, "1", lambda: None)
    path = site.station.data / "reference_1.nc"
    with netCDF4.Dataset(path) as file:
        stored = file["shared_parameter"][:].data
    assert np.hypot(*stored[:2]) > 0

    def tilt_variance(state_rad):
        with netCDF4.Dataset(path, "a") as file:
            file["shared_parameter"][0] = state_rad
        result, sigma = process(folder)
        epoch = site.station.data / result.epoch
        with netCDF4.Dataset(epoch) as file:
            estimate_rad = float(file["shared_parameter"][0, 0])
        epoch.unlink()  # else it is that of an identical scan, which is not stored again
        return sigma[0] ** 2, estimate_rad

    step_rad = math.radians(0.02)
    offsets_rad = (-step_rad, 0.0, step_rad)
    (below, _), (here, estimate_rad), (above, _) = (tilt_variance(stored[0] + each) for each in offsets_rad)
    curvature = (above - 2 * here + below) / step_rad**2
    vertex_rad = stored[0] - (above - below) / (2 * step_rad) / curvature
    # If all ground errs by the same share of a motion, Σ x is that share of it for errors in common, and Σ x²
    # is 0.5 to 1; less for errors of sectors.
    assert 0.4 < curvature / 2 / response_error**2 < 1.1
    assert vertex_rad == pytest.approx(estimate_rad, abs=0.15 * step_rad)


def change_log(folder, change):
    path = log_file(folder)
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *change(rows)]) + "\n")


@pytest.mark.integration
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda rows: rows[: len(rows) // 2], r"inclination log ends 14\d s before the end of the scan"),
        (lambda rows: rows[:100] + rows[180:], "has a gap of"),
        (lambda rows: ["x,y,z"] * 100 + rows[100:], "rows rejected"),
        (lambda rows: rows[:5], "valid rows"),
        (
            lambda rows: [f"{float(r.split(',')[0]) + 90000},{r.split(',', 1)[1]}" for r in rows],
            r"another time: it begins 89,69\d s after the scan",
        ),
        (lambda rows: ["?"] * len(rows), "inclination log unusable"),
        (
            lambda rows: [f"{float(r.split(',')[0]) + 30},{r.split(',', 1)[1]}" for r in rows],
            r"inclination log begins 2\d s after the start of the scan",
        ),
        (
            lambda rows: [f"{row.split(',')[0]},10.0,-1.3" if n % 3 else row for n, row in enumerate(rows)],
            "tilt out of the inclination sensor's range of 10 degree in 67% of its log",
        ),
    ],
    ids=["short", "gap", "bad rows", "few", "other time", "unreadable", "half a minute late", "saturated"],
)
def test_faulty_log_degrades_the_scan(folder, change, reason):
    change_log(folder, change)
    result, _ = process(folder)
    assert result.verdict == "degraded"
    assert re.search(reason, result.reason)


@pytest.mark.parametrize(
    ("keep", "reason"),
    [
        (lambda rows: rows[:50], r"inclination log ends 25\d s before the end of the scan"),
        (lambda rows: rows[:5], "inclination log has 5 valid rows"),
        (None, "inclination log missing"),
    ],
    ids=["50 s", "5 s", "missing"],
)
def test_scan_without_its_absolute_log_is_unusable(folder, keep, reason):
    """The SOP of an upright scanner does not contain the tilt of the mount."""
    if keep is None:
        log_file(folder).unlink()
    else:
        change_log(folder, keep)
    result, _ = process(folder, ('mode = "relative"', 'mode = "absolute"'))
    assert result.verdict == "unusable"
    assert result.reason.startswith('tilt of the scanner unknown: with inclination.mode = "absolute"')
    assert re.search(reason, result.reason)


@pytest.mark.integration
def test_a_log_that_the_ground_contradicts_is_not_used(folder):
    """A sensor that is off by 0.03° has no effect on the state of the scanner: it is that without a log."""
    site = edited_site(folder)
    scans = [scan_file(site, path) for path in sorted(site.scans.inbox.glob("*.laz"))]
    reference_tasks.build_reference_version(site, scans[:1], "1", lambda: None)

    def state():
        result, sigma = process(folder)
        path = site.station.data / result.epoch
        with netCDF4.Dataset(path) as file:
            estimate = np.array(file["shared_parameter"][0])
        path.unlink()
        return result, estimate, sigma

    good, *_ = state()
    assert good.verdict == "good"

    def off(rows):
        return [
            f"{t},{float(roll) + 0.03:.3f},{pitch}" for t, roll, pitch in (row.split(",") for row in rows)
        ]

    change_log(folder, off)
    result, estimate, sigma = state()
    assert result.verdict == "degraded"
    assert re.search(
        r"the inclination sensor is off by 0\.0[23]\d degrees, .*: its log is not used", result.reason
    )
    log_file(folder).unlink()
    _, estimate_without, sigma_without = state()
    np.testing.assert_array_equal(estimate, estimate_without)
    np.testing.assert_array_equal(sigma, sigma_without)


@pytest.mark.integration
def test_a_log_is_not_used_if_its_corrected_clock_does_not_explain_it(folder, monkeypatch):
    """As with another log: the ground says that it is late, and says so again once it is corrected."""
    site = edited_site(folder)
    scans = [scan_file(site, path) for path in sorted(site.scans.inbox.glob("*.laz"))]
    reference_tasks.build_reference_version(site, scans[:1], "1", lambda: None)
    offset = ClockOffset(4.2, 0.3, log_likelihood_ratio=50.0)
    monkeypatch.setattr(adjusted_scan, "check_log", lambda *_: LogCheck(offset.warnings(), offset))
    result, _ = process(folder)
    assert result.verdict == "degraded"
    assert "inclination log 4.2 s late (± 0.3 s) by the ground: it is not used" in result.reason
    assert "clock of the inclination log" not in result.reason


@pytest.mark.integration
def test_swapped_axes_of_the_log_are_named(folder):
    """The mount of the simulated station rolls by 2.1° and pitches by -1.3°."""
    change_log(folder, lambda rows: ["{0},{2},{1}".format(*row.split(",")) for row in rows])
    result, _ = process(folder)
    assert result.verdict == "degraded"
    assert "axes of the inclination log are wrong: roll and pitch are swapped" in result.reason
    assert result.reason.endswith("it is not used")
    assert "in the SOP 2.10, -1.30" in result.reason
    (finding,) = site_check._newest_scan(read_site(folder / "site.toml"))
    assert finding["level"] == "warning"
    assert "roll and pitch are swapped" in finding["message"]


def test_a_wrong_time_in_the_log_is_named_and_changes_nothing_else(folder):
    good, _ = process(folder)

    def wrong_time(rows):
        time_s, tilt = rows[30].split(",", 1)
        return [*rows[:30], f"{float(time_s) + 5000},{tilt}", *rows[31:]]

    change_log(folder, wrong_time)
    result, _ = process(folder)
    assert (good.verdict, result.verdict) == ("good", "degraded")
    assert result.reason == "inclination log has 1 row with a wrong time, left out"
    assert result.metrics["sigma_median_m"] == pytest.approx(good.metrics["sigma_median_m"], rel=0.01)
    assert result.metrics["roll_deg"] == pytest.approx(good.metrics["roll_deg"], abs=2e-4)


def test_pressure_is_compared_with_the_standard_atmosphere():
    """ICAO: 701.1 hPa at 3,000 m, 898.7 hPa at 1,000 m."""
    assert pressure_fault(Air(-1.0, 701.1 + 59, 50.0), 3000.0) == ""
    assert pressure_fault(Air(-1.0, 701.1 - 59, 50.0), 3000.0) == ""
    assert pressure_fault(Air(-1.0, 1013.0, 50.0), None) == ""
    assert "at 3,000 m the standard atmosphere has 701 hPa: it is reduced to sea level" in pressure_fault(
        Air(-1.0, 1025.0, 50.0), 3000.0
    )
    assert "wrong column or unit" in pressure_fault(Air(-1.0, 701.1 - 61, 50.0), 3000.0)
    assert "the standard atmosphere has 899 hPa: it is reduced" in pressure_fault(
        Air(5.0, 1000.0, 50.0), 1000.0
    )


def test_pressure_reduced_to_sea_level_is_refused(folder):
    path = folder / "weather.dat"
    text = path.read_text()
    lines = text.splitlines()
    column = lines[1].split(",").index('"Pact"')
    for row in range(4, len(lines)):
        fields = lines[row].split(",")
        fields[column] = "1013.2"
        lines[row] = ",".join(fields)
    path.write_text("\n".join(lines) + "\n")
    result, sigma = process(folder)
    assert result.verdict == "degraded"
    assert "weather unusable: pressure of 1013.2 hPa, but at" in result.reason
    assert "it is reduced to sea level; log the pressure at the station itself" in result.reason
    assert sigma[7] == pytest.approx(4.0)  # ppm of the range, as without weather
    site = read_site(folder / "site.toml")
    (finding,) = site_check._weather(site)
    assert finding["level"] == "warning"
    assert "reduced to sea level" in finding["message"]
    (epoch,) = provenance.stored_epochs(scan_tasks.series_for(site))
    assert provenance.CurrentConfig(site).changed_inputs(epoch.provenance, None, None) == []
    path.write_text(text)
    changes = provenance.CurrentConfig(site).changed_inputs(epoch.provenance, None, None)
    assert changes == ["weather arrived later"]
    (finding,) = site_check._weather(site)
    assert finding["level"] == "ok"


@pytest.mark.integration
def test_spikes_in_the_log_are_removed(folder):
    good, _ = process(folder)
    rows = log_file(folder).read_text().splitlines()
    for row in range(20, len(rows), 40):
        rows[row] = rows[row].split(",")[0] + ",9.999,-9.999"
    log_file(folder).write_text("\n".join(rows) + "\n")
    spiked, _ = process(folder)
    assert spiked.verdict == "good"
    assert spiked.metrics["sigma_median_m"] == pytest.approx(good.metrics["sigma_median_m"], rel=0.05)


@pytest.mark.integration
def test_optional_log_may_be_missing_or_saturated(folder):
    """It is saturated if the mount tilts beyond the sensor's range, as at Mammoth Mountain."""
    change_log(folder, lambda rows: [f"{row.split(',')[0]},-10.0,10.0" for row in rows])
    result, _ = process(folder, ("required = true", "required = false"))
    assert result.verdict == "good"
    log_file(folder).unlink()
    result, _ = process(folder)
    assert result.verdict == "good"


def test_clock_offset_of_the_log_is_estimated_from_the_cyclic_tilt(folder):
    """A tilted mount shows waves of 4°; the clock of the second log is 6 s late."""
    head_rad = np.radians(np.linspace(97, 245, 10_000))
    for scan, late_s in ((0, 0.0), (1, 6.0)):
        path = log_file(folder, scan)
        head, *rows = path.read_text().splitlines()
        time_s, roll, pitch = np.array([[float(v) for v in row.split(",")] for row in rows]).T
        share = (time_s - time_s[0] - 6) / 300  # the log begins 6 s before the scan
        azimuth_rad = np.interp(share, np.linspace(0, 1, len(head_rad)), head_rad)
        roll, pitch = roll + 4 * np.cos(azimuth_rad), pitch + 4 * np.sin(azimuth_rad)
        rows = [f"{t + late_s:.4f},{r:.3f},{p:.3f}" for t, r, p in zip(time_s, roll, pitch, strict=True)]
        path.write_text("\n".join([head, *rows]) + "\n")
    result, _ = process(folder)
    assert result.verdict == "degraded"
    match = re.search(r"clock of the inclination log ([+-][\d.]+) s off, sigma ([\d.]+) s", result.reason)
    clock_s = [sensor_faults(SCENARIO, scan).clock_s for scan in (0, 1)]
    assert float(match[1]) == pytest.approx(6 + clock_s[1] - clock_s[0], abs=0.6)
    assert float(match[2]) < 0.5


@pytest.mark.integration
def test_missing_weather_degrades_the_scan_or_defers_it(folder):
    (folder / "weather.dat").unlink()
    result, sigma = process(folder)
    assert result.verdict == "degraded"
    assert "weather" in result.reason
    assert sigma[7] == pytest.approx(4.0)  # ppm of the range, against 0.8 with weather
    with pytest.raises(NotReadyError, match="weather"):
        process(folder, history=ScanHistory(wait_for_weather=True))


@pytest.mark.integration
@pytest.mark.parametrize(
    ("keep", "verdict", "reason"),
    [
        (lambda distance_m, _: distance_m < 400, "degraded", "none beyond 400 m: fog"),
        (lambda distance_m, _: distance_m < 125, "unusable", "of the usually visible cells observed"),
        (lambda _, share: share < 0.6, "degraded", "partial sweep: no points at azimuth"),
    ],
    ids=["fog", "dense fog", "partial sweep"],
)
def test_obstructed_scan_gets_a_verdict_and_one_reason(folder, keep, verdict, reason):
    site = read_site(folder / "site.toml")
    first, path = sorted(site.scans.inbox.glob("*.laz"))
    reference_tasks.build_reference_version(site, [scan_file(site, first)], "1", lambda: None)
    full, _ = process(folder)
    assert (full.verdict, full.reason) == ("good", "")
    scan = laspy.read(path)
    share = (np.asarray(scan.gps_time) - scan.gps_time.min()) / np.ptp(scan.gps_time)
    scan.points = scan.points[keep(np.hypot(scan.x, scan.y), share)]
    scan.write(path)
    result, _ = process(folder)
    assert result.verdict == verdict
    assert reason in result.reason
    assert result.reason.count(";") == 0
    assert result.epoch  # stored whatever the verdict


def test_points_without_time_get_the_mean_tilt(folder):
    result, _ = process(folder, ('frame = "scanner"', 'frame = "scanner"\npoint_time = "none"'))
    assert result.verdict == "good"  # as the site file declares


def test_missing_log_of_the_sop_scan_degrades_the_scan(folder):
    log_file(folder, 0).unlink()
    result, _ = process(folder)
    assert result.verdict == "degraded"
    assert "the scan of the SOP, not found" in result.reason


def test_scan_without_points_on_the_grid_is_rejected(folder):
    """The scanner's frame is taken for the map."""
    with pytest.raises(ScanError, match=r"no point falls on the grid: wrong scans\.frame"):
        process(folder, ('frame = "scanner"', 'frame = "map"'))


def test_sop_outside_the_map_raises_config_error(folder):
    site = edited_site(folder)
    origin = next(
        line for line in (folder / "site.toml").read_text().splitlines() if line.startswith("origin")
    )
    with pytest.raises(ConfigError, match=r"set map\.origin or map\.pop"):
        process(folder, (origin, ""))
    assert site.map.origin is not None


@pytest.mark.integration
def test_identical_epoch_is_stored_once_and_changed_content_as_a_revision(folder):
    first, _ = process(folder)
    repeated, _ = process(folder)
    assert (repeated.epoch, repeated.revision) == (first.epoch, 1)
    first_scan, second_scan = sorted((folder / "inbox").glob("*.laz"))
    shutil.copyfile(first_scan, second_scan)
    changed, _ = process(folder)
    assert changed.revision == 2
    assert changed.epoch != first.epoch


def test_linked_scan_is_rejected(folder):
    scan = sorted((folder / "inbox").glob("*.laz"))[1]
    scan.rename(folder / "elsewhere.laz")
    scan.symlink_to(folder / "elsewhere.laz")
    with pytest.raises(ScanError, match="not a regular file"):
        process(folder)


NO_BRIGHTNESS = "no brightness: snow on stable ground cannot be recognised"


def rewrite(path, change):
    """Change the echoes of a scan."""
    las = laspy.read(path)
    change(las)
    las.write(path)


@pytest.mark.integration
def test_scan_without_brightness_is_degraded_and_uses_steep_ground_only(folder):
    site = edited_site(folder)
    scans = sorted(site.scans.inbox.glob("*.laz"))
    reference_tasks.build_reference_version(site, [scan_file(site, scans[0])], "1", lambda: None)
    bright, _ = process(folder)
    assert (bright.verdict, bright.reason) == ("good", "")
    stable = stable_ground(site, bright)

    rewrite(scans[1], lambda las: las.intensity.fill(0))
    dark, _ = process(folder)
    assert (dark.verdict, dark.reason) == ("degraded", NO_BRIGHTNESS)
    steep = stable_ground(site, dark)
    assert 0 < np.count_nonzero(steep) < 0.5 * np.count_nonzero(stable)
    assert np.count_nonzero(steep & ~stable) < 0.02 * np.count_nonzero(steep)  # noise of their brightness
    elevation_m = scan_tasks.load_reference(site).elevation_m[:]
    rise = np.hypot(*np.gradient(elevation_m, site.grid.cell_m))  # not smoothed as the program does
    assert np.nanmedian(np.degrees(np.arctan(rise[steep]))) > 50
    assert np.nanmedian(np.degrees(np.arctan(rise[stable & ~steep]))) < 50

    no_intensity, _ = process(folder, ('intensity = "auto"', 'intensity = "none"'))
    assert no_intensity.reason == NO_BRIGHTNESS


def stable_ground(site, result):
    """Return the cells (ny, nx) of stable ground that an epoch used."""
    with netCDF4.Dataset(site.station.data / result.epoch) as file:
        return (np.ma.filled(file["quality"][0], 0).astype(int) & Quality.STABLE_GROUND) > 0


BRIGHT_GROUND = (
    "no brightness: stable ground is too bright for a linear scale; if it is in decibels, set scans.intensity"
)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("declared", "expected"), [("decibel", ("good", "")), ("auto", ("degraded", BRIGHT_GROUND))]
)
def test_brightness_in_decibels_counts_only_if_it_is_declared(folder, declared, expected):
    """The same scans with the intensity as PDAL writes reflectance; nothing in such a file says so."""
    site = edited_site(folder, ('intensity = "auto"', f'intensity = "{declared}"'))
    scans = sorted(site.scans.inbox.glob("*.laz"))
    for scan in scans:
        rewrite(scan, to_decibels)
    reference_tasks.build_reference_version(site, [scan_file(site, scans[0])], "1", lambda: None)
    result, _ = process(folder)
    assert (result.verdict, result.reason) == expected


def to_decibels(las):
    relative_db = 10 * np.log10(np.maximum(np.asarray(las.intensity) / 65535, 1e-3))
    las.intensity = np.rint((np.clip(relative_db, -25, 5) + 25) / 30 * 65535).astype(np.uint16)


def test_discarded_points_are_counted_and_leave_the_surface_unchanged(folder):
    """One echo in ten is doubled, 40 m closer: snowflakes, first of two returns."""
    clean, _ = process(folder)
    site = read_site(folder / "site.toml")
    scan = sorted(site.scans.inbox.glob("*.laz"))[1]
    las = laspy.read(scan)
    chosen = np.arange(0, len(las), 10)
    order = np.sort(np.concatenate([np.arange(len(las)), chosen]), kind="stable")
    first = np.flatnonzero(np.diff(order) == 0)  # of the two copies
    xyz_m = np.stack([las.x, las.y, las.z])[:, order]
    xyz_m[:, first] *= 1 - 40 / np.linalg.norm(xyz_m[:, first], axis=0)
    las.points = las.points[order]
    las.x, las.y, las.z = xyz_m
    number, count = np.ones((2, len(order)), np.uint8)
    number[first + 1] = count[first] = count[first + 1] = 2
    las.return_number, las.number_of_returns = number, count
    las.write(scan)
    snowy, _ = process(folder)
    assert "discarded_pct" not in clean.metrics
    assert snowy.metrics["points"] == len(order)
    assert snowy.metrics["discarded_pct"] == pytest.approx(100 * len(chosen) / len(order), abs=0.01)
    with (
        netCDF4.Dataset(site.station.data / clean.epoch) as before,
        netCDF4.Dataset(site.station.data / snowy.epoch) as after,
    ):
        assert before["discarded_share"][0] == 0
        assert after["discarded_share"][0] == pytest.approx(len(chosen) / len(order))
        assert snowy.epoch != clean.epoch
        before_m, after_m = (file["elevation_outside_reference"][:] for file in (before, after))
        difference_m = np.abs(after_m - before_m)
        assert difference_m.count() > 5000
        # The azimuth of the head is sampled at other points, and heights are rounded to a quarter of σ.
        random_m = np.sqrt(
            before["elevation_change_uncertainty"][:] ** 2
            - before["elevation_change_systematic_uncertainty"][:] ** 2
        )
        assert (difference_m <= 0.01 + random_m / 4).all()
        assert difference_m.mean() < 0.001
        assert np.ma.allequal(before_m.mask, after_m.mask)


@pytest.mark.integration
def test_reference_from_a_geotiff(folder, simulated):
    rasterio = pytest.importorskip("rasterio")
    import xarray as xr

    site = read_site(simulated / "site.toml")
    grid = site.grid_cells
    with xr.open_dataset(simulated / "truth.nc") as truth:
        elevation = truth.unchanged_elevation.values.astype(np.float32)
    transform = rasterio.Affine(grid.cell_m, 0.0, grid.west_m, 0.0, -grid.cell_m, grid.north_m)
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", width=grid.nx, height=grid.ny, count=1, dtype="float32",
        crs="EPSG:32632", transform=transform, nodata=-9999.0,
    ) as tif:  # fmt: skip
        tif.write(np.nan_to_num(elevation, nan=-9999.0), 1)
    result, _ = process(folder, ("scans = 1 ", 'scans = "dem.tif" '))
    assert result.reference.startswith("dem-")
    assert abs(result.metrics["change_median_m"]) < 0.2
