"""Verdict of an epoch and its reasons, from the scan and the reference version it was measured against.

Nothing is remembered between scans, so a reprocessed scan gets the same verdict.
Source: adjustment.md, 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Ints, Ints32, Measurement, VarianceComponents
from station.science.adjustment.joint import Adjustment
from station.science.geometry.robust_statistics import NORMAL_MAD
from station.science.gridding.reference_cells import VISIBILITY_ARRAYS, VISIBILITY_BIN_M, CellClass
from station.science.gridding.viewing_geometry import ViewingGeometry
from station.science.uncertainty.parameters import TILT_KNOT_RAD, TILT_KNOTS_PER_REFRACTION

MAX_REJECTED_SHARE = 0.3  # of the stable ground, rejected by the adjustment
MAX_MEAN_SIGMA_M = 0.05  # of the mean change of moving ground
MOVED_SIGMAS = 4.0  # of the usual motion from scan to scan, and of the error of its estimate
MIN_VISIBILITY = 0.75  # of the usual cells; less is not due to chance
UNUSABLE_VISIBILITY = 0.02  # of the usual cells; less is unusable
CLEAR_RANGE_SHARE = 0.9  # of the best range bin; there the air is clear enough to detect an empty sector
EMPTY_SHARE = 0.05  # of the usual cells of a sector or range bin; less counts as empty
# Of the usual cells of a mean sector. Neighbouring sectors that have fewer show near ground only, which a
# bank of snow may hide.
HIDDEN_SHARE = 0.25
MIN_CELLS = 30  # usually visible; fewer are not tested
MAX_HOLDOUT_Z_STD = 3.0  # of hold-out stable ground
MAX_MISFIT_SIGMAS = 5.0  # of an unadjusted scan; beyond, its sigma does not cover the error
MIN_STABLE_CELLS = 20
MAX_MISFIT_CELLS = 100_000  # larger sets are thinned for the misfit
MAX_AIRBORNE_ECHO_SHARE = 0.001  # of the points on the grid; more are not from a few particles in clear air
NO_BRIGHTNESS = "no brightness: snow on stable ground cannot be recognised"
BRIGHT_GROUND = (
    "no brightness: stable ground is too bright for a linear scale; if it is in decibels, set scans.intensity"
)


@dataclass(frozen=True)
class Visibility:
    """Cells usually visible and cells observed by one scan, by sector of head azimuth and by range.

    `sector_edges_deg` (sectors + 1,) are clockwise from grid north.
    """

    expected: Floats  # (sectors, stretches)
    observed: Floats  # (sectors, stretches)
    sector_edges_deg: Floats

    @property
    def share(self) -> float:
        """Observed share of the usually visible cells; 1.0 if too few cells are usually visible."""
        expected = float(self.expected.sum())
        return float(self.observed.sum()) / expected if expected >= MIN_CELLS else 1.0


def visibility(count: Ints32, viewing: ViewingGeometry) -> Visibility:
    """Return the cells a scan with `count` (n,) points per cell observed, and those usually visible.

    Raises ValueError if the viewing geometry has no scanner position.
    """
    params = viewing.params
    if params is None:
        raise ValueError("visibility needs a viewing geometry with a scanner position")
    shape = sectors, range_bins = viewing.visibility_shape
    share, bin_index = (viewing.cells[name][:] for name in VISIBILITY_ARRAYS)
    expected = np.bincount(bin_index, np.nan_to_num(share), sectors * range_bins).astype(np.float64)
    present = (share > 0) & (count[viewing.sampled] > 0)
    observed = np.bincount(bin_index, present, sectors * range_bins).astype(np.float64)
    edges = params.start_rad + TILT_KNOT_RAD * TILT_KNOTS_PER_REFRACTION * np.arange(sectors + 1)
    step = viewing.sampled.step
    return Visibility(expected.reshape(shape) * step, observed.reshape(shape) * step, np.degrees(edges))


def obstructions(visible: Visibility) -> list[str]:
    """Return messages about the usual cells that are not visible: whole sectors, or a general loss.

    A sector is missing if it is empty at ranges at which the other sectors are almost complete. A few
    near cells may be hidden, which does not count.
    """
    expected_by_sector = visible.expected.sum(axis=1)
    empty = visible.observed.sum(axis=1) < EMPTY_SHARE * expected_by_sector
    observed_share = visible.observed[~empty].sum(axis=0) / np.maximum(
        visible.expected[~empty].sum(axis=0), MIN_CELLS
    )
    clear = observed_share > CLEAR_RANGE_SHARE * max(observed_share.max(), MIN_VISIBILITY)
    missing = empty & (visible.expected @ clear >= MIN_CELLS)
    hidden_cells = HIDDEN_SHARE * expected_by_sector.sum() / max(np.count_nonzero(expected_by_sector), 1)
    for first, end in _runs(missing):
        missing[first:end] = expected_by_sector[first:end].sum() > hidden_cells
    reasons = []
    if missing.any():
        sectors = _format_sectors(missing, visible.sector_edges_deg)
        reasons.append(f"partial sweep: no points at azimuth {sectors} degrees")
    expected, observed = visible.expected[~missing].sum(axis=0), visible.observed[~missing].sum(axis=0)
    if expected.sum() >= MIN_CELLS and observed.sum() < MIN_VISIBILITY * expected.sum():
        message = f"{observed.sum() / expected.sum():.0%} of the usually visible cells observed"
        observed_bins = np.flatnonzero((expected >= MIN_CELLS) & (observed >= EMPTY_SHARE * expected))
        expected_beyond = expected[observed_bins[-1] + 1 :].sum() if len(observed_bins) else 0.0
        if expected_beyond >= MIN_CELLS:
            message += f", none beyond {(observed_bins[-1] + 1) * VISIBILITY_BIN_M:.0f} m"
        reasons.append(f"{message}: fog, snowfall or snow on the window?")
    return reasons


def _format_sectors(chosen: Bools, edges_deg: Floats) -> str:
    """Format runs of sectors by their edges: `105-120, 200-240`."""
    runs = _runs(chosen)
    full_circle = edges_deg[-1] - edges_deg[0] > 359 and not chosen.all()
    if full_circle and chosen[0] and chosen[-1]:
        runs = [*runs[1:-1], (runs[-1][0], runs[0][1])]
    return ", ".join(f"{edges_deg[a] % 360:.0f}-{edges_deg[b] % 360:.0f}" for a, b in runs)


def _runs(chosen: Bools) -> list[tuple[int, int]]:
    """Return the first and the end of each run of chosen elements (n,)."""
    steps = np.diff(np.concatenate([[0], chosen.astype(np.int64), [0]]))
    return list(zip(np.flatnonzero(steps > 0).tolist(), np.flatnonzero(steps < 0).tolist(), strict=True))


def adjustment_warnings(adjustment: Adjustment, components: VarianceComponents) -> list[str]:
    """Return messages about an unreliable adjustment: no or inconsistent stable ground, unusual motion."""
    reasons = []
    if not len(adjustment.stable_weights):
        reasons.append("no stable ground observed")
    elif adjustment.rejected_share > MAX_REJECTED_SHARE:
        reasons.append(f"stable ground is inconsistent: {adjustment.rejected_share:.0%} of it rejected")
    elif adjustment.mean_sigma_m > MAX_MEAN_SIGMA_M:
        reasons.append(
            "stable ground cannot tell the change of the ground from motion of the scanner:"
            f" sigma of its mean is {adjustment.mean_sigma_m:.2g} m"
        )
    for motion, part, usual in (
        ("tilted by {deg:.3f} degrees", slice(0, 2), components.tilt_rad),
        ("rotated by {deg:.3f} degrees", slice(2, 3), components.heading_rad),
        ("shifted by {m:.2g} m", slice(3, 6), components.translation_m),
    ):
        size = float(np.linalg.norm(adjustment.estimate[part]))
        if size > MOVED_SIGMAS * np.hypot(usual, adjustment.sigma[part].max()):
            reasons.append(f"scanner {motion.format(deg=np.degrees(size), m=size)} against its SOP: moved?")
    return reasons


def stable_ground_misfit(measurement: Measurement, stable_cells: Ints) -> list[str]:
    """Return a message if the stable ground of an unadjusted scan is off by more than its sigma allows.

    `stable_cells` (m,) are the indices of its cells. The figure in the message is a median.
    """
    sample = stable_cells[:: 1 + len(stable_cells) // MAX_MISFIT_CELLS]
    change_m, sigma_m = measurement.change_m[sample], measurement.cells["uncertainty_m"][sample]
    observed = np.isfinite(change_m)
    if np.count_nonzero(observed) < MIN_STABLE_CELLS:
        return []
    misfit_m = np.abs(change_m[observed])
    misfit_sigmas = NORMAL_MAD * float(np.median(misfit_m / sigma_m[observed]))
    if misfit_sigmas <= MAX_MISFIT_SIGMAS:
        return []
    misfit = f"{np.median(misfit_m):.2g} m, {misfit_sigmas:.0f} sigma"
    return [f"stable ground is off by {misfit}: moved, or another SOP?"]


def assess(
    flag: str,
    warnings: Sequence[str],
    measurement: Measurement,
    viewing: ViewingGeometry | None,
    adjustment: Adjustment | None,
    stable_z_std: float | None,
    faults: Sequence[str] = (),
    *,
    no_brightness: str = "",
    airborne_echo_share: float = 0.0,
    usual: VarianceComponents | None = None,
) -> tuple[str, str]:
    """Return the verdict of an epoch and its reasons, the gravest first.

    Unusable: flagged by a person, a fault of the inputs, no usable view, or a sigma that does not cover the
    error. Degraded: any other warning. `adjustment` is the adjustment of the scan even if it was not used in
    the end; `stable_z_std` is given only if it was used. `faults` are those of the inputs. `no_brightness` is
    why the brightness of the scan, or of its reference, does not tell where snow lies; that degrades a scan
    only if its change is measured: first scans make the reference. `airborne_echo_share` is that of the
    points on the grid that are echoes of the air. `usual` is the motion to expect of the scanner since the
    reference; by default that of a scan soon after it.
    """
    fatal = [*([f"flagged: {flag}"] if flag else []), *faults]
    reasons = [*warnings, *([no_brightness] if no_brightness and viewing is not None else [])]
    if viewing is not None and airborne_echo_share > MAX_AIRBORNE_ECHO_SHARE:
        reasons.append(
            f"{airborne_echo_share:.2%} of the echoes are not from the ground: snow, rain or dust?"
        )
    if viewing is not None and viewing.params is not None:
        visible = visibility(measurement.count, viewing)
        (fatal if visible.share < UNUSABLE_VISIBILITY else reasons).extend(obstructions(visible))
    if adjustment is not None and viewing is not None:
        reasons += adjustment_warnings(adjustment, usual or viewing.reference.components)
    if stable_z_std is not None:
        if stable_z_std > MAX_HOLDOUT_Z_STD:
            reasons.append(f"hold-out stable ground scatters by {stable_z_std:.1f} sigma")
    elif viewing is not None and viewing.reference.shared is not None:
        fatal += stable_ground_misfit(measurement, viewing.select(CellClass.STABLE))
    verdict = "unusable" if fatal else "degraded" if reasons else "good"
    remarks = [no_brightness] if no_brightness and viewing is None else []
    return verdict, "; ".join([*fatal, *reasons, *remarks])
