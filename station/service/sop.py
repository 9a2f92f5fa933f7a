"""What a person does with SOPs: solve one from a registration, see what one says."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from scipy.spatial.transform import Rotation

from station.errors import ConfigError, StoreError
from station.quantities import Floats, Scanner
from station.readers.features import read_features
from station.readers.sop import read_matrix
from station.scanners import SCANNERS
from station.science import pose
from station.science.points import shot_covariance
from station.science.registration import UNKNOWN, Features, Registration, solve
from station.sections import ScannerSection

SUSPECT = 3.3  # sigmas: one residual of a thousand is larger by chance
NEAR_M = 1e4  # how far from the scanner a map has to be right


@dataclass(frozen=True)
class Difference:
    """How an SOP differs from another."""

    turned_deg: float
    axis_turned_deg: float
    moved_m: float


@dataclass(frozen=True)
class Chain:
    """Where an SOP, and a POP behind it, put the scanner, and how it leans there.

    Angles of the axes count clockwise from north: true north with a POP or on a map, else the y axis of the
    SOP's frame.
    """

    sop: str
    position_m: list[float]  # as the SOP says
    latitude_longitude_height: list[float] | None  # [°, °, m], with a POP
    map_m: list[float] | None
    lean_deg: float
    lean_towards_deg: float
    x_axis_azimuth_deg: float
    omega_phi_kappa_deg: list[float]
    differs: Difference | None = None


@dataclass(frozen=True)
class Left:
    """What the registration leaves of a feature: distance [m], and the worst of its residuals in sigmas."""

    name: str
    residual_m: float
    standardised: float


@dataclass(frozen=True)
class Solution:
    """A solved SOP and how sure it is."""

    chain: Chain
    covariance: str
    observations: int
    reference_variance: float
    turn_sigma_deg: list[float]
    shift_sigma_m: list[float]
    features: list[Left]


def known_scanner(model: str) -> Scanner:
    """Return a scanner by its model; ConfigError where it is not known."""
    if model not in SCANNERS:
        raise ConfigError(f"--scanner {model}: not known; take one of {', '.join(SCANNERS)}")
    return ScannerSection.model_validate({"model": model}).instrument


def solve_sop(
    table: Path, out: Path, start: Path | None, crs: str | None, scanner: Scanner | None = None
) -> Solution:
    """Solve an SOP from a table of features; write it to `out` and its covariance beside it.

    With a `crs` the references are on that map, with ellipsoidal heights, and so is the SOP; without, they
    are in a frame without curvature, as under a POP. With a `scanner` its noise is added to each sigma, as it
    grows with range. Raises ConfigError where the features do not tell.
    """
    features = read_features(table)
    if scanner is not None:
        noise_m2 = shot_covariance(features.scan_m, np.array([0.0, 0.0, 1.0]), scanner)
        features = replace(features, scan_covariance_m2=noise_m2)
    begin = None if start is None else read_matrix(start)
    covariance_file = out.with_name(f"{out.stem}-covariance.csv")
    for path in (out, covariance_file):
        if path.exists():
            raise ConfigError(f"{path}: is there already; nothing is overwritten")
    found = solve(features, begin) if crs is None else _solve_on_map(features, begin, crs)
    _write_new(out, _as_text(found, table, crs))
    _write_new(covariance_file, _as_csv(found.covariance))
    sigma = np.sqrt(np.diag(found.covariance))
    left = [
        Left(name, float(left_m), float(standardised))
        for name, left_m, standardised in zip(features.names, found.left_m, found.standardised, strict=True)
    ]
    return Solution(
        _chain(str(out), found.sop, None, crs),
        str(covariance_file),
        found.observations,
        found.reference_variance,
        np.degrees(sigma[:3]).tolist(),
        sigma[3:].tolist(),
        left,
    )


def _solve_on_map(features: Features, start: Floats | None, crs: str) -> Registration:
    """Register on a map, in the level frame at the scanner: a map bends and scales away from it."""
    place_m = np.average(features.reference_m, axis=0) if start is None else start[:3, 3]
    begin, found = None, None
    for _ in range(3):  # from the middle of the features to the scanner, and once more
        to_local = _LevelFrame(place_m, crs)
        ends = [to_local(features.reference_m + step * features.normal) for step in (0.0, 1.0)]
        normal = ends[1] - ends[0]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        if start is not None:
            begin = start.copy()
            begin[:3] = np.column_stack([start[:3, :3], to_local(start[None, :3, 3])[0]])
        found = solve(replace(features, reference_m=ends[0], normal=normal), begin)
        place_m = to_local(found.sop[None, :3, 3], back=True)[0]
    assert found is not None  # noqa: S101 - three rounds
    return replace(found, sop=np.column_stack([found.sop[:, :3], [*place_m, 1.0]]))


class _LevelFrame:
    """Along easting, northing and up at a place on a map, and back."""

    def __init__(self, place_m: Floats, crs: str) -> None:
        horizontal = _known(crs)
        self._to_geocentric = Transformer.from_crs(horizontal, pose.GEOCENTRIC, always_xy=True)
        self._to_map = Transformer.from_crs(pose.GEOCENTRIC, horizontal, always_xy=True)
        self._frame = pose.level_frame(np.array(self._to_geocentric.transform(*place_m)), crs)

    def __call__(self, points_m: Floats, *, back: bool = False) -> Floats:
        """Points (n, 3) on the map in the level frame, or the other way [m]."""
        if back:
            there = points_m @ self._frame[:3, :3].T + self._frame[:3, 3]
            return np.stack(self._to_map.transform(*there.T), axis=-1)
        geocentric_m = np.stack(self._to_geocentric.transform(*points_m.T), axis=-1)
        return np.asarray((geocentric_m - self._frame[:3, 3]) @ self._frame[:3, :3])


def _known(crs: str) -> CRS:
    """Return the horizontal part of a CRS; ConfigError where it is none, or in degrees."""
    try:
        known = pose.horizontal_crs(crs)
    except CRSError as error:
        raise ConfigError(f"--crs {crs}: not known to PROJ") from error
    if not known.is_projected:
        raise ConfigError(f"--crs {crs}: counts in degrees: name a map, such as EPSG:32632")
    return known


def _write_new(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror}") from error


def _as_text(found: Registration, table: Path, crs: str | None) -> str:
    head = (
        f"# SOP solved from {table.name}: {found.observations} observations, reference variance"
        f" {found.reference_variance:.3g}; leads to {crs or 'the frame of its references'}\n"
    )
    return head + "\n".join(" ".join(f"{value:.12f}" for value in row) for row in found.sop) + "\n"


def _as_csv(covariance: Floats) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["", *UNKNOWN])
    rows.writerows(
        [name, *(f"{value:.9e}" for value in row)] for name, row in zip(UNKNOWN, covariance, strict=True)
    )
    return "# turns in rad, counter-clockwise about axes at the scanner, shifts in m\n" + text.getvalue()


def show_sop(files: list[Path], pop: Path | None, crs: str | None) -> list[Chain]:
    """Tell where SOPs put the scanner and how it leans there; of each but the first, how it differs."""
    sops = [read_matrix(file) for file in files]
    to_earth = None if pop is None else read_matrix(pop)
    chains = [_chain(str(file), sop, to_earth, crs) for file, sop in zip(files, sops, strict=True)]
    return chains[:1] + [
        replace(chain, differs=_difference(before, after))
        for chain, before, after in zip(chains[1:], sops, sops[1:], strict=False)
    ]


def _chain(name: str, sop: Floats, pop: Floats | None, crs: str | None) -> Chain:
    """Place and attitude under an SOP: in its own frame, on the Earth, on the map, as far as known."""
    turn, geographic, map_m = sop[:3, :3], None, None
    if pop is not None:
        geocentric_m = (pop @ sop)[:3, 3]
        turn = pose.tangent_frame(geocentric_m)[:3, :3].T @ pop[:3, :3] @ turn
        to_geographic = Transformer.from_crs(pose.GEOCENTRIC, pose.GEOGRAPHIC, always_xy=True)
        place = to_geographic.transform(*geocentric_m.tolist())
        geographic = [float(place[1]), float(place[0]), float(place[2])]
        if crs is not None:
            to_map = Transformer.from_crs(pose.GEOCENTRIC, _known(crs), always_xy=True)
            map_m = [float(value) for value in to_map.transform(*geocentric_m)]
    elif crs is not None:
        to_geocentric = Transformer.from_crs(_known(crs), pose.GEOCENTRIC, always_xy=True)
        geocentric_m = np.array(to_geocentric.transform(*sop[:3, 3]))
        turn = pose.tangent_frame(geocentric_m)[:3, :3].T @ pose.level_frame(geocentric_m, crs)[:3, :3] @ turn
    axis = turn[:, 2]
    omega_phi_kappa_rad = (
        math.atan2(turn[2, 1], turn[2, 2]),
        -math.asin(max(-1.0, min(1.0, turn[2, 0]))),
        math.atan2(turn[1, 0], turn[0, 0]),
    )
    return Chain(
        name,
        sop[:3, 3].tolist(),
        geographic,
        map_m,
        lean_deg=math.degrees(math.atan2(math.hypot(axis[0], axis[1]), axis[2])),
        lean_towards_deg=math.degrees(math.atan2(axis[0], axis[1])) % 360,
        x_axis_azimuth_deg=math.degrees(math.atan2(turn[0, 0], turn[1, 0])) % 360,
        omega_phi_kappa_deg=[math.degrees(angle) for angle in omega_phi_kappa_rad],
    )


def _difference(before: Floats, after: Floats) -> Difference:
    turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T)
    across = np.linalg.norm(np.cross(before[:3, 2], after[:3, 2]))
    return Difference(
        math.degrees(turn.magnitude()),
        math.degrees(math.atan2(across, before[:3, 2] @ after[:3, 2])),
        float(np.linalg.norm(after[:3, 3] - before[:3, 3])),
    )


def describe_chain(told: Chain) -> str:
    """Say what an SOP says, in a few lines."""
    lines = [told.sop, f"  scanner at       {_numbers(told.position_m, 3)}"]
    if told.latitude_longitude_height:
        *place, height_m = told.latitude_longitude_height
        lines.append(f"  on the Earth     {_numbers(place, 7)}, {height_m:.3f} m above the ellipsoid")
    if told.map_m:
        lines.append(f"  on the map       {_numbers(told.map_m, 3)}")
    lines += [
        f"  leans            {told.lean_deg:.3f}° towards {told.lean_towards_deg:.1f}°, clockwise from north",
        f"  its x axis       looks towards {told.x_axis_azimuth_deg:.3f}°",
        f"  omega phi kappa  {_numbers(told.omega_phi_kappa_deg, 4)} °",
    ]
    if told.differs:
        one = told.differs
        lines.append(
            f"  to the one above turned {one.turned_deg:.3f}°, its axis {one.axis_turned_deg:.3f}°,"
            f" moved {one.moved_m:.3f} m"
        )
    return "\n".join(lines)


def describe_solution(told: Solution) -> str:
    """Say how good a solved SOP is, feature by feature."""
    times = math.sqrt(told.reference_variance)
    lines = [
        describe_chain(told.chain),
        f"  sigma of turns   {_numbers(told.turn_sigma_deg, 4)} ° about east, north, up",
        f"  sigma of shifts  {_numbers(told.shift_sigma_m, 4)} m",
        f"  reference variance {told.reference_variance:.3g}: the features are off by {times:.2g} sigmas",
        "",
        "feature                 left [m]   sigmas",
    ]
    for one in told.features:
        mark = "  look at it" if one.standardised > SUSPECT else ""
        lines.append(f"{one.name:20} {one.residual_m:11.4f} {one.standardised:8.1f}{mark}")
    return "\n".join([*lines, "", f"covariance: {told.covariance}"])


def _numbers(values: list[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
