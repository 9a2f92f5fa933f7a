"""The making of the reference: when a version is due, and the tasks that make it in a child process."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from station.archive.layout import Series, kept_of
from station.archive.reference import (
    Lineage,
    open_reference,
    read_lineage,
    read_reference,
    versions,
    write_reference,
)
from station.config import Site
from station.errors import StoreError
from station.pipeline import gridder_for, on_reference, outlook_on, survey
from station.quantities import Habits, Reference, Setup
from station.readers.scan import utc_interval
from station.science.adjustment import Adjustment
from station.science.grid import Stack
from station.science.master import improved, master
from station.science.outlook import Outlook
from station.science.prior import learned
from station.service.content import sha256_of
from station.service.gather import Gathered, gather
from station.service.inbox import Arrival
from station.service.stale import Made
from station.service.tasks import (
    Progress,
    air_of,
    flag_of,
    levelled_to,
    numbers_of_air,
    opened,
    outlook_of,
    series_of,
    sha256_of_log,
    stable_ground,
)

IMPROVED_EVERY = 4  # a version is due at four times the scans of the one before
IMPROVED_MOST = 32  # scans that are read for it
REFERENCE_PASSES = 3  # a third improves the second by a tenth, a fourth the third by nothing measurable


def next_version(series: Series, named: Iterable[str | None]) -> str:
    """Return the version that comes next, after those there are and those that epochs name."""
    known = [*versions(series), *(version for version in named if version and version.isdigit())]
    return str(max((int(version) for version in known), default=0) + 1)


def scans_due(site: Site, usable: list[str], made: int) -> list[str]:
    """Return the scans that the next version is to be made of, as far as they are stored yet.

    `usable` are the good ones by their time, `made` how many versions of one base there are. The first is
    made of the first scans. Later ones change it on stable ground only, so that epochs measured from an older
    one stay as they are.
    """
    wanted = site.reference.scans
    if isinstance(wanted, Path) or (made and not site.adjusts):
        return []
    if not made:
        return usable[:wanted]
    due = number_due(site, made)
    return usable[:due][:: max(1, due // IMPROVED_MOST)][:IMPROVED_MOST]


def number_due(site: Site, made: int) -> int:
    """Return how many usable scans there must be for the next version."""
    wanted = site.reference.scans
    return 0 if isinstance(wanted, Path) else wanted * IMPROVED_EVERY**made


def build_reference(site: Site, arrivals: list[Arrival], version: str, progress: Progress) -> str:
    """Make the master surface from scans, adjusted together, and store it; return its version.

    Thrice over the scans: their plain means, then twice their residuals to what there is, each scan adjusted
    to it. What the scans show of the station's habits is learned on the way.
    """
    _look_at(site, version, _built(site, arrivals, version, progress))
    return version


def _built(site: Site, arrivals: list[Arrival], version: str, progress: Progress) -> Setup:
    """Make and store it; return the setup of its scans."""
    surface: Reference | None = None
    for _ in range(REFERENCE_PASSES):
        surface, laid = _passed(site, arrivals, surface, version, progress)
        made_from = tuple(one.made.told() for one in laid)
    assert surface is not None  # noqa: S101 - there is a pass
    write_reference(series_of(site), surface, Lineage(version, site.science_hash, made_from=made_from))
    return laid[-1].gathered.setup


def _passed(
    site: Site, arrivals: list[Arrival], surface: Reference | None, version: str, progress: Progress
) -> tuple[Reference, list[_Laid]]:
    """Return what scans make of a surface, or make without one."""
    stack, laid = _stacked(site, arrivals, surface, progress)
    scan_ids = tuple(one.made.scan_id for one in laid)
    unknown = [one.gathered.unknown for one in laid]
    habits = _learned(surface.habits if surface else Habits(), laid)
    position_m = laid[0].gathered.setup.position_m
    return master(stack, surface, unknown, position_m, version, scan_ids, habits), laid


def improve_reference(
    site: Site, arrivals: list[Arrival], version: str, on: str, replaces: tuple[str, ...], progress: Progress
) -> str:
    """Store a version of the reference that knows stable ground and the station's habits from more scans.

    It is laid on the version `on`, and takes the place of those it `replaces`.
    """
    _look_at(site, version, _improved(site, arrivals, version, on, replaces, progress))
    return version


def _improved(
    site: Site, arrivals: list[Arrival], version: str, on: str, replaces: tuple[str, ...], progress: Progress
) -> Setup:
    """Make and store it; return the setup of its scans."""
    series = series_of(site)
    base = read_reference(series, on)
    if base is None:
        raise StoreError(f"{series.folder}: no reference to improve")
    stack, laid = _stacked(site, arrivals, base, progress)
    habits = _learned(base.habits, laid)
    position_m = laid[0].gathered.setup.position_m
    if position_m is None:
        raise StoreError(f"{series.folder}: a reference without the scanner's place cannot be improved")
    lineage = Lineage(
        base=read_lineage(series, on).base,
        science_hash=site.science_hash,
        replaces=replaces,
        made_from=tuple(one.made.told() for one in laid),
    )
    write_reference(series, improved(base, stack, position_m, version, habits), lineage)
    return laid[-1].gathered.setup


@dataclass(frozen=True)
class _Laid:
    """What is kept of a scan that was laid on a stack."""

    gathered: Gathered
    adjustment: Adjustment | None
    made: Made


def _stacked(
    site: Site, arrivals: list[Arrival], surface: Reference | None, progress: Progress
) -> tuple[Stack, list[_Laid]]:
    """Lay scans on a surface, or on none yet, one after the other."""
    stack, seen_from = Stack(site.grid_cells), _SeenFrom(site, surface)
    return stack, [_lay_on(stack, site, arrival, seen_from, progress) for arrival in arrivals]


def _look_at(site: Site, version: str, setup: Setup) -> None:
    """Have the outlook of a setup ready for the next scan."""
    reference = open_reference(series_of(site), version)
    if reference is not None:
        outlook_of(site, setup, reference)


def _learned(habits: Habits, laid: list[_Laid]) -> Habits:
    """Return what adjusted scans show of the station's habits."""
    found = (
        (one.gathered.told.lines, one.adjustment.estimate, one.adjustment.covariance)
        for one in laid
        if one.gathered.told is not None and one.adjustment is not None
    )
    told = laid[0].gathered.told
    return habits if told is None else learned(habits, told.of, found)


class _SeenFrom:
    """A surface as the scans see it: looked at anew only where the scanner stands elsewhere."""

    def __init__(self, site: Site, surface: Reference | None) -> None:
        self._site = site
        self._surface = surface
        self._last: tuple[Setup, Outlook] | None = None

    def __call__(self, setup: Setup) -> Outlook | None:
        """Return the outlook of scans of a setup, None where there is no surface yet."""
        if self._surface is None:
            return None
        if self._last is None or self._last[0] != setup:
            stable = stable_ground(self._site, self._surface)
            self._last = setup, outlook_on(self._surface, setup, stable)
        return self._last[1]


def _lay_on(stack: Stack, site: Site, arrival: Arrival, seen_from: _SeenFrom, progress: Progress) -> _Laid:
    """Add a scan to a stack, adjusted to the surface there is. Its own grid goes at once."""
    with opened(site, arrival.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        gathered = gather(site, reader, arrival.log, start, end)
        outlook = seen_from(gathered.setup)
        gridder = gridder_for(gathered.setup, outlook)
        survey(gridder, reader.blocks(), gathered.pose, progress)
    levelled = levelled_to(site, gridder, gathered, outlook)
    if outlook is None:
        stack.add(gridder)
    else:
        stack.add(gridder, on_reference(gridder, outlook, levelled), outlook.reference.roughness_m2)
    progress()
    made = Made(
        scan_id=arrival.path.stem,
        start_s=start.timestamp(),
        end_s=end.timestamp(),
        scan_sha256=sha256_of(arrival.path),
        log_sha256=sha256_of_log(arrival),
        sop_id=kept_of(gathered.provenance.get("sop_id", ""), "text"),
        lean_zero=gathered.provenance.get("lean_zero", ""),
        flag=flag_of(site, start.timestamp(), end.timestamp()),
        air=air_of(numbers_of_air(gathered)),
    )
    return _Laid(gathered, levelled[1] if levelled else None, made)
