"""A store on a plane slope, whose covariances are computed with dense matrices from equations.md, 6.1."""

import numpy as np
import xarray as xr
from support.epochs import random_epoch
from support.shared_parameters import SCANNER

from station.quantities import Grid, Reference, SharedParameters, VarianceComponents
from station.science.uncertainty import parameters

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=40, ny=30)
POSITION_M = tuple(list(SCANNER.values())[:3])
AXIS = (0.04, -0.02, np.sqrt(1 - 0.04**2 - 0.02**2))
EAST, NORTH = 0.25, -0.125  # slope of the reference, stored without rounding
PARAMS = parameters.parameter_layout(GRID, POSITION_M, AXIS)


def random_parameters(seed, size):
    """Return shared parameters with a full covariance of realistic size."""
    rng = np.random.default_rng(seed)
    scale = np.array([1e-4, 1e-4, 3e-5, 3e-3, 3e-3, 3e-3, 4e-3, 0.8, 0.05, 0.02])
    counts = PARAMS.sight_tilt_knots, PARAMS.refraction_knots, PARAMS.refraction_knots
    sigma = np.concatenate([scale, np.repeat([3e-5, 0.02, 3e-5], counts)])
    root = sigma[:, None] * rng.normal(size=(len(sigma), 3 * len(sigma))) / np.sqrt(3 * len(sigma))
    line_tilt = np.zeros(len(sigma))
    line_tilt[10 : 10 + PARAMS.knot_intervals] = rng.uniform(1e-10, 1e-9, PARAMS.knot_intervals)
    estimate = sigma * rng.normal(size=len(sigma))
    return SharedParameters(
        PARAMS.names, PARAMS.units, estimate, size**2 * root @ root.T, size**2 * line_tilt
    )


def make_epoch(hour, adjustment, shared, *, empty=False):
    random_m = np.random.default_rng(hour).uniform(0.01, 0.1, GRID.shape)
    return random_epoch(
        hour,
        GRID,
        random_m,
        unseen=np.full(GRID.shape, empty),
        shared=shared,
        scalars=SCANNER if shared else {},
        provenance={"adjustment": adjustment, "reference_version": "1"},
    )


def make_reference():
    elevation_m = 2800 + EAST * (GRID.x_m[None, :] - GRID.west_m) + NORTH * (GRID.y_m[:, None] - GRID.north_m)
    elevation_m[:3, 5:9] = np.nan
    rng = np.random.default_rng(99)
    random_m2 = np.where(np.isfinite(elevation_m), rng.uniform(0.01, 0.03, GRID.shape) ** 2, np.nan)
    zeros = np.zeros(GRID.shape, np.float32)
    return Reference(
        grid=GRID,
        version="1",
        elevation_m=elevation_m,
        mean_residual_m=zeros,
        random_variance_m2=random_m2.astype(np.float32),
        roughness_m2=zeros,
        shared=random_parameters(7, 0.5),
        scan_ids=("a", "b"),
        intensity=zeros,
        variance_factor=zeros + 1,
        stable=zeros > 0,
        components=VarianceComponents(),
        visibility=zeros + 1,
        point_count=np.full(GRID.shape, np.nan, np.float16),
    )


def head_azimuth(ds, index):
    """Return the azimuth of the head [°] at each cell (ny, nx), its offset [m] and its line of sight."""
    position = [float(ds[name][index]) for name in ("scanner_east", "scanner_north", "scanner_height")]
    x, y = np.meshgrid(ds.x.values - position[0], ds.y.values - position[1])
    z = 2800 + EAST * (ds.x.values - 632_000) + NORTH * (ds.y.values[:, None] - 5_186_000) - position[2]
    axis = np.array([float(ds[f"scanner_axis_{name}"][index]) for name in ("east", "north")])
    up = np.array([*axis, np.sqrt(1 - axis @ axis)])
    north = np.array([0, 1, 0]) - up[1] * up
    north /= np.linalg.norm(north)
    east = np.cross(north, up)
    azimuth = np.arctan2(*(d[0] * x + d[1] * y + d[2] * z for d in (east, north)))
    sight = [np.sin(azimuth) * e + np.cos(azimuth) * n for e, n in zip(east, north, strict=True)]
    return np.degrees(azimuth), (x, y, z), sight


def dense_jacobian(ds, index):
    """Return the Jacobian (cells, p) by the parameter names in the store, from equations.md, 6.1.

    And the derivatives (cells, groups) by the line tilt of each group in excess of its knots.
    """
    azimuth, (x, y, z), sight = head_azimuth(ds, index)
    distance = np.hypot(x, y)
    sight_tilt = -(distance + z * (EAST * x + NORTH * y) / distance)
    height_above_slope = z - EAST * x - NORTH * y
    bending = distance * -sight_tilt / (2 * 6_371_000.0)
    derivatives = {
        "tilt_east": -(y + NORTH * z),
        "tilt_north": x + EAST * z,
        "heading": EAST * y - NORTH * x,
        "translation_east": EAST + 0 * x,
        "translation_north": NORTH + 0 * x,
        "translation_up": -1 + 0 * x,
        "range_bias": height_above_slope / np.hypot(distance, z),
        "range_scale": height_above_slope * 1e-6,
        "refraction": bending,
        "refraction_ice": bending * ((ds.quality[index].values.astype(int) & 8) == 0),
    }
    rotations = derivatives["tilt_east"], derivatives["tilt_north"], -derivatives["heading"]
    cross_tilt = sum(rotation * part for rotation, part in zip(rotations, sight, strict=True))
    knot_series = {
        "sight_tilt": (1.0, sight_tilt),
        "refraction": (5.0, bending),
        "cross_tilt": (5.0, cross_tilt),
    }
    names = [str(name) for name in ds.parameter_name.values]
    tilt_azimuths = [float(name.rsplit("_", 1)[1]) for name in names if name.startswith("sight_tilt_")]
    for name in names[len(derivatives) :]:
        kind, knot = name.rsplit("_", 1)
        spacing, derivative = knot_series[kind]
        derivatives[name] = derivative * np.maximum(1 - np.abs(azimuth - float(knot)) / spacing, 0)
    group = np.floor((azimuth - min(tilt_azimuths)) / 0.2).astype(int).ravel()
    lines = np.arange(5 * (len(tilt_azimuths) - 1))
    line_tilt = np.where(group[:, None] == lines, sight_tilt.ravel()[:, None], 0.0)
    knots = np.maximum(1 - np.abs((lines[:, None] + 0.5) / 5 - np.arange(len(lines) // 5 + 1)), 0)
    line_tilt -= line_tilt @ knots @ np.linalg.lstsq(knots, np.eye(len(lines)), rcond=None)[0]
    return np.stack([derivatives[name].ravel() for name in names], axis=-1), line_tilt


def dense_variance(ds, weights, index, *, random_m2=None, reference=None):
    """Return Σ a² σ² + aᵀ (J C Jᵀ + J_δ D J_δᵀ) a of one epoch with dense matrices."""
    a = weights.ravel()
    covariance = ds.shared_parameter_covariance[index].values.astype(float)
    line_tilt = ds.shared_parameter_line_tilt_variance[index].values
    if random_m2 is None:
        random_m2 = ds.elevation_change_random_uncertainty[index].values.astype(float) ** 2
    if reference is not None:
        covariance = covariance + reference.covariance
        line_tilt = line_tilt + reference.line_tilt_variance
    return np.nansum(a**2 * random_m2.ravel()) + shared_variance(ds, weights, index, covariance, line_tilt)


def shared_variance(ds, weights, index, covariance, line_tilt):
    """Return aᵀ (J C Jᵀ + J_δ D J_δᵀ) a with the Jacobian of an epoch."""
    a, (design, line_design) = weights.ravel(), dense_jacobian(ds, index)
    by_line = line_tilt[10 + np.arange(line_design.shape[1]) // 5]
    shared_m2 = design @ covariance @ design.T + (line_design * by_line) @ line_design.T
    return a @ shared_m2 @ a


def reference_random_m2(series):
    with xr.open_dataset(series.folder / "reference.nc") as reference:
        return reference.reference_random_uncertainty.values.astype(float) ** 2


def independent_m2(ds, index, reference_m2):
    """Return the random variance (ny, nx) of an epoch without that of the reference."""
    random_m2 = ds.elevation_change_random_uncertainty[index].values.astype(float) ** 2
    return np.maximum(random_m2 - reference_m2, 0)
