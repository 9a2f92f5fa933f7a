"""Pose of the scanner: rotations, SOP, POP and the transformation to the map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.polynomial import chebyshev
from pyproj import CRS, Transformer

from station.quantities import Floats, Floats32, Ints, TiltSeries

KNOT_RAD = 3e-5  # spacing of knots in tilt
MIN_INTERVAL_S = 1e-9  # between knots
MIN_SIZE_M = 0.25e-3  # polynomial terms that stay smaller are dropped
GEOCENTRIC = "EPSG:4978"  # WGS84 geocentric, the target frame of a POP
GEOGRAPHIC = "EPSG:4979"  # WGS84 with ellipsoidal height

Axis = TypeVar("Axis", Floats, Floats32)
Monomials = dict[tuple[int, int, int], Axis]


def rotation_x(angle_rad: float) -> Floats:
    """Matrix (3, 3) of a counter-clockwise rotation of points about x. Source: equations.md, 2.1."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> Floats:
    """Matrix (3, 3) of a counter-clockwise rotation of points about y. Source: equations.md, 2.1."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> Floats:
    """Matrix (3, 3) of a counter-clockwise rotation of points about z. Source: equations.md, 2.1."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation(omega_rad: float, phi_rad: float, kappa_rad: float) -> Floats:
    """Matrix (3, 3) that rotates points by omega about x, then phi about y, then kappa about z.

    Source: Hartzell et al. (2015), Eq. 3; the order is that of the author's published code.
    """
    return np.asarray(rotation_z(kappa_rad) @ rotation_y(phi_rad) @ rotation_x(omega_rad))


@dataclass(frozen=True)
class TimedRotation:
    """A rotation as a function of time, given at knots.

    It is linear between the knots, and constant before the first and after the last.
    """

    time_s: Floats  # (k,) increasing
    matrix: Floats  # (k, 3, 3) at the knots
    rate_per_s: Floats  # (k, 3, 3) its change per second after each knot

    def rotate(self, xyz_m: Floats, time_s: Floats) -> Floats:
        """Return shots (3, n) [m], each rotated as at its time; fastest for increasing times."""
        rotated_m = np.empty_like(xyz_m)
        if not len(time_s):
            return rotated_m
        if np.any(time_s[1:] < time_s[:-1]):
            order = np.argsort(time_s, kind="stable")
            rotated_m[:, order] = self.rotate(xyz_m.take(order, axis=1), time_s[order])
            return rotated_m
        first, last = np.searchsorted(self.time_s[1:], (time_s[0], time_s[-1]), side="right").tolist()
        edges = [0, *np.searchsorted(time_s, self.time_s[first + 1 : last + 1]).tolist(), len(time_s)]
        for knot, part in zip(range(first, last + 1), map(slice, edges, edges[1:]), strict=False):
            change_m = _product(self.rate_per_s[knot], xyz_m[:, part])
            change_m *= np.maximum(time_s[part] - self.time_s[knot], 0.0)
            np.add(change_m, _product(self.matrix[knot], xyz_m[:, part]), out=rotated_m[:, part])
        return rotated_m


def _product(matrix: Floats, points_m: Floats) -> Floats:
    """Return a matrix (3, 3) times points (3, n), to the last digit the same for any number of points."""
    if points_m.shape[1] == 1:  # BLAS multiplies a single column differently, in the last digit
        return _product(matrix, points_m.repeat(2, axis=1))[:, :1]
    return np.asarray(matrix @ points_m)


def timed_rotation(tilt: TiltSeries | None, mount: Floats) -> TimedRotation:
    """Return the rotation of shots by the tilt at their time, then by the constant matrix `mount` (3, 3).

    R_D = Ry(pitch) Rx(roll), in the scanner's frame, before the SOP. Knots are at most `KNOT_RAD` of tilt
    apart; linear interpolation between them is exact to 1e-10.
    Source: Hartzell et al. (2015), Eq. 5, which adds it to the chain of Eq. 4.
    """
    if tilt is None:
        return TimedRotation(np.zeros(1), mount[None], np.zeros((1, 3, 3)))
    knots = np.stack([tilt.time_s, tilt.roll_rad, tilt.pitch_rad])
    steps = np.ceil(np.abs(np.diff(knots[1:])).max(axis=0, initial=0.0) / KNOT_RAD).astype(np.int64)
    knot_position = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1))])
    time_s, roll_rad, pitch_rad = (
        np.interp(np.arange(knot_position[-1] + 1), knot_position, values) for values in knots
    )
    (sin_r, sin_p), (cos_r, cos_p) = ((f(roll_rad), f(pitch_rad)) for f in (np.sin, np.cos))
    tilt_matrix = [
        [cos_p, sin_p * sin_r, sin_p * cos_r],
        [0 * sin_r, cos_r, -sin_r],
        [-sin_p, cos_p * sin_r, cos_p * cos_r],
    ]
    matrix = mount @ np.moveaxis(np.array(tilt_matrix), -1, 0)
    rate_per_s = np.diff(matrix, axis=0) / np.maximum(np.diff(time_s), MIN_INTERVAL_S)[:, None, None]
    return TimedRotation(time_s, matrix, np.concatenate([rate_per_s, np.zeros((1, 3, 3))]))


@dataclass(frozen=True)
class ScannerToMap:
    """Transformation from the levelled scanner frame to the map.

    First the rigid `to_local` (4, 4) into a local frame at the scanner, with axes along easting, northing and
    up; then a shift to `position_m`, and the deviation of the map from the local frame: a polynomial in x, y
    and z [m] with `powers` (m, 3) and `coefficients` (m, 3) for easting, northing and height [m].
    """

    position_m: tuple[float, float, float]
    to_local: Floats
    powers: Ints
    coefficients: Floats

    def to_map(self, local_m: Floats) -> Floats:
        """Easting, northing and height (3, n) [m] of points (3, n) in the local frame."""
        # The polynomial amounts to metres: float32 resolves it to a micrometre, at half the cost.
        x, y, z = local_m.astype(np.float32)
        monomials, scratch = _monomials(x, y, z, self.powers), np.empty_like(x)
        deviation_m = np.zeros(local_m.shape, np.float32)
        for power, row_m in zip(self.powers.tolist(), self.coefficients.tolist(), strict=True):
            for axis_m, coefficient_m in zip(deviation_m, row_m, strict=True):
                if coefficient_m:
                    np.multiply(monomials[tuple(power)], coefficient_m, out=scratch)
                    np.add(axis_m, scratch, out=axis_m)
        mapped_m = deviation_m.astype(np.float64)
        mapped_m += local_m
        mapped_m += np.array(self.position_m)[:, None]
        return mapped_m

    def with_correction(self, correction: Callable[[Floats], Floats], radius_m: float) -> ScannerToMap:
        """Return this transformation with a local-frame correction (e.g. refraction) applied first.

        Both are refitted as one polynomial, within `radius_m`: exact to 0.1 mm for smooth corrections of 1 m.
        """
        local_m = _chebyshev_nodes(radius_m)
        return _fit_polynomial(self.position_m, self.to_local, local_m, self.to_map(correction(local_m)))


def _monomials(x: Axis, y: Axis, z: Axis, powers: Ints) -> Monomials[Axis]:
    """Return the monomials of the given powers, each as one product of two smaller ones."""
    monomials: Monomials[Axis] = {(1, 0, 0): x, (0, 1, 0): y, (0, 0, 1): z}
    for i, j, k in powers.tolist():
        path = [(i, j, k)]
        while path[-1] not in monomials:  # down along x, then y, then z
            i, j, k = path[-1]  # noqa: PLW2901 - the way down
            path.append((i - 1, j, k) if i else (i, j - 1, k) if j else (i, j, k - 1))
        for power, smaller_power in zip(path[-2::-1], path[:0:-1], strict=True):
            monomials[power] = monomials[smaller_power] * (x if power[0] else y if power[1] else z)
    return monomials


def scanner_to_local_map(sop: Floats) -> ScannerToMap:
    """Return the transformation of an SOP (4, 4) that refers to a local map without a CRS."""
    to_local = sop.copy()
    to_local[:3, 3] = 0.0
    east_m, north_m, height_m = (float(v) for v in sop[:3, 3])
    return ScannerToMap((east_m, north_m, height_m), to_local, np.empty((0, 3), np.int64), np.empty((0, 3)))


def scanner_to_map_by_pop(sop: Floats, pop: Floats, crs: str, radius_m: float) -> ScannerToMap:
    """Return the transformation by SOP (4, 4), POP (4, 4) and map projection, to 1 mm within `radius_m`."""
    level = level_frame((pop @ sop)[:3, 3], crs)
    return _scanner_to_map(level, np.linalg.inv(level) @ pop @ sop, crs, radius_m)


def scanner_to_map_by_origin(
    sop: Floats, origin_deg_m: tuple[float, float, float], crs: str, radius_m: float
) -> ScannerToMap:
    """Return the transformation of an SOP (4, 4) to east, north, up at (latitude, longitude, height)."""
    latitude_deg, longitude_deg, height_m = origin_deg_m
    to_geocentric = Transformer.from_crs(GEOGRAPHIC, GEOCENTRIC, always_xy=True)
    origin_m = np.array(to_geocentric.transform(longitude_deg, latitude_deg, height_m))
    return scanner_to_map_by_pop(sop, tangent_frame(origin_m), crs, radius_m)


def scanner_to_map_directly(sop: Floats, crs: str, radius_m: float) -> ScannerToMap:
    """Return the transformation of an SOP (4, 4) that refers to the map itself.

    Its translation is a map position; its rotation refers to axes along easting, northing and up there. A map
    is not a rigid frame: taken as one it is wrong by 0.9 m at 3.4 km from curvature alone and by more from
    scale (equations.md, 2.6). Only the scanner's position is therefore read as map coordinates.
    """
    to_geocentric = Transformer.from_crs(horizontal_crs(crs), GEOCENTRIC, always_xy=True)
    to_local = sop.copy()
    to_local[:3, 3] = 0.0
    return _scanner_to_map(
        level_frame(np.array(to_geocentric.transform(*sop[:3, 3])), crs), to_local, crs, radius_m
    )


def horizontal_crs(crs: str) -> CRS:
    """Return the horizontal part of a CRS; heights remain ellipsoidal."""
    full = CRS.from_user_input(crs)
    return full.sub_crs_list[0] if full.is_compound else full.to_2d()


def is_same_map(first: CRS, second: CRS) -> bool:
    """Return True if two horizontal CRS are the same, however they are written."""
    code = first.to_epsg()
    return first.equals(second, ignore_axis_order=True) or (code is not None and code == second.to_epsg())


def tangent_frame(geocentric_m: Floats) -> Floats:
    """Matrix (4, 4) from east, north, up at a point to WGS84 geocentric coordinates."""
    to_geographic = Transformer.from_crs(GEOCENTRIC, GEOGRAPHIC, always_xy=True)
    x_m, y_m, z_m = geocentric_m.tolist()
    longitude_deg, latitude_deg, _ = to_geographic.transform(x_m, y_m, z_m)
    sin_a, cos_a = math.sin(math.radians(longitude_deg)), math.cos(math.radians(longitude_deg))
    sin_b, cos_b = math.sin(math.radians(latitude_deg)), math.cos(math.radians(latitude_deg))
    frame = np.eye(4)
    frame[:3, 0] = (-sin_a, cos_a, 0.0)
    frame[:3, 1] = (-sin_b * cos_a, -sin_b * sin_a, cos_b)
    frame[:3, 2] = (cos_b * cos_a, cos_b * sin_a, sin_b)
    frame[:3, 3] = geocentric_m
    return frame


def level_frame(geocentric_m: Floats, crs: str) -> Floats:
    """Matrix (4, 4) from axes along easting, northing and up at a point to WGS84 geocentric coordinates.

    True north and grid north differ by 1.3° at Hintereisferner, which the head sweeps in eight seconds.
    """
    frame = tangent_frame(geocentric_m)
    to_map = Transformer.from_crs(GEOCENTRIC, horizontal_crs(crs), always_xy=True)
    along_m = frame[:3, 1] * [[-100.0], [100.0]] + geocentric_m  # the meridian
    (east_m,), (north_m,), _ = np.diff(to_map.transform(*along_m.T))
    frame[:3, :3] @= rotation_z(math.atan2(east_m, north_m))
    return frame


def _scanner_to_map(level: Floats, to_local: Floats, crs: str, radius_m: float) -> ScannerToMap:
    """Return the transformation to the map through a `level_frame` (4, 4)."""
    to_map = Transformer.from_crs(GEOCENTRIC, horizontal_crs(crs), always_xy=True)
    east_m, north_m, height_m = (float(axis_m) for axis_m in to_map.transform(*level[:3, 3]))
    local_m = _chebyshev_nodes(radius_m)
    mapped_m = to_map.transform(*level[:3, :3] @ local_m + level[:3, 3:])
    return _fit_polynomial((east_m, north_m, height_m), to_local, local_m, np.array(mapped_m))


def _chebyshev_nodes(radius_m: float) -> Floats:
    """Return Chebyshev nodes (3, n) of a local frame [m], within `radius_m` and half of it vertically."""
    axes = np.meshgrid(*[chebyshev.chebpts1(9)] * 3, indexing="ij")
    return np.stack([axis.ravel() for axis in axes]) * [[radius_m], [radius_m], [radius_m / 2]]


def _fit_polynomial(
    position_m: tuple[float, float, float],
    to_local: Floats,
    local_m: Floats,
    mapped_m: Floats,
) -> ScannerToMap:
    """Return the transformation of the nodes (3, n) to the map, with a fitted polynomial of fourth degree.

    The truncation error is 0.02 mm at 6 km; terms that never reach a quarter of a millimetre are dropped.
    """
    powers = np.array([(i, j, k) for i in range(5) for j in range(5 - i) for k in range(5 - i - j)][1:])
    extent_m = np.abs(local_m).max(axis=1)
    x, y, z = local_m / extent_m[:, None]
    monomials = _monomials(x, y, z, powers)
    design = np.stack([monomials[i, j, k] for i, j, k in powers.tolist()], axis=-1)
    coefficients = np.linalg.lstsq(design, (mapped_m - local_m).T - position_m, rcond=None)[0]
    coefficients[np.abs(coefficients) < MIN_SIZE_M] = 0.0
    coefficients /= np.prod(extent_m**powers, axis=1, keepdims=True)
    used = np.any(coefficients != 0.0, axis=1)
    return ScannerToMap(position_m, to_local, powers[used], coefficients[used])
