"""Where the scanner stands: rotations, SOP, POP and the way to the map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.polynomial import chebyshev
from pyproj import CRS, Transformer

from station.quantities import Floats, Floats32, Ints, Tilt

KNOT_RAD = 3e-5  # of lean, apart
SHORTEST_S = 1e-9  # between knots
LEAST_M = 0.25e-3  # of a term on the way to the map, to be heeded
GEOCENTRIC = "EPSG:4978"  # WGS84, where a POP leads
GEOGRAPHIC = "EPSG:4979"  # WGS84 with ellipsoidal height

Axis = TypeVar("Axis", Floats, Floats32)
Monomials = dict[tuple[int, int, int], Axis]


def rotation_x(angle_rad: float) -> Floats:
    """Matrix (3, 3) that turns points about x, counter-clockwise. Source: EQUATIONS 2.1."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> Floats:
    """Matrix (3, 3) that turns points about y, counter-clockwise. Source: EQUATIONS 2.1."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> Floats:
    """Matrix (3, 3) that turns points about z, counter-clockwise. Source: EQUATIONS 2.1."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation(omega_rad: float, phi_rad: float, kappa_rad: float) -> Floats:
    """Matrix (3, 3) that turns points by omega about x, then phi about y, then kappa about z.

    Source: Hartzell et al. (2015), Eq. 3; the order is that of the author's published code.
    """
    return np.asarray(rotation_z(kappa_rad) @ rotation_y(phi_rad) @ rotation_x(omega_rad))


@dataclass(frozen=True)
class Turning:
    """A rotation that changes with time: what it is at some moments, linear from one to the next.

    Before the first and after the last it stays as it is there.
    """

    time_s: Floats  # (k,) increasing
    matrix: Floats  # (k, 3, 3) from that moment on …
    per_s: Floats  # (k, 3, 3) … and what each second adds to it

    def turned(self, xyz_m: Floats, time_s: Floats) -> Floats:
        """Coordinates (3, n) of shots [m], each turned as at its moment. Fastest where they come in turn."""
        turned_m = np.empty_like(xyz_m)
        if not len(time_s):
            return turned_m
        if np.any(time_s[1:] < time_s[:-1]):
            order = np.argsort(time_s, kind="stable")
            turned_m[:, order] = self.turned(xyz_m.take(order, axis=1), time_s[order])
            return turned_m
        first, last = np.searchsorted(self.time_s[1:], (time_s[0], time_s[-1]), side="right").tolist()
        edges = [0, *np.searchsorted(time_s, self.time_s[first + 1 : last + 1]).tolist(), len(time_s)]
        for knot, part in zip(range(first, last + 1), map(slice, edges, edges[1:]), strict=False):
            here_m = _product(self.per_s[knot], xyz_m[:, part])
            here_m *= np.maximum(time_s[part] - self.time_s[knot], 0.0)
            np.add(here_m, _product(self.matrix[knot], xyz_m[:, part]), out=turned_m[:, part])
        return turned_m


def _product(matrix: Floats, points_m: Floats) -> Floats:
    """Return a matrix (3, 3) times points (3, n), the same of each whatever is beside it."""
    if points_m.shape[1] == 1:  # which BLAS multiplies in another way, with another last digit
        return _product(matrix, points_m.repeat(2, axis=1))[:, :1]
    return np.asarray(matrix @ points_m)


def turning(tilt: Tilt | None, then: Floats) -> Turning:
    """Return how shots are turned upright by the tilt of their moment, `then` by a matrix (3, 3) of all time.

    R_D = Ry(pitch) Rx(roll), in the scanner's frame, before the SOP; between knots `KNOT_RAD` apart it is
    linear but for 1e-10. Source: Hartzell et al. (2015), Eq. 5, which adds it to the chain of Eq. 4.
    """
    if tilt is None:
        return Turning(np.zeros(1), then[None], np.zeros((1, 3, 3)))
    knots = np.stack([tilt.time_s, tilt.roll_rad, tilt.pitch_rad])
    steps = np.ceil(np.abs(np.diff(knots[1:])).max(axis=0, initial=0.0) / KNOT_RAD).astype(np.int64)
    along = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1))])
    time_s, roll_rad, pitch_rad = (np.interp(np.arange(along[-1] + 1), along, one) for one in knots)
    (sin_r, sin_p), (cos_r, cos_p) = ((f(roll_rad), f(pitch_rad)) for f in (np.sin, np.cos))
    upright = [
        [cos_p, sin_p * sin_r, sin_p * cos_r],
        [0 * sin_r, cos_r, -sin_r],
        [-sin_p, cos_p * sin_r, cos_p * cos_r],
    ]
    matrix = then @ np.moveaxis(np.array(upright), -1, 0)
    per_s = np.diff(matrix, axis=0) / np.maximum(np.diff(time_s), SHORTEST_S)[:, None, None]
    return Turning(time_s, matrix, np.concatenate([per_s, np.zeros((1, 3, 3))]))


@dataclass(frozen=True)
class Frame:
    """The way from the upright scanner frame to the map.

    First the rigid `to_local` (4, 4) into a frame at the scanner, whose axes lie along easting, northing and
    up there; then what the map is beyond that frame at `position_m`: a polynomial in x, y and z [m] with
    `powers` (m, 3) and `coefficients` (m, 3) for easting, northing and height [m].
    """

    position_m: tuple[float, float, float]
    to_local: Floats
    powers: Ints
    coefficients: Floats

    def to_map(self, local_m: Floats) -> Floats:
        """Easting, northing and height (3, n) [m] of points (3, n) in the local frame."""
        # What bends and scales is metres: 24 bits hold it to a micrometre, at half the cost.
        x, y, z = local_m.astype(np.float32)
        monomials, scratch = _monomials(x, y, z, self.powers), np.empty_like(x)
        bent_m = np.zeros(local_m.shape, np.float32)
        for power, row_m in zip(self.powers.tolist(), self.coefficients.tolist(), strict=True):
            for axis_m, coefficient_m in zip(bent_m, row_m, strict=True):
                if coefficient_m:
                    np.multiply(monomials[tuple(power)], coefficient_m, out=scratch)
                    np.add(axis_m, scratch, out=axis_m)
        mapped_m = bent_m.astype(np.float64)
        mapped_m += local_m
        mapped_m += np.array(self.position_m)[:, None]
        return mapped_m

    def after(self, seen: Callable[[Floats], Floats], reach_m: float) -> Frame:
        """Return the way of points that are not where they seem to be in the local frame: `seen` tells where.

        They may be aside by little, and smoothly: that becomes part of the polynomial, good to 0.1 mm within
        reach where it is a metre.
        """
        local_m = _nodes(reach_m)
        return _fitted(self.position_m, self.to_local, local_m, self.to_map(seen(local_m)))


def _monomials(x: Axis, y: Axis, z: Axis, powers: Ints) -> Monomials[Axis]:
    """Every wanted monomial, each by one product of two smaller ones."""
    made: Monomials[Axis] = {(1, 0, 0): x, (0, 1, 0): y, (0, 0, 1): z}
    for i, j, k in powers.tolist():
        path = [(i, j, k)]
        while path[-1] not in made:  # down along x, then y, then z
            i, j, k = path[-1]  # noqa: PLW2901 - the way down
            path.append((i - 1, j, k) if i else (i, j - 1, k) if j else (i, j, k - 1))
        for wanted, smaller in zip(path[-2::-1], path[:0:-1], strict=True):
            made[wanted] = made[smaller] * (x if wanted[0] else y if wanted[1] else z)
    return made


def frame_in_local_map(sop: Floats) -> Frame:
    """Return the way of an SOP (4, 4) that leads straight to a local map without a CRS."""
    to_local = sop.copy()
    to_local[:3, 3] = 0.0
    east_m, north_m, height_m = (float(v) for v in sop[:3, 3])
    return Frame((east_m, north_m, height_m), to_local, np.empty((0, 3), np.int64), np.empty((0, 3)))


def frame_by_pop(sop: Floats, pop: Floats, crs: str, reach_m: float) -> Frame:
    """Return the way SOP (4, 4), POP (4, 4) to WGS84 geocentric, map, good to 1 mm within `reach_m`."""
    level = level_frame((pop @ sop)[:3, 3], crs)
    return _frame(level, np.linalg.inv(level) @ pop @ sop, crs, reach_m)


def frame_by_origin(sop: Floats, origin_deg_m: tuple[float, float, float], crs: str, reach_m: float) -> Frame:
    """Return the way of an SOP (4, 4) that leads to east, north, up at (latitude, longitude, height)."""
    latitude_deg, longitude_deg, height_m = origin_deg_m
    to_geocentric = Transformer.from_crs(GEOGRAPHIC, GEOCENTRIC, always_xy=True)
    origin_m = np.array(to_geocentric.transform(longitude_deg, latitude_deg, height_m))
    return frame_by_pop(sop, tangent_frame(origin_m), crs, reach_m)


def frame_on_map(sop: Floats, crs: str, reach_m: float) -> Frame:
    """Return the way of an SOP (4, 4) that leads straight to a map.

    Its translation is a map position; its rotation leads to axes along easting, northing and up there. A map
    is not a rigid frame: taken as one it is wrong by 0.9 m at 3.4 km from curvature alone and by more from
    scale (EQUATIONS 2.6). So only the scanner's position is read in the map.
    """
    to_geocentric = Transformer.from_crs(horizontal_crs(crs), GEOCENTRIC, always_xy=True)
    to_local = sop.copy()
    to_local[:3, 3] = 0.0
    return _frame(level_frame(np.array(to_geocentric.transform(*sop[:3, 3])), crs), to_local, crs, reach_m)


def horizontal_crs(crs: str) -> CRS:
    """Return the horizontal part of a CRS; heights stay on the ellipsoid."""
    wanted = CRS.from_user_input(crs)
    return wanted.sub_crs_list[0] if wanted.is_compound else wanted.to_2d()


def is_same_map(one: CRS, other: CRS) -> bool:
    """Tell whether two horizontal CRS are the same, however their writers worded them."""
    code = one.to_epsg()
    return one.equals(other, ignore_axis_order=True) or (code is not None and code == other.to_epsg())


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

    True north lies 1.3° beside grid north at Hintereisferner: the head passes that in eight seconds.
    """
    upright = tangent_frame(geocentric_m)
    to_map = Transformer.from_crs(GEOCENTRIC, horizontal_crs(crs), always_xy=True)
    along_m = upright[:3, 1] * [[-100.0], [100.0]] + geocentric_m  # the meridian
    (east_m,), (north_m,), _ = np.diff(to_map.transform(*along_m.T))
    upright[:3, :3] @= rotation_z(math.atan2(east_m, north_m))
    return upright


def _frame(level: Floats, to_local: Floats, crs: str, reach_m: float) -> Frame:
    """Return the way through a `level_frame` (4, 4) to the map."""
    to_map = Transformer.from_crs(GEOCENTRIC, horizontal_crs(crs), always_xy=True)
    east_m, north_m, height_m = (float(axis_m) for axis_m in to_map.transform(*level[:3, 3]))
    local_m = _nodes(reach_m)
    mapped_m = to_map.transform(*level[:3, :3] @ local_m + level[:3, 3:])
    return _fitted((east_m, north_m, height_m), to_local, local_m, np.array(mapped_m))


def _nodes(reach_m: float) -> Floats:
    """Return points (3, n) in a local frame [m] that tell all of a way within reach, half as far upward."""
    axes = np.meshgrid(*[chebyshev.chebpts1(9)] * 3, indexing="ij")
    return np.stack([axis.ravel() for axis in axes]) * [[reach_m], [reach_m], [reach_m / 2]]


def _fitted(
    position_m: tuple[float, float, float],
    to_local: Floats,
    local_m: Floats,
    mapped_m: Floats,
) -> Frame:
    """Return the way that leads the nodes (3, n) to where they are on the map, a polynomial of fourth degree.

    What that leaves out is 0.02 mm at 6 km; terms that never reach a quarter of a millimetre go too.
    """
    powers = np.array([(i, j, k) for i in range(5) for j in range(5 - i) for k in range(5 - i - j)][1:])
    far_m = np.abs(local_m).max(axis=1)
    x, y, z = local_m / far_m[:, None]
    monomials = _monomials(x, y, z, powers)
    design = np.stack([monomials[i, j, k] for i, j, k in powers.tolist()], axis=-1)
    coefficients = np.linalg.lstsq(design, (mapped_m - local_m).T - position_m, rcond=None)[0]
    coefficients[np.abs(coefficients) < LEAST_M] = 0.0
    coefficients /= np.prod(far_m**powers, axis=1, keepdims=True)
    used = np.any(coefficients != 0.0, axis=1)
    return Frame(position_m, to_local, powers[used], coefficients[used])
