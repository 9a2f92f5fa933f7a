"""One scan from shots to surface: the whole science on one page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from station.quantities import (
    Bools,
    Floats,
    Floats32,
    Measurement,
    Quality,
    Reals,
    Reference,
    Setup,
    Shared,
    Shots,
    Tilt,
)
from station.science import ground, prior, shared
from station.science.adjustment import Adjustment, adjust, turned
from station.science.grid import Gridder
from station.science.measuring import Judge, measured
from station.science.normals import LineLog
from station.science.outlook import Outlook, Trait, look
from station.science.patches import Cells, collect
from station.science.pose import Frame, Turning, turning
from station.science.shared import Basis, Sensitivities

NORMAL_MAD = 0.6744897501960817  # of a normal distribution with a standard deviation of one
FEW_STABLE = 20  # cells, that say nothing of a spread


@dataclass(frozen=True)
class Pose:
    """How the scanner stood: the way to the map, and the lean on top of it. No frame: already on the map."""

    frame: Frame | None
    tilt: Tilt | None

    @cached_property
    def upright(self) -> Turning:
        """How shots are turned into the frame at the scanner: by the tilt of their moment, then the SOP."""
        return turning(self.tilt, np.eye(3) if self.frame is None else self.frame.to_local[:3, :3])


def outlook_on(reference: Reference, setup: Setup, stable: Bools) -> Outlook:
    """Look at a reference as scans do; `stable` (ny, nx) is ground known for it."""
    return look(
        reference, stable, setup.scanner, setup.position_m, setup.axis, published=setup.published_budget
    )


def gridder_for(setup: Setup, outlook: Outlook | None) -> Gridder:
    """Return an empty grid that measures from a reference, if there is one."""
    ground = outlook.ground() if outlook is not None else None
    return Gridder(setup.grid, ground, setup.position_m[2] if setup.position_m else 0.0)


def survey(gridder: Gridder, blocks: Iterable[Shots], pose: Pose, progress: Callable[[], None]) -> None:
    """Lay every shot of a scan on the grid."""
    for shots in blocks:
        lay(gridder, to_map(shots, pose), shots.intensity)
        progress()
    gridder.complete()


def to_map(shots: Shots, pose: Pose) -> Floats:
    """Easting, northing and height (3, n) of shots [m]: lean, SOP, then air and map."""
    if pose.frame is None:
        return shots.xyz_m
    time_s = np.zeros(len(shots)) if shots.time_s is None else shots.time_s
    return pose.frame.to_map(pose.upright.turned(shots.xyz_m, time_s))


def lay(gridder: Gridder, points_m: Floats, intensity: Floats | None = None) -> None:
    """Add points (3, n) on the map to the grid, as residuals to the reference where it is known."""
    inside, column, row = gridder.cells(points_m[0], points_m[1])
    number = gridder.numbered(column, row)
    residual_m = points_m[2][inside] - gridder.below(number, column, row)
    gridder.add(number, residual_m, None if intensity is None else intensity[inside])


@dataclass(frozen=True)
class Told:
    """What is known of a scan's scanner beside its shots: how it was turned, what log and weather say.

    `assumed_rad` (3, lines) is the lean its points were turned by, about east, north and up.
    """

    of: Basis
    lines: prior.Lines
    assumed_rad: Floats
    log: LineLog | None
    weather_known: bool


def level(gridder: Gridder, setup: Setup, told: Told, outlook: Outlook) -> Adjustment:
    """Estimate the state of the scanner from a scan on its grid."""
    habits, before = outlook.reference.habits, outlook.reference.shared
    state = prior.beforehand(told.of, told.lines, habits, weather_known=told.weather_known)
    patches = collect(told.of, _cells(gridder, outlook), setup.scanner.range_max_m)
    log = told.log
    if log is not None and before is not None:
        log = log.against(told.of, state.of_reference(before))
    return adjust(patches, told.assumed_rad, state.against(before), log)


def _cells(gridder: Gridder, outlook: Outlook) -> Iterator[Cells]:
    """Give the cells that an adjustment looks at, as the head comes by."""
    for first, whole in outlook.sectors(looked_at=True):
        sums = gridder.sums(first, first + len(whole))
        seen = np.flatnonzero(sums.count > 0)
        if not len(seen):
            continue
        sector, sums = whole.some(seen), sums.some(seen)
        felt = outlook.felt(sector)
        east_m, north_m, _ = outlook.offset_m(sector.cell, sector.height_m)
        yield Cells(
            felt,
            np.hypot(east_m, north_m),
            ground.kinds(
                sector.having(Trait.STABLE),
                sector.having(Trait.WITHHELD),
                sector.having(Trait.SMOOTH),
                ground.looks_unlike(sums.intensity(), outlook.intensity(first + seen)),
            ),
            sums.mean_residual(),
            sector.scatter_m2 / sums.count + sector.before_m2,
            outlook.one_in,
        )


def on_reference(
    gridder: Gridder, outlook: Outlook, levelled: tuple[Told, Adjustment] | None
) -> tuple[Floats32, Floats32]:
    """Random variance of a shot [m²] and what the estimated state does to heights [m], both (ny, nx).

    In the cells that the reference knows and the scan sees, else nought.
    """
    variance_m2, correction_m = (np.zeros(outlook.grid.shape, np.float32) for _ in range(2))
    cell = outlook.cells["cell"][:]
    variance_m2.reshape(-1)[cell] = outlook.cells["shot_m2"][:] * (gridder.sums(0, len(cell)).count > 0)
    if levelled is not None:
        for _, sector in outlook.sectors():
            correction_m.reshape(-1)[sector.cell] = _correction(levelled, outlook.felt(sector))
    return variance_m2, correction_m


def _correction(levelled: tuple[Told, Adjustment], felt: Sensitivities) -> Reals:
    """Return what is to be taken off heights (n,) [m]: the found state, as far as it was not assumed."""
    told, found = levelled
    return np.asarray(found.effect(felt) - turned(felt, told.assumed_rad))


def measure(
    gridder: Gridder,
    setup: Setup,
    unknown: Shared | None,
    outlook: Outlook | None,
    levelled: tuple[Told, Adjustment] | None = None,
) -> Measurement:
    """Turn the sums of a scan into surface, change and their uncertainty, in the memory of the sums.

    `unknown` is what all points of the scan share, against the reference where `levelled` says how it was
    adjusted to that; None where there is nothing to derive it from.
    """
    own = unknown
    if levelled is None and unknown is not None and outlook is not None:
        unknown = shared.against(unknown, outlook.reference.shared)
    correction = None if levelled is None else partial(_correction, levelled)
    return measured(gridder, outlook, Judge(setup, unknown, own, correction))


def stable_figures(measured: Measurement, outlook: Outlook) -> dict[str, float]:
    """Return how a scan does on stable ground it was not fitted to: number of cells, median, spread, z."""
    unused = outlook.having(Trait.STABLE, Trait.WITHHELD)
    unused = unused[(measured.quality[unused] & np.uint8(Quality.STABLE_GROUND)) > 0]
    change_m, sigma_m = measured.change_m[unused], measured.cells["uncertainty_m"][unused]
    figures = {"stable_count": float(len(change_m))}
    if len(change_m) >= FEW_STABLE:
        figures["stable_median"] = float(np.median(change_m))
        figures["stable_nmad"] = _spread(change_m)
        figures["stable_z_std"] = _spread(change_m / sigma_m)
    return figures


def _spread(values: Floats32) -> float:
    """Median absolute deviation, as the standard deviation of a normal distribution."""
    return float(np.median(np.abs(values - np.median(values))) / NORMAL_MAD)
