"""Processing of one scan, from shots to a surface with change and uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from station.quantities import (
    Air,
    Bools,
    Floats,
    Floats32,
    Ints,
    Measurement,
    Quality,
    Reals,
    Reference,
    ScanGeometry,
    SharedParameters,
    Shots,
    TiltSeries,
    VarianceComponents,
)
from station.science.adjustment import ground_classes, prior, variance_components
from station.science.adjustment.ground_change import ThinSnow
from station.science.adjustment.ground_classes import SnowTest
from station.science.adjustment.joint import Adjustment, adjust_scan, tilt_effect
from station.science.adjustment.normal_equations import LineInclination, StatePrior
from station.science.adjustment.patches import (
    CellObservations,
    aggregate_patches,
    distance_along_line,
    line_length,
)
from station.science.analysis import verdict
from station.science.geometry.pose import ScannerToMap, TimedRotation, timed_rotation
from station.science.geometry.robust_statistics import nmad
from station.science.gridding.cell_estimates import CellEstimator, estimate_cells
from station.science.gridding.gridder import Gridder
from station.science.gridding.reference_cells import CellClass
from station.science.gridding.viewing_geometry import ViewingGeometry, compute_viewing_geometry
from station.science.gridding.viewpoints import PositionErrors
from station.science.uncertainty import propagation
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.parameters import ParameterLayout
from station.science.uncertainty.variance_factors import UNIT_FACTORS, VarianceFactors, sampling_ratio

MIN_STABLE_CELLS = 20  # fewer cells give no meaningful statistics
MIN_BRIGHTNESS_SHARE = 0.5  # of the stable cells; less counts as no brightness
MAX_BRIGHTNESS_CELLS = 100_000  # of more stable cells a sample tells the gain and whether there is brightness


@dataclass(frozen=True)
class Pose:
    """Transformation from scanner to map, and tilt. `frame` is None if points are already on the map."""

    frame: ScannerToMap | None
    tilt: TiltSeries | None

    @cached_property
    def rotation(self) -> TimedRotation:
        """Rotation of shots into the local frame at the scanner: tilt at the time of the shot, then SOP."""
        return timed_rotation(self.tilt, np.eye(3) if self.frame is None else self.frame.to_local[:3, :3])

    def rotated(self, rotation_rad: Floats) -> Pose:
        """Return the pose after a further rotation (3,) about east, north and up [rad]."""
        if self.frame is None:
            return self
        to_local = self.frame.to_local.copy()
        to_local[:3, :3] = Rotation.from_rotvec(rotation_rad).as_matrix() @ to_local[:3, :3]
        return replace(self, frame=replace(self.frame, to_local=to_local))


def reference_viewing_geometry(
    reference: Reference, scan_geometry: ScanGeometry, stable: Bools
) -> ViewingGeometry:
    """Return the viewing geometry of a reference; `stable` (ny, nx) marks ground known to be stable."""
    return compute_viewing_geometry(
        reference,
        stable,
        scan_geometry.scanner,
        scan_geometry.position_m,
        scan_geometry.axis,
        published=scan_geometry.published_budget,
    )


def new_gridder(scan_geometry: ScanGeometry, viewing: ViewingGeometry | None) -> Gridder:
    """Return an empty gridder, of residuals to the reference surface if there is one."""
    datum_m = scan_geometry.position_m[2] if scan_geometry.position_m else 0.0
    viewpoints = max(len(scan_geometry.viewpoints), 1)
    if viewing is None:
        return Gridder(scan_geometry.grid, None, datum_m, viewpoints=viewpoints)
    thickness = viewing.layer_thickness(published=scan_geometry.published_budget)
    return Gridder(scan_geometry.grid, viewing.surface(), datum_m, thickness, viewpoints)


def grid_scan(gridder: Gridder, blocks: Iterable[Shots], pose: Pose, progress: Callable[[], None]) -> int:
    """Add all shots of a scan to the grid and end the scan; return their number."""
    count = add_blocks(gridder, blocks, pose, progress)
    gridder.finish()
    return count


def add_blocks(gridder: Gridder, blocks: Iterable[Shots], pose: Pose, progress: Callable[[], None]) -> int:
    """Add all shots of a scan to the grid; return their number."""
    count = 0
    for shots in blocks:
        add_shots(gridder, to_map(shots, pose), shots.intensity, shots.viewpoint)
        count += len(shots)
        progress()
    return count


def to_map(shots: Shots, pose: Pose) -> Floats:
    """Easting, northing and height (3, n) of shots [m]: tilt, SOP, then air and map projection."""
    if pose.frame is None:
        return shots.xyz_m
    time_s = np.zeros(len(shots)) if shots.time_s is None else shots.time_s
    return pose.frame.to_map(pose.rotation.rotate(shots.xyz_m, time_s))


def add_shots(
    gridder: Gridder, points_m: Floats, intensity: Floats | None = None, viewpoint: int = 0
) -> None:
    """Add map points (3, n) to the grid, as residuals to the reference where it has a height."""
    points_m = gridder.grid.plane.from_map(points_m)
    inside, column, row = gridder.locate(points_m[0], points_m[1])
    cell_index = gridder.cell_indices(column, row)
    residual_m = points_m[2][inside] - gridder.datum_height(cell_index, column, row)
    gridder.add(cell_index, residual_m, None if intensity is None else intensity[inside], viewpoint)


@dataclass(frozen=True)
class AdjustmentInputs:
    """Inputs of the adjustment other than residuals: line timing, tilt already applied, log and weather.

    `assumed_rad` (3, lines) is the tilt already applied to the points, about east, north and up. `log` is the
    inclination log by lines, None without one; `time_s` is the start of the scan, since 1970; `air` is what
    was measured at the scanner, None if nothing was.
    """

    params: ParameterLayout
    lines: prior.LineTimes
    assumed_rad: Floats
    log: LineInclination | None
    time_s: float
    air: Air | None


@dataclass(frozen=True)
class ScanAdjustment:
    """The adjustment of a scan to a reference: its inputs, the estimated state, and where snow lay.

    `under_snow` (n,) is True for cells of the reference: of stable ground whose snow has changed or may have.
    """

    inputs: AdjustmentInputs
    state: Adjustment
    under_snow: Bools

    def correction(self, jacobian: HeightJacobian) -> Reals:
        """Return what to subtract from heights (n,) [m]: the effect of the estimated minus assumed state."""
        return np.asarray(self.state.effect(jacobian) - tilt_effect(jacobian, self.inputs.assumed_rad))


def adjust_to_reference(
    gridder: Gridder, scan_geometry: ScanGeometry, inputs: AdjustmentInputs, viewing: ViewingGeometry
) -> ScanAdjustment:
    """Return a gridded scan's adjustment: its tilt, heading, position, range and refraction.

    If it has moved farther than expected, it is estimated again with a prior as wide as the motion.
    """
    components, reference_state = usual_motion(viewing.reference, inputs.time_s), viewing.reference.shared
    test = _snow_test(gridder, scan_geometry, viewing)
    under_snow = _under_snow(gridder, viewing, test)
    cells = _cells(gridder, viewing, under_snow)
    extent_m = line_length(scan_geometry.grid, scan_geometry.scanner.range_max_m)
    patches = aggregate_patches(inputs.params, cells, *extent_m)

    def prior_and_log(components: VarianceComponents) -> tuple[StatePrior, LineInclination | None]:
        state_prior = prior.state_prior(
            inputs.params, inputs.lines, components, weather_known=inputs.air is not None
        )
        log = inputs.log
        if log is not None and reference_state is not None:
            log = log.relative_to(inputs.params, state_prior.reference_covariance(reference_state))
        return state_prior.relative_to(reference_state), log

    def wider(estimate: Floats) -> tuple[StatePrior, LineInclination | None] | None:
        widened = variance_components.as_wide_as(components, estimate)
        return None if widened == components else prior_and_log(widened)

    thin_snow = ThinSnow(
        None if inputs.air is None else inputs.air.temperature_c,
        *ground_classes.unseen_snow(scan_geometry.scanner.wavelength_um),
        shows=_snow_shows(gridder, scan_geometry, viewing) if np.isfinite(test.gain) else None,
    )
    state = adjust_scan(
        patches, inputs.assumed_rad, *prior_and_log(components), thin_snow, reference_state, wider
    )
    return ScanAdjustment(inputs, state, under_snow)


def usual_motion(reference: Reference, time_s: float) -> VarianceComponents:
    """Return the variance components of a scan at a time [s since 1970] relative to a reference."""
    elapsed_s = abs(time_s - reference.time_s)
    return variance_components.after(reference.components, elapsed_s if np.isfinite(elapsed_s) else 0.0)


def _under_snow(gridder: Gridder, viewing: ViewingGeometry, test: SnowTest) -> Bools:
    """Return True for cells (n,) of a reference: of stable ground whose snow has changed or may have."""
    stable = viewing.select(CellClass.STABLE)
    stable = stable[gridder.count[stable] > 0]
    brightness = _intensity(gridder, viewing, stable)
    cell, cell_class = (viewing.cells[name][:].take(stable) for name in ("cell", "cell_class"))
    changed = test.changed(*brightness, (cell_class & np.uint8(CellClass.STEEP)) > 0)
    changed |= ground_classes.beside_snow(cell, test.shows(*brightness), viewing.grid)
    snow = np.zeros(gridder.reference_cells, bool)
    snow[stable] = changed
    return snow


def _snow_test(gridder: Gridder, scan_geometry: ScanGeometry, viewing: ViewingGeometry) -> SnowTest:
    """Return the test of a gridded scan for snow on stable ground."""
    intensity, reference = _stable_intensity(gridder, viewing, CellClass.STEEP)
    _, stable_reference = _stable_intensity(gridder, viewing)
    wavelength_um = scan_geometry.scanner.wavelength_um
    return ground_classes.snow_test(intensity, reference, stable_reference, wavelength_um)


def _snow_shows(gridder: Gridder, scan_geometry: ScanGeometry, viewing: ViewingGeometry) -> bool | None:
    """Return True if brightness shows snow on stable ground, False if none, None if it cannot tell."""
    steep_rock = _observed(gridder, viewing, CellClass.BARE, CellClass.STEEP)
    cell_index = np.concatenate([_observed(gridder, viewing, CellClass.STABLE), steep_rock])
    cell, height_m, cell_class = (
        viewing.cells[name][:].take(cell_index) for name in ("cell", "height_m", "cell_class")
    )
    return ground_classes.snow_shows(
        *_intensity(gridder, viewing, cell_index),
        viewing.grid.plane.horizontal_m(viewing.offset_m(cell, height_m)),
        (cell_class & np.uint8(CellClass.STEEP)) > 0,
        scan_geometry.scanner.wavelength_um,
    )


def no_brightness(gridder: Gridder, scan_geometry: ScanGeometry, viewing: ViewingGeometry | None) -> str:
    """Return why brightness cannot tell whether snow lies on stable ground; empty if it can.

    For that it must be known, in scan and reference, for most of the stable cells that the scan observed, and
    be on a scale that tells snow from rock.
    """
    known = np.zeros(0, bool)
    if viewing is not None:
        intensity, reference = _stable_intensity(gridder, viewing)
        known = np.isfinite(intensity) & np.isfinite(reference)
    if not (known.mean() > MIN_BRIGHTNESS_SHARE if len(known) else gridder.has_intensity):
        return verdict.NO_BRIGHTNESS
    if viewing is None or np.isfinite(_snow_test(gridder, scan_geometry, viewing).gain):
        return ""
    return verdict.BRIGHT_GROUND


def _stable_intensity(
    gridder: Gridder, viewing: ViewingGeometry, *classes: CellClass
) -> tuple[Floats32, Floats32]:
    """Return the intensity (m,) of stable cells of the given classes in a scan and in its reference."""
    return _intensity(gridder, viewing, _observed(gridder, viewing, CellClass.STABLE, *classes))


def _observed(gridder: Gridder, viewing: ViewingGeometry, *classes: CellClass) -> Ints:
    """Return the indices (m,) of cells of all the given classes that a scan observed; of many a sample."""
    cell_index = viewing.select(*classes)
    cell_index = cell_index[:: 1 + len(cell_index) // MAX_BRIGHTNESS_CELLS]
    return cell_index[gridder.count[cell_index] > 0]


def _intensity(gridder: Gridder, viewing: ViewingGeometry, cell_index: Ints) -> tuple[Floats32, Floats32]:
    """Return the intensity of cells (m,) in a scan and in its reference."""
    return gridder.intensity(cell_index), viewing.cells["intensity"][:].take(cell_index)


def _cells(gridder: Gridder, viewing: ViewingGeometry, snow: Bools) -> Iterator[CellObservations]:
    """Yield the cells that an adjustment uses, in the order of the head's azimuth."""
    for first, all_cells in viewing.sectors(sampled=True):
        sums = gridder.sums(first, first + len(all_cells))
        observed = np.flatnonzero(sums.count > 0)
        if not len(observed):
            continue
        sector, sums = all_cells.take(observed), sums.take(observed)
        jacobian = viewing.jacobian(sector)
        offset_m = viewing.offset_m(sector.cell, sector.height_m)
        yield CellObservations(
            jacobian,
            distance_along_line(viewing.grid, sector.cell, offset_m),
            viewing.grid.plane.in_map_axes(offset_m)[2],
            ground_classes.classify(
                sector.in_class(CellClass.STABLE),
                sector.in_class(CellClass.HOLDOUT),
                sector.in_class(CellClass.SMOOTH),
                snow[first + observed],
            ),
            sums.mean_residual() - sector.mean_residual_m,
            sector.point_variance_m2 / sums.count + sector.reference_variance_m2,
            sampling_ratio(sector.noise_class),
            viewing.sampling_step,
        )


def stacking_inputs(
    gridder: Gridder, viewing: ViewingGeometry, adjustment: ScanAdjustment | None
) -> tuple[Floats32, Floats32]:
    """Random variance of a shot [m²] and height correction of the estimated state [m], both (ny, nx).

    Zero in cells without reference; the variance also in cells that the scan did not observe.
    """
    variance_m2, correction_m = (np.zeros(viewing.grid.shape, np.float32) for _ in range(2))
    cell = viewing.cells["cell"][:]
    variance_m2.reshape(-1)[cell] = viewing.cells["shot_m2"][:] * (gridder.sums(0, len(cell)).count > 0)
    if adjustment is not None:
        for _, sector in viewing.sectors():
            correction_m.reshape(-1)[sector.cell] = adjustment.correction(viewing.jacobian(sector))
    return variance_m2, correction_m


def mean_correction(viewing: ViewingGeometry, adjustments: Sequence[ScanAdjustment]) -> Floats32:
    """Return the mean height correction of several scans [m] in all cells of a reference (ny, nx).

    Zero without adjustments, and for scans whose parameters differ, as after a relocation of the scanner.
    """
    correction_m = np.zeros(viewing.grid.shape, np.float32)
    if not adjustments or len({adjustment.inputs.params.names for adjustment in adjustments}) > 1:
        return correction_m
    assumed_rad = np.mean([adjustment.inputs.assumed_rad for adjustment in adjustments], axis=0)
    estimate = np.mean([adjustment.state.estimate for adjustment in adjustments], axis=0)
    first = adjustments[0]
    mean = replace(
        first,
        inputs=replace(first.inputs, assumed_rad=assumed_rad),
        state=replace(first.state, estimate=estimate),
    )
    for _, sector in viewing.sectors():
        correction_m.reshape(-1)[sector.cell] = mean.correction(viewing.jacobian(sector))
    return correction_m


def measure(
    gridder: Gridder,
    scan_geometry: ScanGeometry,
    posterior: SharedParameters | None,
    viewing: ViewingGeometry | None,
    adjustment: ScanAdjustment | None = None,
    factors: VarianceFactors = UNIT_FACTORS,
    position_errors: PositionErrors | None = None,
) -> Measurement:
    """Return surface, change and their uncertainty of a gridded scan; overwrites the gridder's buffers.

    `posterior` are the parameters that all points of the scan share: relative to the reference if
    `adjustment` is given, which adjusted the scan to it; None if nothing is known of them. Of the `factors`
    the posterior and the errors of several scan positions already contain the systematic one.
    """
    independent = posterior
    if adjustment is None and posterior is not None and viewing is not None:
        posterior = propagation.difference_to_reference(posterior, viewing.reference.shared)
    correction, under_snow = (adjustment.correction, adjustment.under_snow) if adjustment else (None, None)
    estimator = CellEstimator(
        scan_geometry, posterior, independent, correction, under_snow, factors, position_errors
    )
    return estimate_cells(gridder, viewing, estimator)


def holdout_statistics(measurement: Measurement, viewing: ViewingGeometry) -> dict[str, float]:
    """Return statistics of a scan on hold-out stable ground: number of cells, median [m], NMAD [m], z [1]."""
    holdout = viewing.select(CellClass.STABLE, CellClass.HOLDOUT)
    holdout = holdout[(measurement.quality[holdout] & np.uint8(Quality.STABLE_GROUND)) > 0]
    change_m, sigma_m = measurement.change_m[holdout], measurement.cells["uncertainty_m"][holdout]
    statistics = {"stable_count": float(len(change_m))}
    if len(change_m) >= MIN_STABLE_CELLS:
        statistics["stable_median"] = float(np.median(change_m))
        statistics["stable_nmad"] = nmad(change_m)
        statistics["stable_z_std"] = nmad(change_m / sigma_m)
    return statistics
