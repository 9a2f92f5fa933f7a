"""A whole station: its place, its scans one by one, and its folder of files with the truth beside them."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr

from station.errors import ConfigError, StoreError
from station.quantities import Floats, InclinationLog
from station.simulation import files, motion
from station.simulation.air import weather
from station.simulation.change import Change, changes, ground_at, white_at
from station.simulation.ledger import CONVENTIONS, true_errors
from station.simulation.scan import Conditions, Recorded, conditions, record
from station.simulation.scenario import Scenario, demo, dense, named, tiny
from station.simulation.stable import Rectangle, areas, covered, stable_ground
from station.simulation.terrain import Heights, Valley, valley
from station.simulation.truth import CRS, TrueSurface, grid_of, true_surface

__all__ = ["Scenario", "Station", "demo", "dense", "named", "simulate", "tiny"]

WEATHER_MARGIN_S = 3600.0  # the weather log begins before the first scan and ends after the last
PACKED_M = 1e-4  # last digit of the stored surfaces


class Station:
    """A station of which everything is known."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self._conditions: dict[int, Conditions] = {}

    @cached_property
    def place(self) -> Valley:
        """The valley before anything changes."""
        told = self.scenario
        return valley(told.seed, told.size, told.terrain_step_m, told.roughness_m, told.roughness_length_m)

    @cached_property
    def happening(self) -> tuple[Change, ...]:
        """What changes the surface."""
        return changes(self.scenario, self.place)

    @cached_property
    def lean(self) -> tuple[motion.Axis, motion.Axis]:
        """The true lean about the scanner's x (roll) and y (pitch), relative to the SOP's scan."""
        return motion.axes(self.scenario)

    @cached_property
    def surface(self) -> TrueSurface:
        """The true cell means on the map's grid."""
        return true_surface(self.place, self.happening, grid_of(self.scenario))

    @cached_property
    def stable(self) -> list[Rectangle]:
        """What the owner knows to be stable."""
        return stable_ground(self.scenario, self.place, self.happening, self.surface)

    def ground(self, scan: int) -> Heights:
        """Return the ground that one scan sees."""
        return ground_at(self.place, self.happening, self.scenario.hours_at(scan))

    def conditions(self, scan: int) -> Conditions:
        """Return what holds for all shots of one scan."""
        if scan not in self._conditions:
            self._conditions[scan] = conditions(self.scenario, scan, self.lean)
        return self._conditions[scan]

    def scan(self, scan: int) -> Recorded:
        """Shoot one scan."""
        white = white_at(self.place, self.happening, self.scenario.hours_at(scan))
        return record(self.scenario, self.ground(scan), white, self.conditions(scan))

    def log(self, scan: int) -> InclinationLog:
        """Return the inclination log of one scan."""
        return motion.sensor_log(self.scenario, scan, self.lean, self.conditions(scan).scanner_start_s)

    def truth(self) -> xr.Dataset:
        """Return everything that is true, scan by scan, at the middle of each."""
        told, scans = self.scenario, range(self.scenario.hours)
        errors = true_errors(told, [self.conditions(scan) for scan in scans], self.lean)
        middle = [told.scan_start_utc_s(scan) + told.scan_s / 2 for scan in scans]
        return xr.merge([self._true_surfaces(), errors]).assign_coords(
            time=("time", middle, {"units": "seconds since 1970-01-01", "standard_name": "time"}),
            scan_id=("time", [files.stem(told, scan) for scan in scans]),
        ).assign_attrs(
            title="The truth of a simulated station",
            crs=CRS,
            comment=f"Elevations are cell means above the WGS 84 ellipsoid. {CONVENTIONS}",
            seed=told.seed,
        )  # fmt: skip

    def _true_surfaces(self) -> xr.Dataset:
        surface, scans = self.surface, range(self.scenario.hours)
        change_m = np.stack(
            [surface.change_m(self.happening, self.scenario.hours_at(scan)) for scan in scans]
        )
        plane, cube = ("y", "x"), ("time", "y", "x")
        return xr.Dataset(
            {
                "elevation": (cube, surface.elevation_m + change_m, {"units": "m"}),
                "change": (cube, change_m, {"units": "m", "long_name": "against the unchanged ground"}),
                "unchanged_elevation": (plane, surface.elevation_m, {"units": "m"}),
                "ice": (plane, surface.ice, {"units": "1", "long_name": "share of ice"}),
                "stable_polygons": (
                    plane,
                    covered(surface.grid, self.stable).astype(np.int8),
                    {"long_name": "inside stable.geojson: rock, on which snow may fall"},
                ),
                "stable": (plane, surface.stable().astype(np.int8), {"long_name": "never changes here"}),
            },
            coords={"x": surface.grid.x_m, "y": surface.grid.y_m},
        )


def simulate(folder: Path, scenario: Scenario) -> None:
    """Write a station's folder: inbox, weather.dat, sop.dat, site.toml, polygons, and truth.nc.

    Raises ConfigError if there already is a station, StoreError if it cannot be written.
    """
    station = Station(scenario)
    inbox = folder / "inbox"
    if (folder / "site.toml").exists() or inbox.exists():
        raise ConfigError(f"{folder} already holds a station: name another folder")
    try:
        inbox.mkdir(parents=True)
        files.write_sop(folder / "sop.dat", motion.sop(scenario))
        files.write_site(folder / "site.toml", scenario, grid_of(scenario))
        grid = station.surface.grid
        files.write_polygons(
            folder / "stable.geojson", {one.name: one.ring_m(grid) for one in station.stable}
        )
        files.write_polygons(folder / "areas.geojson", areas(scenario, station.place))
        if scenario.air:
            files.write_weather(folder / "weather.dat", weather(scenario, _minutes(scenario)))
        for scan in range(scenario.hours):
            stem = files.stem(scenario, scan)
            start_utc_s = scenario.scan_start_utc_s(scan)
            files.write_scan(inbox / f"{stem}.laz", station.scan(scan), start_utc_s)
            files.write_inclination(inbox / f"{stem}-incl.txt", station.log(scan))
        _write_truth(folder / "truth.nc", station.truth())
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written: {error.strerror or error}") from error


def _minutes(scenario: Scenario) -> Floats:
    first = scenario.start_utc_s - WEATHER_MARGIN_S
    last = scenario.scan_start_utc_s(scenario.hours - 1) + scenario.scan_s + WEATHER_MARGIN_S
    return np.arange(np.ceil(first / 60) * 60, last, 60.0)


def _write_truth(path: Path, truth: xr.Dataset) -> None:
    packed = {
        "dtype": "int32",
        "scale_factor": PACKED_M,
        "_FillValue": -(2**31),
        "zlib": True,
        "complevel": 1,
    }
    encoding = dict.fromkeys(("elevation", "change", "unchanged_elevation"), packed)
    truth.to_netcdf(path, engine="netcdf4", encoding=encoding)
