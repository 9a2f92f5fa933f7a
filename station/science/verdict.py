"""How good an epoch is, and why not better: from the scan and the version of the reference it counts from.

Nothing is remembered, so that a scan done again gets the same verdict. Source: ADJUSTMENT, guarding it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Habits, Ints, Ints32, Measurement
from station.science.adjustment import Adjustment
from station.science.outlook import COUNTED, STRETCH_M, Outlook, Trait
from station.science.shared import LEAN_KNOT_RAD, LEAN_PER_REFRACTION

MOST_REFUSED = 0.3  # of the stable ground, before an adjustment is doubted
MOVED_SIGMAS = 4.0  # of what the station does from scan to scan
CLEAR = 0.75  # of what scans usually see; less is not chance
BLIND = 0.02  # of it; less is nothing to work with
THROUGH = 0.9  # of the best range; there the air is clear enough to miss a sector
GONE = 0.05  # of what is usually seen in a sector or at a range; less is nothing
FEWEST_CELLS = 30  # that scans usually see, to miss them
SCATTERED = 3.0  # sigmas by which stable ground that no fit has seen may scatter
OFF = 5.0  # the same of a scan that is not adjusted; more, and its sigma holds nothing
FEWEST_STABLE = 20
STABLE_MOST = 100_000  # cells that a misfit is told by; of more a part


@dataclass(frozen=True)
class View:
    """Cells that scans usually see and that this one saw, by sector of the head's azimuth and by range.

    `sector_deg` (sectors + 1,) are the edges of the sectors, clockwise from grid north.
    """

    usual: Floats  # (sectors, stretches)
    seen: Floats  # (sectors, stretches)
    sector_deg: Floats

    @property
    def share(self) -> float:
        """Share that was seen of what usually is; one where that is too little to miss."""
        usual = float(self.usual.sum())
        return float(self.seen.sum()) / usual if usual >= FEWEST_CELLS else 1.0


def view(count: Ints32, outlook: Outlook) -> View:
    """Count the cells that a scan saw, of `count` (n,) points, against what the reference's saw."""
    of = outlook.of
    if of is None:
        raise ValueError("without a place nothing is looked at")
    shape = sectors, stretches = outlook.places
    share, place = (outlook.cells[name][:] for name in COUNTED)
    usual = np.bincount(place, np.nan_to_num(share), sectors * stretches).astype(np.float64)
    there = (share > 0) & (count[outlook.counted] > 0)
    found = np.bincount(place, there, sectors * stretches).astype(np.float64)
    edges = of.start_rad + LEAN_KNOT_RAD * LEAN_PER_REFRACTION * np.arange(sectors + 1)
    every = outlook.counted.step
    return View(usual.reshape(shape) * every, found.reshape(shape) * every, np.degrees(edges))


def hidden(view: View) -> list[str]:
    """Say what of the usual view is hidden: whole sectors, or more than chance everywhere.

    A sector is missing where nothing of it is left at ranges at which the others see most.
    """
    of_sector = view.usual.sum(axis=1)
    empty = view.seen.sum(axis=1) < GONE * of_sector
    through = view.seen[~empty].sum(axis=0) / np.maximum(view.usual[~empty].sum(axis=0), FEWEST_CELLS)
    clear = through > THROUGH * max(through.max(), CLEAR)
    missing = empty & (view.usual @ clear >= FEWEST_CELLS)
    reasons = []
    if missing.any():
        reasons.append(f"partial sweep: nothing seen at azimuth {_sectors(missing, view.sector_deg)} degree")
    usual, seen = view.usual[~missing].sum(axis=0), view.seen[~missing].sum(axis=0)
    if usual.sum() >= FEWEST_CELLS and seen.sum() < CLEAR * usual.sum():
        told = f"sees {seen.sum() / usual.sum():.0%} of what scans usually see"
        far = np.flatnonzero((usual >= FEWEST_CELLS) & (seen >= GONE * usual))
        beyond = usual[far[-1] + 1 :].sum() if len(far) else 0.0
        if beyond >= FEWEST_CELLS:
            told += f", nothing beyond {(far[-1] + 1) * STRETCH_M:.0f} m"
        reasons.append(f"{told}: fog, snow in the air or on the window?")
    return reasons


def _sectors(chosen: Bools, edges_deg: Floats) -> str:
    """Name runs of sectors by their edges: `105-120, 200-240`."""
    steps = np.diff(np.concatenate([[0], chosen.astype(np.int64), [0]]))
    runs = list(zip(np.flatnonzero(steps > 0), np.flatnonzero(steps < 0), strict=True))
    round_ = edges_deg[-1] - edges_deg[0] > 359 and not chosen.all()
    if round_ and chosen[0] and chosen[-1]:
        runs = [*runs[1:-1], (runs[-1][0], runs[0][1])]
    return ", ".join(f"{edges_deg[a] % 360:.0f}-{edges_deg[b] % 360:.0f}" for a, b in runs)


def distrust(found: Adjustment, habits: Habits) -> list[str]:
    """Say what speaks against an adjustment: nothing stable to hold on to, or unusual motion."""
    reasons = []
    if not len(found.stable_weight):
        reasons.append("no stable ground seen")
    elif found.refused > MOST_REFUSED:
        reasons.append(f"stable ground disagrees with itself: {found.refused:.0%} of it left out")
    tilt_rad = float(np.hypot(*found.estimate[:2]))
    if tilt_rad > MOVED_SIGMAS * habits.tilt_rad:
        reasons.append(f"scanner leans {np.degrees(tilt_rad):.3f} degree from its SOP: moved?")
    for name, place, habit, unit in (
        ("turned", slice(2, 3), habits.heading_rad, "rad"),
        ("shifted", slice(3, 6), habits.translation_m, "m"),
    ):
        size = float(np.linalg.norm(found.estimate[place]))
        if size > MOVED_SIGMAS * habit:
            reasons.append(f"scanner {name} by {size:.2g} {unit} against its SOP: moved?")
    return reasons


def misfit(measured: Measurement, stable: Ints) -> list[str]:
    """Say by how much stable ground is off in a scan that is not adjusted, unless sigma holds it.

    `stable` (m,) are the numbers of its cells. Half of them are off by more than the figure told, either way.
    """
    some = stable[:: 1 + len(stable) // STABLE_MOST]
    change_m, sigma_m = measured.change_m[some], measured.cells["uncertainty_m"][some]
    seen = np.isfinite(change_m)
    if np.count_nonzero(seen) < FEWEST_STABLE:
        return []
    off_m = np.abs(change_m[seen])
    sigmas = 1.4826 * float(np.median(off_m / sigma_m[seen]))  # of a normal distribution
    if sigmas <= OFF:
        return []
    return [f"stable ground is {np.median(off_m):.2g} m off, {sigmas:.0f} sigma: moved, or another SOP?"]


def judge(
    flag: str,
    lacking: Sequence[str],
    measured: Measurement,
    outlook: Outlook | None,
    found: Adjustment | None,
    stable_z_std: float | None,
) -> tuple[str, str]:
    """Return the verdict of an epoch and its reasons, the gravest first.

    Unusable: a person's `flag` says so, nothing to work with was seen, or its sigma does not hold the error.
    Degraded: anything else that is lacking. `found`: how the scan was adjusted, even if that was not used in
    the end, and `stable_z_std` only where it was.
    """
    fatal = [f"flagged: {flag}"] if flag else []
    reasons = list(lacking)
    if outlook is not None and outlook.of is not None:
        told = view(measured.count, outlook)
        (fatal if told.share < BLIND else reasons).extend(hidden(told))
    if found is not None and outlook is not None:
        reasons += distrust(found, outlook.reference.habits)
    if stable_z_std is not None:
        if stable_z_std > SCATTERED:
            reasons.append(f"stable ground that no fit has seen scatters by {stable_z_std:.1f} sigma")
    elif outlook is not None and outlook.reference.shared is not None:
        fatal += misfit(measured, outlook.having(Trait.STABLE))
    word = "unusable" if fatal else "degraded" if reasons else "good"
    return word, "; ".join([*fatal, *reasons])
