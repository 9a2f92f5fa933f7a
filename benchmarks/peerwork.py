"""The work of each peer: the same scan on the same grid, mean heights or their change."""

from __future__ import annotations

import json
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from benchmarks.cost import ready, run_job
from benchmarks.peers import Work

Figures = dict[str, float]
Command = dict[str, list[str]]

CHUNK = 50_000  # points that the floor decodes at once
CORE_POINTS = 50_000  # of M3C2
CYLINDER_M, NORMALS_M, FARTHEST_M = 2.0, 4.0, 5.0
ARCHIVED_PLACES = 500
UNCERTAINTY = (  # what py4dgeo's archive keeps of each place and epoch
    ("lodetection", "f8"),
    ("spread1", "f8"),
    ("num_samples1", "i8"),
    ("spread2", "f8"),
    ("num_samples2", "i8"),
)
PDAL_EMPTY = -9999


def decode(scan: str) -> Figures:
    """Decode all of a scan on one thread, in chunks: the floor."""
    points = 0
    with laspy.open(scan, laz_backend=laspy.LazBackend.Lazrs) as opened:
        for chunk in opened.chunk_iterator(CHUNK):
            points += len(chunk)
    return {"points": points}


def scipy(work: Work) -> Figures:
    """Mean heights by scipy."""
    from scipy.stats import binned_statistic_2d

    ready()
    x_m, y_m, z_m = _on_grid(work.scan, work)
    limits_m = [(0.0, work.nx * work.cell_m), (0.0, work.ny * work.cell_m)]
    binned = binned_statistic_2d(x_m, y_m, z_m, "mean", bins=[work.nx, work.ny], range=limits_m)
    return _told(binned.statistic)


def datashader(work: Work) -> Figures:
    """Mean heights by datashader."""
    import datashader
    import pandas as pd

    limits_m = (0.0, work.nx * work.cell_m), (0.0, work.ny * work.cell_m)
    canvas = datashader.Canvas(work.nx, work.ny, *limits_m)
    mean = datashader.mean("z")
    canvas.points(
        pd.DataFrame({axis: [0.0] for axis in "xyz"}), "x", "y", mean
    )  # it compiles at its first use
    ready()
    x_m, y_m, z_m = _on_grid(work.scan, work)
    points = pd.DataFrame({"x": x_m, "y": y_m, "z": z_m}, copy=False)
    return _told(canvas.points(points, "x", "y", mean).to_numpy())


def pdal_before(work: Work) -> Command:
    """Write PDAL's pipeline; return the command that runs it."""
    stages = [
        {"type": "readers.las", "filename": work.scan},
        {"type": "filters.transformation", "matrix": " ".join(repr(v) for row in work.matrix for v in row)},
        {
            "type": "writers.gdal",
            "filename": "pdal.tif",
            "output_type": "mean",
            "data_type": "float32",
            "binmode": True,  # the points of the cell alone
            "resolution": work.cell_m,
            "origin_x": 0,
            "origin_y": 0,
            "width": work.nx,
            "height": work.ny,
        },
    ]
    Path("pdal.json").write_text(json.dumps(stages), encoding="utf-8")
    return {"command": ["pdal", "pipeline", "pdal.json"]}


def pdal_after(work: Work) -> Figures:
    """Return what PDAL filled."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = work.nx * work.ny
    with Image.open("pdal.tif") as image:
        mean_m = np.array(image)
    return _told(np.where(mean_m == PDAL_EMPTY, np.nan, mean_m))


def cloudcompare_before(work: Work) -> Command:
    """Decode a scan for CloudCompare, which Debian builds without LAZ and GDAL; return its command."""
    xyz_m = laspy.read(work.scan).xyz
    with Path("cloud.ply").open("wb") as out:
        axes = "".join(f"property double {axis}\n" for axis in "xyz")
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz_m)}\n{axes}end_header\n"
        out.write(head.encode() + xyz_m.astype("<f8").tobytes())
    np.savetxt("matrix.txt", np.array(work.matrix), fmt="%.12f")
    return {
        "command": [
            "CloudCompare", "-SILENT", "-NO_TIMESTAMP", "-C_EXPORT_FMT", "PLY",
            "-AUTO_SAVE", "OFF", "-O", "cloud.ply", "-APPLY_TRANS", "matrix.txt",
            "-AUTO_SAVE", "ON", "-RASTERIZE", "-GRID_STEP", str(work.cell_m), "-PROJ", "AVG", "-OUTPUT_CLOUD",
        ]
    }  # fmt: skip


def cloudcompare_after(_: Work) -> Figures:
    """Return what CloudCompare filled: a point a cell, x, y and z the first of its fields."""
    head, _, body = Path("cloud_RASTER.ply").read_bytes().partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    return _told(np.frombuffer(body, "<f4").reshape(count, -1)[:, 2])


def m3c2(work: Work) -> Figures:
    """Change and its level of detection by py4dgeo's M3C2, at some of the scan's own points."""
    import py4dgeo

    ready()
    clouds_m = [np.ascontiguousarray(_on_grid(scan, work).T) for scan in (work.before, work.scan)]
    size_m = np.array([work.nx, work.ny]) * work.cell_m
    inside = np.flatnonzero(((clouds_m[1][:, :2] >= 0) & (clouds_m[1][:, :2] < size_m)).all(axis=1))
    change = py4dgeo.M3C2(
        epochs=tuple(map(py4dgeo.Epoch, clouds_m)),
        corepoints=clouds_m[1][inside[:: max(len(inside) // CORE_POINTS, 1)]],
        cyl_radius=CYLINDER_M,
        normal_radii=[NORMALS_M],
        max_distance=FARTHEST_M,
    )
    distances_m, _ = change.run()
    return _told(distances_m)


def append(epochs: int) -> Figures:
    """Append an epoch to py4dgeo's archive of so many; return what that took."""
    import py4dgeo

    random, first = np.random.default_rng(1), datetime(2025, 1, 1, tzinfo=UTC)
    places_m = random.uniform(0, 100, (ARCHIVED_PLACES, 3))
    held = np.zeros((ARCHIVED_PLACES, epochs), [(name, np.dtype(kind)) for name, kind in UNCERTAINTY])
    for name, kind in UNCERTAINTY:
        held[name] = random.uniform(0.01, 0.05, held.shape) if kind == "f8" else 5
    analysis = py4dgeo.SpatiotemporalAnalysis("archive.zip", force=True)
    analysis.corepoints = places_m
    analysis.m3c2 = py4dgeo.M3C2(cyl_radius=CYLINDER_M, corepoint_normals=np.array([[0.0, 0.0, 1.0]]))
    analysis.reference_epoch = py4dgeo.Epoch(places_m, timestamp=first)
    analysis.timedeltas = [timedelta(hours=one) for one in range(1, epochs + 1)]
    analysis.distances = random.normal(0, 0.02, (ARCHIVED_PLACES, epochs))
    analysis.uncertainties = held
    del analysis.distances, analysis.uncertainties  # from memory: the next process has them on disk
    newest = py4dgeo.Epoch(places_m, timestamp=first + timedelta(hours=epochs + 1))
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    analysis.add_epochs(newest)
    return {
        "cpu_s": time.process_time() - began_cpu_s,
        "wall_s": time.monotonic() - began_s,
        "places": analysis.distances.shape[0],
        "epochs": analysis.distances.shape[1],
    }


def _on_grid(scan: str, work: Work) -> NDArray[np.float64]:
    """Return all points of a scan on the grid, (3, n) [m]."""
    way = np.array(work.matrix)
    return np.asarray(way[:3, :3] @ laspy.read(scan).xyz.T + way[:3, 3:])


def _told(mean_m: NDArray[np.floating]) -> Figures:
    seen = np.isfinite(mean_m)
    return {"cells": int(seen.sum()), "mean_m": float(mean_m[seen].mean(dtype=np.float64))}


if __name__ == "__main__":
    works = scipy, datashader, pdal_before, pdal_after, cloudcompare_before, cloudcompare_after, m3c2
    run_job(
        {"decode": decode, "append": append}
        | {one.__name__: lambda one=one, **told: one(Work(**told)) for one in works}
    )
