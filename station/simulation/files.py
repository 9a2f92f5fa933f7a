"""Write the files of a station's scanner, inclination sensor, weather mast and operator."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from station import config
from station.quantities import Floats, Grid, InclinationLog, WeatherLog
from station.simulation.instrument.scan import SimulatedScan
from station.simulation.scenario import SCANNER_MODELS, Scenario
from station.simulation.world.air import SCANNER_SETTING

NAME_FORMAT = "%y%m%d_%H%M%S"  # RIEGL's convention: start of the scan in UTC
SCALE_M = 0.00025  # RIEGL's convention
DECIBEL_STEP = 0.01  # of RIEGL's extra bytes
DECIBEL_LIMITS = (-25.0, 5.0)  # scaled to 16 bit, as PDAL's readers.rxp does
FAINTEST = 1e-4  # reflectance that is recorded for less


def stem(scenario: Scenario, scan: int) -> str:
    """Return the file name of one scan, without a suffix."""
    return f"{datetime.fromtimestamp(scenario.scan_start_utc_s(scan), UTC):{NAME_FORMAT}}"


def write_scan(path: Path, scan: SimulatedScan, start_utc_s: float, scenario: Scenario) -> None:
    """Write LAZ 1.4, point format 6: scanner's frame, scanner's seconds, one echo per shot."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    if scenario.brightness == "reflectance":
        header.add_extra_dim(
            laspy.ExtraBytesParams(
                "Reflectance", np.int16, "Echo signal reflectance [dB]", [0.0], [DECIBEL_STEP]
            )
        )
    header.scales = np.full(3, SCALE_M)
    header.offsets = np.zeros(3)
    header.system_identifier = "station simulate"
    header.generating_software = "station simulate"
    header.creation_date = datetime.fromtimestamp(start_utc_s, UTC).date()
    las = laspy.LasData(header)
    las.x, las.y, las.z = scan.x_m, scan.y_m, scan.z_m
    las.gps_time = scan.time_s
    las.intensity = _recorded_brightness(scan, scenario)
    if scenario.brightness == "reflectance":
        las["Reflectance"] = _decibel(scan)
    las.return_number = np.ones(len(scan.x_m), dtype=np.uint8)
    las.number_of_returns = np.ones(len(scan.x_m), dtype=np.uint8)
    las.write(path)


def _recorded_brightness(scan: SimulatedScan, scenario: Scenario) -> NDArray[np.uint16]:
    """Return the field `intensity` of each echo (n,)."""
    if scenario.brightness == "none":
        return np.zeros(len(scan.intensity), dtype=np.uint16)
    if scenario.brightness == "decibel":
        low, high = DECIBEL_LIMITS
        return np.rint(65535 * np.clip((_decibel(scan) - low) / (high - low), 0, 1)).astype(np.uint16)
    intensity = scan.intensity
    if scenario.intensity_reference_m:
        square_m = scan.x_m**2 + scan.y_m**2 + scan.z_m**2
        intensity = np.clip(intensity * scenario.intensity_reference_m**2 / square_m, 0, 1)
    return np.rint((255 if scenario.brightness == "8bit" else 65535) * intensity).astype(np.uint16)


def _decibel(scan: SimulatedScan) -> Floats:
    """Return the reflectance of each echo relative to a white target square to the beam (n,) [dB]."""
    return np.asarray(10 * np.log10(np.maximum(scan.intensity, FAINTEST)))


def write_inclination(path: Path, log: InclinationLog) -> None:
    """Write the inclination log in the format of RIEGL's tools: seconds, degrees at 0.001°."""
    rows = np.stack((log.time_s, np.degrees(log.roll_rad), np.degrees(log.pitch_rad)), axis=1)
    with path.open("w", encoding="ascii", newline="\n") as out:
        out.write("Time,Roll,Pitch\n")
        np.savetxt(out, rows, fmt=("%.4f", "%.3f", "%.3f"), delimiter=",")


def write_weather(path: Path, log: WeatherLog) -> None:
    """Write a Campbell TOA5 table: four header lines, CRLF, times in UTC without a zone."""
    lines = [
        '"TOA5","082_im_hinteren_eis","CR3000","11527","CR3000.Std.29","CPU:simulated.CR3","6258","LowFreq"',
        '"TIMESTAMP","RECORD","TAact_2m_Avg","RHact_2m_Avg","Pact","batt_volt_Avg"',
        '"TS","RN","C","%","mbar","V"',
        '"","","Avg","Avg","Smp","Avg"',
    ]
    rows = zip(log.time_utc_s, log.temperature_c, log.humidity_pct, log.pressure_hpa, strict=True)
    for number, (time_s, temperature_c, humidity_pct, pressure_hpa) in enumerate(rows):
        moment = datetime.fromtimestamp(float(time_s), UTC)
        measured = f"{temperature_c:.4f},{humidity_pct:.3f},{pressure_hpa:.4f}"
        lines.append(f'"{moment:%Y-%m-%d %H:%M:%S}",{number},{measured},12.6')
    path.write_text("\r\n".join([*lines, ""]), encoding="ascii", newline="")


def write_matrix(path: Path, matrix: Floats, meaning: str) -> None:
    """Write a 4 x 4 matrix, of an SOP or a POP, as text."""
    np.savetxt(path, matrix, fmt="%.16f", header=meaning)


def write_polygons(path: Path, rings_m: dict[str, Floats], map_crs: str | None) -> None:
    """Write named polygons as GeoJSON with coordinates of the grid, to the millimetre.

    The member `crs` is that of GeoJSON 2008, which GIS programs still read.
    """
    features = [
        {
            "type": "Feature",
            "properties": {"name": name},
            "geometry": {"type": "Polygon", "coordinates": [np.round(ring_m, 3).tolist()]},
        }
        for name, ring_m in rings_m.items()
    ]
    declared = ""
    if map_crs is not None:
        name = f"urn:ogc:def:crs:EPSG::{map_crs.removeprefix('EPSG:')}"
        declared = f'"crs": {json.dumps({"type": "name", "properties": {"name": name}})}, '
    lines = ",\n".join(json.dumps(feature) for feature in features)
    head = f'{{"type": "FeatureCollection", {declared}"features": [\n'
    path.write_text(f"{head}{lines}\n]}}\n", encoding="ascii")


def write_site(folder: Path, scenario: Scenario, grid: Grid) -> None:
    """Write the site file of the simulated station, with comments, as `site.toml`."""
    if scenario.kind != "valley":
        _adapt_site(config.write_site(folder, scenario.kind), scenario, grid)
        return
    text = SITE.format(
        first=stem(scenario, 0),
        sop_from=f"{scenario.start.astimezone(UTC) - timedelta(hours=1):%Y-%m-%dT%H:%M:%SZ}",
        crs=scenario.mark.crs,
        latitude=scenario.mark.latitude_deg,
        longitude=scenario.mark.longitude_deg,
        height=scenario.mark.height_m,
        west=grid.west_m,
        south=grid.north_m - grid.ny * grid.cell_m,
        east=grid.west_m + grid.nx * grid.cell_m,
        north=grid.north_m,
        cell=grid.cell_m,
        brightness=('"decibel"' if scenario.brightness == "decibel" else '"auto"').ljust(23),
        model=f'"{SCANNER_MODELS[scenario.wavelength_nm]}"'.ljust(27),
        divergence=scenario.beam_divergence_mrad,
        range_sigma=max(scenario.range_noise_m, 0.001),
        sensor_sigma=max(scenario.log_noise_deg, 0.0005),
        reach=scenario.range_max_m,
        reference=scenario.reference_scans,
    )
    (folder / "site.toml").write_text(text + (WEATHER if scenario.air else ""), encoding="utf-8")


def _adapt_site(path: Path, scenario: Scenario, grid: Grid) -> None:
    """Change what a simulated station of a kind has otherwise than its site file: folders, times, grid."""
    south_m, east_m = grid.north_m - grid.ny * grid.cell_m, grid.west_m + grid.nx * grid.cell_m
    bounds = f"west = {grid.west_m}, south = {south_m}, east = {east_m}, north = {grid.north_m}"
    text = re.sub(r'"[^"]*SOP\.dat"', '"sop.dat"', path.read_text(encoding="utf-8"))
    values = {
        "data": '"data"',
        "inbox": '"inbox"',
        "settle_s": "2",
        "from": f"{scenario.start - timedelta(hours=1):%Y-%m-%dT%H:%M:%SZ}",
        "file": f'"sop.dat"\nscan = "{stem(scenario, 0)}"',
        "pop": '"pop.dat"',
        "bounds_m": f"{{ {bounds} }}",
        "cell_m": f"{grid.cell_m}",
        "scans": f"{scenario.reference_scans}",
    }
    for key, value in values.items():
        text = re.sub(rf"(?m)^{key} = (\{{.*?\}}|\".*?\"|\S+)", f"{key} = {value}", text, count=1)
    path.write_text(text, encoding="utf-8")


SITE = """\
# A simulated station. Its truth is in truth.nc, which the station never reads.
# Paths are relative to this file; units are part of the key names.

[station]
id = "simulated"
name = "Simulated Hintereisferner"
institution = "station simulate"
data = "data"                      # everything the station writes

[scans]
inbox = "inbox"                    # where scans and their logs arrive; never changed
name = "%y%m%d_%H%M%S"             # start of the scan in UTC
frame = "scanner"                  # points are in the scanner's own frame
intensity = {brightness}# how a file tells brightness; decibels must be declared
settle_s = 2                       # a file that has not grown for this long is complete
expected_every_s = 3600

[scanner]
model = {model}# the other specifications follow from the model
beam_divergence_mrad = {divergence}
range_sigma_m = {range_sigma}
inclination_sigma_deg = {sensor_sigma}
range_max_m = {reach}

[[sop]]
from = {sop_from}        # the newest entry that has begun applies
file = "sop.dat"                   # scanner's frame to east-north-up at the mark below
scan = "{first}"            # the scan it was solved from: relative tilt is zero there

[map]
crs = "{crs}"
origin = {{ latitude_deg = {latitude}, longitude_deg = {longitude}, height_m = {height} }}

[grid]
bounds_m = {{ west = {west}, south = {south}, east = {east}, north = {north} }}
cell_m = {cell}
min_points = 1

[inclination]
suffix = "-incl.txt"               # <scan>-incl.txt next to each scan
required = true
wait_s = 900
filter = "blackman"
cutoff_hz = "auto"                 # from the log's own spectrum
mode = "relative"                  # the SOP already contains the tilt of its scan

[adjustment]
method = "joint"                   # stable ground, log and weather; "none": filtered log only
stable = "stable.geojson"          # or "auto"

[areas]
file = "areas.geojson"             # named polygons: mean and volume of change in areas.nc

[uncertainty]
model = "rigorous"

[reference]
scans = {reference}                          # change is measured from the mean of the first scans
"""

WEATHER = f"""
[weather]
file = "weather.dat"
format = "toa5"
max_age_s = 3600
utc_offset_h = 0
columns = {{ temperature_c = "TAact_2m_Avg", humidity_pct = "RHact_2m_Avg", pressure_hpa = "Pact" }}

[air]                              # assumed by the scanner when it converts travel times
scanner_setting = {{ temperature_c = {SCANNER_SETTING.temperature_c}, \
pressure_hpa = {SCANNER_SETTING.pressure_hpa}, humidity_pct = {SCANNER_SETTING.humidity_pct} }}
scanner_corrects = true
"""
