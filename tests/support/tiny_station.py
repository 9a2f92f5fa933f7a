"""A station whose scans take a fifth of a second to process, and the comparison of two such stations."""

from __future__ import annotations

from dataclasses import replace

import netCDF4
import numpy as np

from station.simulation.scenario import small
from station.simulation.station import simulate

SCANS = 6
PENDING = "pending"  # folder of the scans that have not arrived yet
NOT_COMPARED = {"epoch_file", "sources"}  # the revision may differ


def build(folder, *, method="none", hours=SCANS):
    """Simulate a station whose scans take a fifth of a second to process; its inbox is empty."""
    scenario = replace(
        small(hours=hours),
        lines=30,
        shots_per_line=60,
        cell_m=25.0,
        azimuth_deg=(150.0, 165.0),
        terrain_step_m=10.0,
        scan_s=60.0,
        reference_scans=2,
    )
    simulate(folder, scenario)
    text = (folder / "site.toml").read_text()
    for old, new in (('method = "joint" ', f'method = "{method}" '), ("settle_s = 2 ", "settle_s = 0.05 ")):
        assert old in text
        text = text.replace(old, new)
    (folder / "site.toml").write_text(text)
    (folder / "inbox").rename(folder / PENDING)
    (folder / "inbox").mkdir()
    return folder


def scan_name(hour):
    """Return the name of a scan without its suffix."""
    return f"250715_{hour:02d}0000"


def values(path):
    """Return the dimensions and the stored values of every variable of a file."""
    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        return {
            name: (variable.dimensions, np.asarray(variable[...]))
            for name, variable in file.variables.items()
            if name not in NOT_COMPARED
        }


def assert_same_values(path, expected_path):
    """Assert that every variable is bit-identical to that of an undisturbed run."""
    actual, expected = values(path), values(expected_path)
    assert actual.keys() == expected.keys()
    for name, (dims, value) in expected.items():
        assert actual[name][0] == dims, name
        assert actual[name][1].tobytes() == value.tobytes(), f"{path.name}: {name} differs"
