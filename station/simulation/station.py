"""A simulated station: its valley, its scans, and its folder of files with the truth."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr

from station.errors import ConfigError, StoreError
from station.quantities import Floats, InclinationLog
from station.simulation import files
from station.simulation.instrument import motion
from station.simulation.instrument.scan import ScanConditions, SimulatedScan, scan_conditions, simulate_scan
from station.simulation.scenario import Scenario, demo, full_resolution, named, small
from station.simulation.true_errors import CONVENTIONS, true_errors
from station.simulation.truth import TrueSurface, geocentric_from_enu, grid_of, true_surface
from station.simulation.world.air import weather
from station.simulation.world.beach import build_beach, sea_level_m, wet_ground
from station.simulation.world.change import BREATHING, SurfaceChange, ground_at, snow_cover, surface_changes
from station.simulation.world.relief import with_rock_relief
from station.simulation.world.rock_face import build_rock_face
from station.simulation.world.snow_slope import build_snow_slope
from station.simulation.world.stable import Rectangle, areas, inside_rectangles, stable_ground
from station.simulation.world.terrain import NodeField, Valley, build_valley

__all__ = ["Scenario", "Station", "demo", "full_resolution", "named", "simulate", "small"]

WEATHER_MARGIN_S = 3600.0  # the weather log covers this margin on both sides of the scans
STORED_STEP_M = 1e-4  # resolution of the stored surfaces
LANDSCAPES = {  # of stations of other kinds than the valley
    "mammoth": build_snow_slope,
    "low-cost-snow": build_snow_slope,
    "beach": build_beach,
    "rockfall": build_rock_face,
}
ELEVATIONS = "Elevations are cell means above the WGS 84 ellipsoid."
ON_FACE = "Elevations are cell means of the distance out of the face, x and y along it and up it."


class Station:
    """A station whose every error is known."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self._conditions: dict[int, ScanConditions] = {}

    @cached_property
    def valley(self) -> Valley:
        """The valley, or another landscape, before any surface change."""
        scenario = self.scenario
        if scenario.kind != "valley":
            return LANDSCAPES[scenario.kind](scenario)
        valley = build_valley(
            scenario.seed,
            scenario.size,
            scenario.terrain_step_m,
            scenario.roughness_m,
            scenario.roughness_length_m,
        )
        if scenario.rough_rock_m:
            valley = with_rock_relief(valley, scenario.seed, scenario.rough_rock_m)
        return valley

    @cached_property
    def changes(self) -> tuple[SurfaceChange, ...]:
        """The surface changes of the scenario."""
        return surface_changes(self.scenario, self.valley)

    @cached_property
    def tilt(self) -> tuple[motion.TiltAxis, motion.TiltAxis]:
        """The true tilt about the scanner's x (roll) and y (pitch), relative to the SOP's scan."""
        return motion.tilt_axes(self.scenario)

    @cached_property
    def surface(self) -> TrueSurface:
        """The true cell means on the map's grid."""
        return true_surface(self.valley, self.changes, grid_of(self.scenario), self.scenario.mark)

    @cached_property
    def stable(self) -> list[Rectangle]:
        """The known stable ground."""
        return stable_ground(self.scenario, self.valley, self.changes, self.surface)

    def ground(self, scan: int) -> NodeField:
        """Return the ground at the time of one scan."""
        return ground_at(self.valley, self.changes, self.scenario.hours_at(scan))

    def conditions(self, scan: int) -> ScanConditions:
        """Return the conditions common to all shots of one scan."""
        if scan not in self._conditions:
            self._conditions[scan] = scan_conditions(self.scenario, scan, self.tilt)
        return self._conditions[scan]

    def scan(self, scan: int) -> SimulatedScan:
        """Simulate one scan."""
        scenario, hours = self.scenario, self.scenario.hours_at(scan)
        ground, conditions = self.ground(scan), self.conditions(scan)
        if scenario.kind == "beach":
            wet, sea_m = wet_ground(scenario, ground, hours), sea_level_m(scenario, hours)
            return simulate_scan(scenario, ground, wet, conditions, self.valley.ice, sea_m)
        cover = snow_cover(self.valley, self.changes, hours)
        return simulate_scan(scenario, ground, cover, conditions, self.valley.ice)

    def log(self, scan: int) -> InclinationLog | None:
        """Return the inclination log of one scan, with its fault if there is one; None if it is missing."""
        log = motion.sensor_log(self.scenario, scan, self.tilt, self.conditions(scan).scanner_start_s)
        return motion.faulty_log(self.scenario, scan, log)

    def truth(self) -> xr.Dataset:
        """Return all true values, scan by scan, at the middle of each."""
        scenario, scans = self.scenario, range(self.scenario.scans)
        errors = true_errors(scenario, [self.conditions(scan) for scan in scans], self.tilt)
        middle = [scenario.scan_start_utc_s(scan) + scenario.scan_s / 2 for scan in scans]
        return xr.merge([self._true_surfaces(), errors]).assign_coords(
            time=("time", middle, {"units": "seconds since 1970-01-01", "standard_name": "time"}),
            scan_id=("time", [files.stem(scenario, scan) for scan in scans]),
        ).assign_attrs(
            title="The truth of a simulated station",
            crs=scenario.map_crs or "east-north-up at the mark",
            comment=f"{ELEVATIONS if scenario.map_crs else ON_FACE} {CONVENTIONS}",
            seed=scenario.seed,
        )  # fmt: skip

    def _true_surfaces(self) -> xr.Dataset:
        surface, scans = self.surface, range(self.scenario.scans)
        change_m = np.stack([surface.change_m(self.changes, self.scenario.hours_at(scan)) for scan in scans])
        plane, cube = ("y", "x"), ("time", "y", "x")
        dataset = xr.Dataset(
            {
                "elevation": (cube, surface.elevation_m + change_m, {"units": "m"}),
                "change": (cube, change_m, {"units": "m", "long_name": "relative to the initial ground"}),
                "unchanged_elevation": (plane, surface.elevation_m, {"units": "m"}),
                "ice": (plane, surface.ice, {"units": "1", "long_name": "share of ice"}),
                "stable_polygons": (
                    plane,
                    inside_rectangles(surface.grid, self.stable).astype(np.int8),
                    {"long_name": "inside stable.geojson: rock, snow may fall on it"},
                ),
                "stable": (plane, surface.stable().astype(np.int8), {"long_name": "never changes"}),
            },
            coords={"x": surface.grid.x_m, "y": surface.grid.y_m},
        )
        if any(change.name in BREATHING for change in self.changes):
            heave_m = np.stack(
                [surface.change_m(self.changes, self.scenario.hours_at(scan), BREATHING) for scan in scans]
            )
            attributes = {"units": "m", "long_name": "heave and creep of rock, contained in change"}
            dataset["stable_heave"] = (cube, heave_m, attributes)
        return dataset


def simulate(folder: Path, scenario: Scenario) -> None:
    """Write a station's folder: inbox, weather.dat, sop.dat, site.toml, polygons, and truth.nc.

    Raises ConfigError if the folder already holds a station, StoreError if it cannot be written.
    """
    station = Station(scenario)
    inbox = folder / "inbox"
    if (folder / "site.toml").exists() or inbox.exists():
        raise ConfigError(f"{folder} already holds a station: choose another folder")
    try:
        inbox.mkdir(parents=True)
        files.write_matrix(
            folder / "sop.dat", motion.sop(scenario), "scanner's frame to east-north-up at the mark"
        )
        if scenario.kind == "mammoth":
            pop = geocentric_from_enu(scenario.mark)
            files.write_matrix(folder / "pop.dat", pop, "east-north-up at the mark to WGS 84 geocentric")
        files.write_site(folder, scenario, grid_of(scenario))
        grid = station.surface.grid
        files.write_polygons(
            folder / "stable.geojson",
            {rectangle.name: rectangle.ring_m(grid) for rectangle in station.stable},
            scenario.map_crs,
        )
        files.write_polygons(folder / "areas.geojson", areas(scenario, station.valley), scenario.map_crs)
        if scenario.air:
            files.write_weather(folder / "weather.dat", weather(scenario, _minutes(scenario)))
        for scan in range(scenario.scans):
            stem = files.stem(scenario, scan)
            start_utc_s = scenario.scan_start_utc_s(scan)
            files.write_scan(inbox / f"{stem}.laz", station.scan(scan), start_utc_s, scenario)
            if (log := station.log(scan)) is not None:
                files.write_inclination(inbox / f"{stem}-incl.txt", log)
        _write_truth(folder / "truth.nc", station.truth())
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written: {error.strerror or error}") from error


def _minutes(scenario: Scenario) -> Floats:
    """Return the minutes of the weather log: those around any scan [s since 1970]."""
    starts_s = np.array([scenario.scan_start_utc_s(scan) for scan in range(scenario.scans)])
    around_s = np.arange(-WEATHER_MARGIN_S, scenario.scan_s + WEATHER_MARGIN_S, 60.0)
    return np.asarray(np.unique(np.ceil((starts_s[:, None] + around_s) / 60) * 60))


def _write_truth(path: Path, truth: xr.Dataset) -> None:
    packed = {
        "dtype": "int32",
        "scale_factor": STORED_STEP_M,
        "_FillValue": -(2**31),
        "zlib": True,
        "complevel": 1,
    }
    surfaces = {"elevation", "change", "unchanged_elevation", "stable_heave"} & set(truth.data_vars)
    encoding = dict.fromkeys(sorted(surfaces), packed)
    truth.to_netcdf(path, engine="netcdf4", encoding=encoding)
