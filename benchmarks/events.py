"""Events of the station against the 4D objects-by-change of py4dgeo, on the same simulated series.

python -m benchmarks.events [--hours N] [--blocks N] [--seeds N]

The series are means of blocks of 10 m over a glacier: random errors with the tails of Student's t (5), tilt
and stripes along the line of sight of each scan, steady melt that differs from place to place, and rock at
whose edges blocks jump. A disc of 0.3 m appears at a random place; the series without are quiet. py4dgeo gets
the same series, with a height threshold of six times the sigma of a block at 2 km, and the parameters of its
example.
"""

from __future__ import annotations

import argparse
import logging
import resource
import time
from dataclasses import dataclass
from datetime import timedelta

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats
from station.science.time_series.event_tracks import Track, track_events
from station.science.time_series.events import (
    BlockErrors,
    BlockLevels,
    Region,
    detect_regions,
    event_thresholds,
)

AREAS_M2 = (200, 500, 1000, 3000)
DEPTH_M, EVENT_HOUR, BLOCK_M = 0.3, 30, 10.0
SYSTEMATIC_RAD, MELT_M_PER_H = 5e-6, 0.003
HISTORY, LEAST_HISTORY = 24, 8
HOURS_PER_YEAR = 8766
FINE = 10  # samples along the edge of a block


@dataclass(frozen=True)
class Series:
    """Change (n, by, bx) of blocks over hours, its errors, and where the event is."""

    change_m: Floats
    random_m: Floats
    systematic_m2: Floats
    rock: Bools
    event: Bools  # blocks at least half covered; none if quiet


@dataclass
class Score:
    """Events found and false alarms over several series."""

    found: int = 0
    events: int = 0
    false_alarms: int = 0
    hours: int = 0
    cpu_s: float = 0.0


def simulate(seed: int, size: int, hours: int, area_m2: float) -> Series:
    """Return a series with an event of an area, 0 for none."""
    rng = np.random.default_rng(seed)
    row, column = np.indices((size, size))
    range_m = BLOCK_M * np.hypot(row - size / 2, column + 20)
    azimuth = np.arctan2(row - size / 2, column + 20)
    rock = column < size // 5
    random_m = 0.004 + 0.01 * range_m / 1000
    melt = np.where(rock, 0.0, 1 + 0.5 * ndimage.gaussian_filter(rng.normal(size=rock.shape), 3) / 0.094)
    edge = rock & (rng.random(size) < 0.05)[None, :]
    surface_m = np.zeros(rock.shape)
    if area_m2:
        place = rng.uniform(5, size - 5), rng.uniform(size // 5 + 5, size - 5)
        surface_m = _disc(size, place, area_m2)
    change_m = np.empty((hours, size, size), np.float32)
    for hour in range(hours):
        stripes = np.interp(azimuth, np.linspace(-1.6, 1.6, 90), rng.normal(size=90) * SYSTEMATIC_RAD)
        tilt = rng.normal(size=2) * SYSTEMATIC_RAD
        errors_m = range_m * (stripes + tilt[0] * np.cos(azimuth) + tilt[1] * np.sin(azimuth))
        errors_m += random_m * rng.standard_t(5, rock.shape) / np.sqrt(5 / 3)
        errors_m += np.where(edge & (rng.random(size) < 0.3)[None, :], 0.6, 0.0)
        change_m[hour] = errors_m - MELT_M_PER_H * hour * melt + (hour >= EVENT_HOUR) * surface_m
    return Series(change_m, random_m, (2 * SYSTEMATIC_RAD * range_m) ** 2, rock, surface_m > DEPTH_M / 2)


def _disc(size: int, place: tuple[float, float], area_m2: float) -> Floats:
    y, x = (np.indices((size * FINE, size * FINE)) + 0.5) / FINE
    inside = (y - place[0]) ** 2 + (x - place[1]) ** 2 < area_m2 / BLOCK_M**2 / np.pi
    return DEPTH_M * inside.reshape(size, FINE, size, FINE).mean(axis=(1, 3))


def station_objects(series: Series) -> list[tuple[int, Bools]]:
    """Return hour of confirmation and blocks of the local events."""
    levels = [BlockLevels(change_m.astype(float), series.random_m**2) for change_m in series.change_m]
    thresholds = event_thresholds(series.rock.size, HOURS_PER_YEAR)
    errors = BlockErrors(*[series.systematic_m2] * 3)

    def regions(hour: int) -> list[Region]:
        history, pair = levels[max(hour - HISTORY - 1, 0) : hour - 1], levels[hour - 1 : hour + 1]
        return detect_regions(history, pair, (errors, errors), series.rock, thresholds)

    detected = ((hour, regions(hour)) for hour in range(LEAST_HISTORY + 1, len(levels)))
    tracks: list[Track] = track_events(detected, series.rock.size)
    return [(track.first, track.blocks) for track in tracks if not track.widespread]


def py4dgeo_objects(series: Series) -> list[tuple[int, Bools]]:
    """Return hour of the start and blocks of the objects of py4dgeo."""
    import py4dgeo  # noqa: PLC0415

    logging.getLogger("py4dgeo").setLevel(logging.ERROR)
    hours, *shape = series.change_m.shape
    row, column = (index.ravel() * BLOCK_M for index in np.indices(shape))
    points = np.c_[column, row, np.zeros(len(row))]
    analysis = py4dgeo.SpatiotemporalAnalysis("/tmp/objects.zip", force=True)  # noqa: S108
    analysis.reference_epoch = py4dgeo.Epoch(points, timestamp="2025-01-01T00:00:00")
    analysis.corepoints = analysis.reference_epoch
    analysis.timedeltas = [timedelta(hours=hour) for hour in range(hours)]
    analysis.distances = series.change_m.reshape(hours, -1).T.astype(float)
    growing = py4dgeo.RegionGrowingAlgorithm(
        neighborhood_radius=1.5 * BLOCK_M, min_segments=2, window_width=6, window_min_size=3, minperiod=3,
        height_threshold=6 * 0.024, thresholds=[0.5, 0.6, 0.7, 0.8],
    )  # fmt: skip
    objects = []
    for found in growing.run(analysis):
        blocks = np.zeros(shape[0] * shape[1], bool)
        blocks[list(found.indices)] = True
        objects.append((int(found.start_epoch), blocks.reshape(shape)))
    return objects


def score(series: Series, objects: list[tuple[int, Bools]], total: Score, within_h: int) -> None:
    """Count an event as found if an object overlaps it and begins in time; all others are false alarms."""
    hits = [
        bool((blocks & series.event).any()) and abs(hour - EVENT_HOUR) <= within_h for hour, blocks in objects
    ]
    total.events += bool(series.event.any())
    total.found += any(hits)
    total.false_alarms += len(hits) - sum(hits)
    total.hours += len(series.change_m)


def main() -> None:
    """Print a table of both programs."""
    parser = argparse.ArgumentParser(description="Events against py4dgeo on simulated series.")
    parser.add_argument("--hours", type=int, default=48)
    parser.add_argument("--blocks", type=int, default=60, help="along the edge of the grid")
    parser.add_argument("--seeds", type=int, default=3, help="of each area")
    parser.add_argument("--only", choices=["station", "py4dgeo"])
    args = parser.parse_args()
    programs = {"station": (station_objects, 1), "py4dgeo": (py4dgeo_objects, 6)}
    for name, (find, within_h) in programs.items():
        if args.only not in {None, name}:
            continue
        for area_m2 in (0, *AREAS_M2):
            total = Score()
            for seed in range(args.seeds):
                series = simulate(100 * seed + area_m2, args.blocks, args.hours, area_m2)
                started_s = time.process_time()
                objects = find(series)
                total.cpu_s += time.process_time() - started_s
                score(series, objects, total, within_h)
            peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            print(
                f"{name:8} {area_m2:5} m² found {total.found}/{total.events} false {total.false_alarms}"
                f" in {total.hours} h, {1000 * total.cpu_s / total.hours:.0f} ms/scan, peak {peak_gb:.2f} GB",
                flush=True,
            )


if __name__ == "__main__":
    main()
