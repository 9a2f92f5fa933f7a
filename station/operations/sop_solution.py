"""`station sop`: solve an SOP by registration, show the pose that SOPs give the scanner."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from station.errors import ConfigError, StoreError
from station.products.exports.transformations import covariance_text
from station.quantities import Floats, Scanner
from station.readers.sop import read_matrix
from station.readers.tie_features import read_tie_features
from station.scanners import SCANNERS, missing_values, scanner_model
from station.science.geometry import pose
from station.science.geometry.registration import POSE, Features, Registration, solve
from station.science.uncertainty.point_covariance import shot_covariance
from station.section_types import require_projected
from station.sections.inputs import ScannerSection

MAX_STANDARDISED = 3.3  # sigmas: exceeded by chance by one residual in a thousand


@dataclass(frozen=True)
class PoseDifference:
    """Difference of an SOP from another: rotation [°], rotation of the vertical axis [°], shift [m]."""

    rotation_deg: float
    axis_rotation_deg: float
    shift_m: float


@dataclass(frozen=True)
class PoseSummary:
    """Position and attitude of the scanner under an SOP, and a POP if given.

    Azimuths count clockwise from north: true north with a POP or on a map, else the y axis of the SOP's
    frame.
    """

    sop: str
    position_m: list[float]  # in the frame of the SOP
    latitude_longitude_height: list[float] | None  # [°, °, m], with a POP
    map_m: list[float] | None
    tilt_deg: float
    tilt_azimuth_deg: float
    x_axis_azimuth_deg: float
    omega_phi_kappa_deg: list[float]
    difference: PoseDifference | None = None


@dataclass(frozen=True)
class FeatureResidual:
    """Residual of a feature after registration: distance [m], largest standardised residual."""

    name: str
    residual_m: float
    standardised: float


@dataclass(frozen=True)
class SopSolution:
    """A solved SOP with its uncertainty."""

    pose: PoseSummary
    covariance: str
    observations: int
    reference_variance: float
    rotation_sigma_deg: list[float]
    shift_sigma_m: list[float]
    features: list[FeatureResidual]


def scanner_by_model(model: str) -> Scanner:
    """Return a scanner by its model; raise ConfigError if the model is unknown."""
    known = scanner_model(model)
    if known is None or missing_values(known):
        complete = ", ".join(name for name in SCANNERS if not missing_values(name))
        raise ConfigError(f"--scanner {model}: unknown; choose one of {complete}")
    return ScannerSection.model_validate({"model": known}).instrument


def solve_sop(
    table: Path, out: Path, start: Path | None, crs: str | None, scanner: Scanner | None = None
) -> SopSolution:
    """Solve an SOP from a table of features; write it to `out` and its covariance next to it.

    With a `crs`, references and SOP refer to that map, with ellipsoidal heights; without, they refer to a
    frame without curvature, as under a POP. With a `scanner`, its noise at each range is added to the sigmas.
    Raises ConfigError if the features do not determine the SOP.
    """
    features = read_tie_features(table)
    if scanner is not None:
        noise_m2 = shot_covariance(features.scan_m, np.array([0.0, 0.0, 1.0]), scanner)
        features = replace(features, scan_covariance_m2=noise_m2)
    initial_sop = None if start is None else read_matrix(start)
    covariance_file = out.with_name(f"{out.stem}-covariance.csv")
    for path in (out, covariance_file):
        if path.exists():
            raise ConfigError(f"{path}: already exists; nothing is overwritten")
    registration = solve(features, initial_sop) if crs is None else _solve_on_map(features, initial_sop, crs)
    _write_new(out, _format_matrix(registration, table, crs))
    _write_new(covariance_file, covariance_text(POSE, registration.covariance, "at the scanner"))
    sigma = np.sqrt(np.diag(registration.covariance))
    residuals = [
        FeatureResidual(name, float(residual_m), float(standardised))
        for name, residual_m, standardised in zip(
            features.names, registration.residual_m, registration.standardised_residual, strict=True
        )
    ]
    return SopSolution(
        _summarise_pose(str(out), registration.sop, None, crs),
        str(covariance_file),
        registration.observations,
        registration.reference_variance,
        np.degrees(sigma[:3]).tolist(),
        sigma[3:].tolist(),
        residuals,
    )


def _solve_on_map(features: Features, start: Floats | None, crs: str) -> Registration:
    """Register in the level frame at the scanner: map projections distort directions and scale."""
    position_m = np.average(features.reference_m, axis=0) if start is None else start[:3, 3]
    local_start, registration = None, None
    for _ in range(3):  # from the centre of the features to the scanner, then refined
        to_local = _LevelFrame(position_m, crs)
        local_points = [to_local(features.reference_m + step * features.normal) for step in (0.0, 1.0)]
        normal = local_points[1] - local_points[0]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        if start is not None:
            local_start = start.copy()
            local_start[:3] = np.column_stack([start[:3, :3], to_local(start[None, :3, 3])[0]])
        registration = solve(replace(features, reference_m=local_points[0], normal=normal), local_start)
        position_m = to_local(registration.sop[None, :3, 3], back=True)[0]
    assert registration is not None  # noqa: S101 - three rounds
    return replace(registration, sop=np.column_stack([registration.sop[:, :3], [*position_m, 1.0]]))


class _LevelFrame:
    """Local frame of easting, northing and up at a map position: transformation to and from the map."""

    def __init__(self, position_m: Floats, crs: str) -> None:
        horizontal = _projected_crs(crs)
        self._to_geocentric = Transformer.from_crs(horizontal, pose.GEOCENTRIC, always_xy=True)
        self._to_map = Transformer.from_crs(pose.GEOCENTRIC, horizontal, always_xy=True)
        self._frame = pose.level_frame(np.array(self._to_geocentric.transform(*position_m)), crs)

    def __call__(self, points_m: Floats, *, back: bool = False) -> Floats:
        """Return map points (n, 3) in the level frame, or with `back` the reverse [m]."""
        if back:
            rotated_m = points_m @ self._frame[:3, :3].T + self._frame[:3, 3]
            return np.stack(self._to_map.transform(*rotated_m.T), axis=-1)
        geocentric_m = np.stack(self._to_geocentric.transform(*points_m.T), axis=-1)
        return np.asarray((geocentric_m - self._frame[:3, 3]) @ self._frame[:3, :3])


def _projected_crs(crs: str) -> CRS:
    """Return the horizontal part of a CRS; raise ConfigError unless it is projected and in metres."""
    try:
        return pose.horizontal_crs(require_projected(crs))
    except ValueError as error:
        raise ConfigError(f"--crs {crs}: {error}") from error


def _write_new(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror}") from error


def _format_matrix(registration: Registration, table: Path, crs: str | None) -> str:
    header = (
        f"# SOP solved from {table.name}: {registration.observations} observations, reference variance"
        f" {registration.reference_variance:.3g}; into {crs or 'the frame of its references'}\n"
    )
    return header + "\n".join(" ".join(f"{value:.12f}" for value in row) for row in registration.sop) + "\n"


def summarise_sops(files: list[Path], pop: Path | None, crs: str | None) -> list[PoseSummary]:
    """Return position and attitude under each SOP, and its difference from the SOP before."""
    sops = [read_matrix(file) for file in files]
    pop_matrix = None if pop is None else read_matrix(pop)
    summaries = [
        _summarise_pose(str(file), sop, pop_matrix, crs) for file, sop in zip(files, sops, strict=True)
    ]
    return summaries[:1] + [
        replace(summary, difference=_difference(reference_sop, other_sop))
        for summary, reference_sop, other_sop in zip(summaries[1:], sops, sops[1:], strict=False)
    ]


def _summarise_pose(name: str, sop: Floats, pop: Floats | None, crs: str | None) -> PoseSummary:
    """Return position and attitude under an SOP: in its frame and, if known, on the Earth and the map."""
    rotation, geographic, map_m = sop[:3, :3], None, None
    if pop is not None:
        geocentric_m = (pop @ sop)[:3, 3]
        rotation = pose.tangent_frame(geocentric_m)[:3, :3].T @ pop[:3, :3] @ rotation
        to_geographic = Transformer.from_crs(pose.GEOCENTRIC, pose.GEOGRAPHIC, always_xy=True)
        geodetic = to_geographic.transform(*geocentric_m.tolist())
        geographic = [float(geodetic[1]), float(geodetic[0]), float(geodetic[2])]
        if crs is not None:
            to_map = Transformer.from_crs(pose.GEOCENTRIC, _projected_crs(crs), always_xy=True)
            map_m = [float(value) for value in to_map.transform(*geocentric_m)]
    elif crs is not None:
        to_geocentric = Transformer.from_crs(_projected_crs(crs), pose.GEOCENTRIC, always_xy=True)
        geocentric_m = np.array(to_geocentric.transform(*sop[:3, 3]))
        rotation = (
            pose.tangent_frame(geocentric_m)[:3, :3].T
            @ pose.level_frame(geocentric_m, crs)[:3, :3]
            @ rotation
        )
    axis = rotation[:, 2]
    omega_phi_kappa_rad = (
        math.atan2(rotation[2, 1], rotation[2, 2]),
        -math.asin(max(-1.0, min(1.0, rotation[2, 0]))),
        math.atan2(rotation[1, 0], rotation[0, 0]),
    )
    return PoseSummary(
        name,
        sop[:3, 3].tolist(),
        geographic,
        map_m,
        tilt_deg=math.degrees(math.atan2(math.hypot(axis[0], axis[1]), axis[2])),
        tilt_azimuth_deg=math.degrees(math.atan2(axis[0], axis[1])) % 360,
        x_axis_azimuth_deg=math.degrees(math.atan2(rotation[0, 0], rotation[1, 0])) % 360,
        omega_phi_kappa_deg=[math.degrees(angle) for angle in omega_phi_kappa_rad],
    )


def _difference(reference: Floats, other: Floats) -> PoseDifference:
    rotation = Rotation.from_matrix(other[:3, :3] @ reference[:3, :3].T)
    axis_sine = np.linalg.norm(np.cross(reference[:3, 2], other[:3, 2]))
    return PoseDifference(
        math.degrees(rotation.magnitude()),
        math.degrees(math.atan2(axis_sine, reference[:3, 2] @ other[:3, 2])),
        float(np.linalg.norm(other[:3, 3] - reference[:3, 3])),
    )


def format_pose(summary: PoseSummary) -> str:
    """Return position and attitude of the scanner as text."""
    lines = [summary.sop, f"  scanner at       {_format_numbers(summary.position_m, 3)}"]
    if summary.latitude_longitude_height:
        *lat_lon, height_m = summary.latitude_longitude_height
        lines.append(
            f"  on the Earth     {_format_numbers(lat_lon, 7)}, {height_m:.3f} m above the ellipsoid"
        )
    if summary.map_m:
        lines.append(f"  on the map       {_format_numbers(summary.map_m, 3)}")
    azimuth = f"{summary.tilt_azimuth_deg:.1f}°, clockwise from north"
    lines += [
        f"  tilt             {summary.tilt_deg:.3f}° towards {azimuth}",
        f"  azimuth of x     {summary.x_axis_azimuth_deg:.3f}°",
        f"  omega phi kappa  {_format_numbers(summary.omega_phi_kappa_deg, 4)} °",
    ]
    if summary.difference:
        difference = summary.difference
        lines.append(
            f"  from the SOP above: rotated {difference.rotation_deg:.3f}°,"
            f" its axis {difference.axis_rotation_deg:.3f}°, shifted {difference.shift_m:.3f} m"
        )
    return "\n".join(lines)


def format_solution(solution: SopSolution) -> str:
    """Return a solved SOP, its sigmas and the residuals of the features as text."""
    residuals = f"residuals are {math.sqrt(solution.reference_variance):.2g} times their sigma"
    lines = [
        format_pose(solution.pose),
        f"  sigma rotation   {_format_numbers(solution.rotation_sigma_deg, 4)} ° about east, north, up",
        f"  sigma shift      {_format_numbers(solution.shift_sigma_m, 4)} m",
        f"  reference variance {solution.reference_variance:.3g}: {residuals}",
        "",
        "feature             residual [m]   sigmas",
    ]
    for feature in solution.features:
        remark = "  check" if feature.standardised > MAX_STANDARDISED else ""
        lines.append(f"{feature.name:20} {feature.residual_m:11.4f} {feature.standardised:8.1f}{remark}")
    return "\n".join([*lines, "", f"covariance: {solution.covariance}"])


def _format_numbers(values: list[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
