"""Other programs for a map of mean heights or of change: their work on the same scan and grid.

Each job runs in its own process (`python -m benchmarks.peers JOB ARGUMENTS`) and imports only what it needs.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from benchmarks.process_cost import Cost, cost_of, end_startup, job_cost, run_job

Result = dict[str, float]

CHUNK_POINTS = 50_000  # that the decoding baseline decodes at once
CORE_POINTS = 50_000  # of M3C2
CYLINDER_M, NORMAL_RADIUS_M, MAX_DISTANCE_M = 2.0, 4.0, 5.0
ARCHIVE_POINTS = 500
ARCHIVE_UNCERTAINTY = (  # fields that py4dgeo's archive stores per core point and epoch
    ("lodetection", "f8"),
    ("spread1", "f8"),
    ("num_samples1", "i8"),
    ("spread2", "f8"),
    ("num_samples2", "i8"),
)
PDAL_EMPTY = -9999


@dataclass(frozen=True)
class Peer:
    """Another program for part of the work: the module or command it needs, and what it does not compute."""

    name: str
    title: str
    requires: str
    omits: str
    is_command: bool = False

    @property
    def is_installed(self) -> bool:
        """Return True if the module or the command exists."""
        return bool(
            shutil.which(self.requires) if self.is_command else importlib.util.find_spec(self.requires)
        )


OMITTED = "tilt, air, curvature; σ, change"
M3C2 = Peer("m3c2", "py4dgeo M3C2", "py4dgeo", "tilt, air, curvature; shared σ; at 50,000 places only")
PEERS = (
    Peer("scipy", "scipy binned_statistic_2d", "scipy", OMITTED),
    Peer("datashader", "datashader", "datashader", OMITTED),
    Peer("pdal", "PDAL", "pdal", OMITTED, is_command=True),
    Peer("cloudcompare", "CloudCompare", "CloudCompare", f"decoding; {OMITTED}", is_command=True),
    M3C2,
)


@dataclass(frozen=True)
class GridTask:
    """A scan to be put on a grid with its SW corner at (0, 0) by one matrix (4, 4)."""

    scan: str
    earlier_scan: str  # for programs that compute a difference
    matrix: list[list[float]]
    cell_m: float
    nx: int
    ny: int


def peer_cost(peer: Peer, task: GridTask, folder: Path) -> tuple[Cost, Result]:
    """Return the cost of a peer's work in a folder, and its filled `cells` with their `mean_m`."""
    if not peer.is_command:
        return job_cost("benchmarks.peers", peer.name, folder, **vars(task))
    _, prepared = job_cost("benchmarks.peers", f"prepare_{peer.name}", folder, **vars(task))
    cost, _ = cost_of(prepared["command"], folder, {"QT_QPA_PLATFORM": "offscreen"})
    _, result = job_cost("benchmarks.peers", f"read_{peer.name}", folder, **vars(task))
    return cost, result


def decode(scan: str) -> Result:
    """Decode all of a scan on one thread, in chunks: the baseline of all ratios."""
    import laspy

    end_startup()
    points = 0
    with laspy.open(scan, laz_backend=laspy.LazBackend.Lazrs) as reader:
        for chunk in reader.chunk_iterator(CHUNK_POINTS):
            points += len(chunk)
    return {"points": points}


def scipy(task: GridTask) -> Result:
    """Mean heights by scipy."""
    from scipy.stats import binned_statistic_2d

    _import_laspy()
    end_startup()
    x_m, y_m, z_m = _on_grid(task.scan, task)
    limits_m = [[0.0, task.nx * task.cell_m], [0.0, task.ny * task.cell_m]]
    binned = binned_statistic_2d(x_m, y_m, z_m, "mean", bins=[task.nx, task.ny], range=limits_m)
    return _summary(binned.statistic)


def datashader(task: GridTask) -> Result:
    """Mean heights by datashader."""
    import datashader
    import pandas as pd

    _import_laspy()
    limits_m = (0.0, task.nx * task.cell_m), (0.0, task.ny * task.cell_m)
    canvas = datashader.Canvas(task.nx, task.ny, *limits_m)
    mean = datashader.mean("z")
    single = pd.DataFrame({axis: [0.0] for axis in "xyz"})
    canvas.points(single, "x", "y", mean)  # compiles at the first use
    end_startup()
    x_m, y_m, z_m = _on_grid(task.scan, task)
    points = pd.DataFrame({"x": x_m, "y": y_m, "z": z_m}, copy=False)
    return _summary(canvas.points(points, "x", "y", mean).to_numpy())


def prepare_pdal(task: GridTask) -> dict[str, list[str]]:
    """Write PDAL's pipeline; return the command that runs it."""
    stages = [
        {"type": "readers.las", "filename": task.scan},
        {"type": "filters.transformation", "matrix": " ".join(repr(v) for row in task.matrix for v in row)},
        {
            "type": "writers.gdal",
            "filename": "pdal.tif",
            "output_type": "mean",
            "data_type": "float32",
            "binmode": True,  # only the points of the cell itself
            "resolution": task.cell_m,
            "origin_x": 0,
            "origin_y": 0,
            "width": task.nx,
            "height": task.ny,
        },
    ]
    Path("pdal.json").write_text(json.dumps(stages), encoding="utf-8")
    return {"command": ["pdal", "pipeline", "pdal.json"]}


def read_pdal(task: GridTask) -> Result:
    """Return the cells that PDAL filled."""
    import numpy as np
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = task.nx * task.ny
    with Image.open("pdal.tif") as image:
        mean_m = np.array(image)
    return _summary(np.where(mean_m == PDAL_EMPTY, np.nan, mean_m))


def prepare_cloudcompare(task: GridTask) -> dict[str, list[str]]:
    """Decode a scan for CloudCompare, which Debian builds without LAZ and GDAL; return its command."""
    import laspy
    import numpy as np

    xyz_m = laspy.read(task.scan).xyz
    with Path("cloud.ply").open("wb") as out:
        axes = "".join(f"property double {axis}\n" for axis in "xyz")
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz_m)}\n{axes}end_header\n"
        out.write(header.encode() + xyz_m.astype("<f8").tobytes())
    np.savetxt("matrix.txt", np.array(task.matrix), fmt="%.12f")
    return {
        "command": [
            "CloudCompare", "-SILENT", "-NO_TIMESTAMP", "-C_EXPORT_FMT", "PLY",
            "-AUTO_SAVE", "OFF", "-O", "cloud.ply", "-APPLY_TRANS", "matrix.txt",
            "-AUTO_SAVE", "ON", "-RASTERIZE", "-GRID_STEP", str(task.cell_m), "-PROJ", "AVG", "-OUTPUT_CLOUD",
        ]
    }  # fmt: skip


def read_cloudcompare(_task: GridTask) -> Result:
    """Return the cells that CloudCompare filled: one point per cell, whose first fields are x, y and z."""
    import numpy as np

    header, _, body = Path("cloud_RASTER.ply").read_bytes().partition(b"end_header\n")
    count = int(header.split(b"element vertex ")[1].split()[0])
    return _summary(np.frombuffer(body, "<f4").reshape(count, -1)[:, 2])


def m3c2(task: GridTask) -> Result:
    """Change and its level of detection by py4dgeo's M3C2, at some points of the scan."""
    import numpy as np
    import py4dgeo

    _import_laspy()
    end_startup()
    clouds_m = [np.ascontiguousarray(_on_grid(scan, task).T) for scan in (task.earlier_scan, task.scan)]
    size_m = np.array([task.nx, task.ny]) * task.cell_m
    inside = np.flatnonzero(((clouds_m[1][:, :2] >= 0) & (clouds_m[1][:, :2] < size_m)).all(axis=1))
    algorithm = py4dgeo.M3C2(
        epochs=tuple(map(py4dgeo.Epoch, clouds_m)),
        corepoints=clouds_m[1][inside[:: max(len(inside) // CORE_POINTS, 1)]],
        cyl_radius=CYLINDER_M,
        normal_radii=[NORMAL_RADIUS_M],
        max_distance=MAX_DISTANCE_M,
    )
    distances_m, _ = algorithm.run()
    return _summary(distances_m)


def append(epochs: int) -> Result:
    """Append an epoch to py4dgeo's archive of `epochs` epochs; return CPU and wall time of that."""
    import numpy as np
    import py4dgeo

    random, first = np.random.default_rng(1), datetime(2025, 1, 1, tzinfo=UTC)
    corepoints_m = random.uniform(0, 100, (ARCHIVE_POINTS, 3))
    fields = [(name, np.dtype(kind)) for name, kind in ARCHIVE_UNCERTAINTY]
    uncertainty = np.zeros((ARCHIVE_POINTS, epochs), fields)
    for name, kind in ARCHIVE_UNCERTAINTY:
        uncertainty[name] = random.uniform(0.01, 0.05, uncertainty.shape) if kind == "f8" else 5
    analysis = py4dgeo.SpatiotemporalAnalysis("archive.zip", force=True)
    analysis.corepoints = corepoints_m
    analysis.m3c2 = py4dgeo.M3C2(cyl_radius=CYLINDER_M, corepoint_normals=np.array([[0.0, 0.0, 1.0]]))
    analysis.reference_epoch = py4dgeo.Epoch(corepoints_m, timestamp=first)
    analysis.timedeltas = [timedelta(hours=hour) for hour in range(1, epochs + 1)]
    analysis.distances = random.normal(0, 0.02, (ARCHIVE_POINTS, epochs))
    analysis.uncertainties = uncertainty
    del analysis.distances, analysis.uncertainties  # read back from disk, as by a new process
    newest = py4dgeo.Epoch(corepoints_m, timestamp=first + timedelta(hours=epochs + 1))
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    analysis.add_epochs(newest)
    return {"cpu_s": time.process_time() - start_cpu_s, "wall_s": time.monotonic() - start_s}


def _import_laspy() -> None:
    """Import the decoder, so that its import counts as start-up."""
    importlib.import_module("laspy")


def _on_grid(scan: str, task: GridTask) -> Any:  # noqa: ANN401 - numpy is imported by the jobs alone
    """Return all points of a scan on the grid, (3, n) [m]."""
    import laspy
    import numpy as np

    matrix = np.array(task.matrix)
    return matrix[:3, :3] @ laspy.read(scan).xyz.T + matrix[:3, 3:]


def _summary(mean_m: Any) -> Result:  # noqa: ANN401 - as above
    """Return the number of filled cells and their mean."""
    import numpy as np

    filled = np.isfinite(mean_m)
    return {"cells": int(filled.sum()), "mean_m": float(mean_m[filled].mean(dtype=np.float64))}


if __name__ == "__main__":
    grid_jobs = scipy, datashader, prepare_pdal, read_pdal, prepare_cloudcompare, read_cloudcompare, m3c2
    run_job(
        {"decode": decode, "append": append}
        | {job.__name__: lambda job=job, **task: job(GridTask(**task)) for job in grid_jobs}
    )
