"""How the scanner had moved at an epoch: a 4 × 4 matrix in map coordinates, and its covariance."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.read_errors import read_errors
from station.archive.schema import FILL
from station.archive.series.index import processing_file
from station.errors import StationError
from station.products.epoch_table import read_epoch_table
from station.products.gallery import replace_if_changed
from station.quantities import Floats
from station.science.geometry.registration import POSE

PARAMETERS = (
    "tilt_east", "tilt_north", "heading", "translation_east", "translation_north", "translation_up"
)  # fmt: skip
SIGNS = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])  # headings are clockwise, rotations about up are not


@dataclass(frozen=True)
class Transformation:
    """The rigid motion from points by the SOP alone to those of an epoch.

    It is the mean of the scan: inclination within the scan, refraction and range errors are not in it.
    """

    matrix: Floats  # (4, 4) of map coordinates [m]
    position_m: Floats  # (3,) of the scanner on the map
    covariance: Floats  # (6, 6) of POSE: rotations at the scanner [rad], counter-clockwise, and shifts [m]


def read_transformation(series: Series, row: int) -> Transformation | None:
    """Return the transformation of a row of `processing.nc`; None without an adjustment.

    Its covariance is relative to the reference. Source: equations.md, 6.1.
    """
    path = processing_file(series)
    with read_errors(path), h5py.File(path, "r") as file:
        if not {"shared_parameter", "parameter_name", "scanner_east"} <= set(file):
            return None
        names = [name.tobytes().rstrip(b"\0").decode() for name in file["parameter_name"][:]]
        if not set(PARAMETERS) <= set(names):
            return None
        columns = [names.index(name) for name in PARAMETERS]
        estimate = np.asarray(file["shared_parameter"][row], dtype=np.float64)[columns]
        covariance = np.asarray(file["shared_parameter_covariance"][row], dtype=np.float64)
        position_m = np.array([file[f"scanner_{axis}"][row] for axis in ("east", "north", "height")])
    if np.any(np.abs([*estimate, *position_m]) > FILL / 2):
        return None
    values = SIGNS * estimate
    rotation = Rotation.from_rotvec(values[:3]).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = position_m + values[3:] - rotation @ position_m
    return Transformation(matrix, position_m, covariance[np.ix_(columns, columns)] * np.outer(SIGNS, SIGNS))


def write_transformations(
    series: Series,
    epochs: list[EpochRef],
    folder: Path,
    track: Callable[[list[EpochRef]], Iterable[EpochRef]],
) -> list[Path]:
    """Write the matrix of each epoch as text, and its covariance as CSV; return the files.

    `track` iterates over the epochs. Raises StationError if none was adjusted.
    """
    rows = {name: row for row, name in enumerate(read_epoch_table(series).texts["epoch_file"])}
    paths = []
    for epoch in track(epochs):
        found = read_transformation(series, rows[epoch.epoch_file])
        if found is None:
            continue
        stem = Path(epoch.epoch_file).stem
        east_m, north_m, height_m = found.position_m
        note = f"at {east_m:.3f} {north_m:.3f} {height_m:.3f} (the scanner)"
        texts = {
            f"{stem}-transformation.txt": _matrix_text(found.matrix),
            f"{stem}-covariance.csv": covariance_text(POSE, found.covariance, note),
        }
        for name, text in texts.items():
            replace_if_changed(folder / name, text.encode())
            paths.append(folder / name)
    if not paths:
        raise StationError("no epoch in this span was adjusted: there is no transformation to write")
    return paths


def _matrix_text(matrix: Floats) -> str:
    """Return four rows of numbers, to 1e-13 for rotations: 0.001 mm of coordinates of 10,000 km."""
    return "\n".join(" ".join(f"{value:.13f}" for value in row) for row in matrix) + "\n"


def covariance_text(names: Sequence[str], covariance: Floats, where: str) -> str:
    """Return the covariance (6, 6) of a pose as CSV with a first line of comment."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["", *names])
    writer.writerows(
        [name, *(f"{value:.9e}" for value in row)] for name, row in zip(names, covariance, strict=True)
    )
    return f"# rotations in rad, counter-clockwise about axes {where}, shifts in m\n{text.getvalue()}"
