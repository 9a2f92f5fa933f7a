"""Numbers of Hartzell et al. (2015): VZ-4000 and LMS-Z390i."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from station.papers.paper_number import PaperNumber, scalar
from station.quantities import Bools, Floats, Grid, Reference
from station.scanners import SCANNERS
from station.science.analysis import volume
from station.science.geometry import beam, inclination, registration, terrain
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import parameter_layout
from station.science.uncertainty.propagation import aggregate_variance, to_shared_parameters

HARTZELL = "hartzell2015"
_H = SCANNERS["riegl-vz-4000"]


def _vz4000(elevation_deg: float, *, wide: bool, vertical: bool) -> float:
    resolution = beam.sigma_resolution(math.radians(_H["angle_resolution_deg"]))
    angle = math.hypot(resolution, beam.sigma_beam_angle(_H["beam_divergence_mrad"] * 1e-3) if wide else 0.0)
    jacobian = beam.polar_jacobian(np.array([500.0]), np.radians(np.array([elevation_deg])), np.array([0.3]))
    covariance = beam.point_covariance(jacobian, np.array([[_H["range_sigma_m"], angle, angle]]))
    return 1e3 * (math.sqrt(covariance[0, 2, 2]) if vertical else scalar(beam.error_ellipse(covariance)[0]))


def _widening(elevation_deg: float, *, vertical: bool) -> float:
    with_beam, without = (_vz4000(elevation_deg, wide=wide, vertical=vertical) for wide in (True, False))
    return with_beam / without


def _net_volume(
    measure: Callable[[Floats, terrain.BilinearSurface, Bools], volume.Volume],
    cell_m: float,
    shape: tuple[int, int],
    fields: float,
    sigmas_m: tuple[float, float],
) -> float:
    """Sigma of the net volume of equal level fields [m³], with one point per cell of each given sigma.

    The lattice of points is sheared slightly, because the triangulation of a square lattice is not unique.
    """
    grid = Grid(0.0, (shape[0] + 2) * cell_m, cell_m, shape[1] + 2, shape[0] + 2)  # a margin of one cell
    cells = np.zeros(grid.shape, bool)
    cells[1:-1, 1:-1] = True
    east_m, north_m = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    level = terrain.bilinear_surface(Reference.from_elevation(grid, "level", np.zeros(grid.shape)))
    points_m = np.stack([east_m + 1e-3 * north_m, north_m, np.ones_like(east_m)], axis=-1)
    field = measure(points_m, level, cells)
    gross_m6 = (
        fields
        * volume.independent_variance(field, np.broadcast_to(sigma_m**2 * np.eye(3), (len(east_m), 3, 3)))
        for sigma_m in sigmas_m
    )
    return math.sqrt(volume.difference_variance(*gross_m6))


MONTEZUMA_NET_M3 = 4.743 / 0.004e-2  # the volume that the printed σ is 0.004 % of


@cache
def _registration() -> registration.Registration:
    """Registration from twelve features within 600 m, six of them on planes, known to 3 cm, as at Montezuma.

    Their layout is not published and is drawn at random.
    """
    random = np.random.default_rng(1)
    azimuth, range_m = random.uniform(-1.2, 1.2, 12), random.uniform(100, 600, 12)
    target_m = np.stack(
        [range_m * np.cos(azimuth), range_m * np.sin(azimuth), random.uniform(0, 150, 12)], axis=-1
    )
    normal = np.where(np.arange(12)[:, None] < 6, 0.0, random.normal(size=(12, 3)))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    measured_m = target_m + 0.03 * random.normal(size=(12, 3))
    features = registration.Features(("f",) * 12, measured_m, target_m, normal, np.full(12, 0.03))
    return registration.solve(features, np.eye(4))


def _registration_volume() -> float:
    """Sigma of the net volume over 140,000 m² by the registration errors of two epochs [m³]."""
    grid = Grid(100.0, 175.0, 5.0, 80, 70)
    params = parameter_layout(grid, (0.0, 0.0, 0.0))
    east_m, north_m = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    none = np.zeros_like(east_m)
    jacobian = height_jacobian(params, (east_m, north_m, 0.2 * east_m), none + 0.2, none)
    shared = to_shared_parameters(params, _registration().covariance)
    gross_m6 = aggregate_variance(none + grid.cell_m**2, none, jacobian, shared)
    return math.sqrt(volume.difference_variance(gross_m6, gross_m6))


_DOUBLES_NOTE = "'roughly doubles' holds for the horizontal error only"

HARTZELL_NUMBERS = (
    PaperNumber(HARTZELL, "Fig. 7", "χ² of the 68.3 % ellipse", "1", 2.298, 2.2977, 1e-4,
           lambda: scalar(beam.error_ellipse(np.eye(3)[None])[0]) ** 2),
    PaperNumber(HARTZELL, "Table 1", "diameter of the VZ-4000's beam at 500 m", "m", None, 0.093, 1e-6,
           lambda: scalar(beam.diameter(np.array([500.0]), _H["beam_divergence_mrad"] * 1e-3, _H["exit_diameter_m"]))),
    PaperNumber(HARTZELL, "Eq. 7", "angle from the beam's width, VZ-4000", "µrad", None, 37.5, 1e-9,
           lambda: 1e6 * beam.sigma_beam_angle(_H["beam_divergence_mrad"] * 1e-3)),
    PaperNumber(HARTZELL, "section 2.3", "angle from the resolution of 0.0005°", "µrad", None, 2.52, 0.01,
           lambda: 1e6 * beam.sigma_resolution(math.radians(0.0005))),
    *(
        PaperNumber(HARTZELL, "Fig. 7", f"{name} error at 500 m, {elevation}°, {'with' if wide else 'without'} beam",
               "mm", None, expected, 0.01,
               lambda e=elevation, w=wide, v=vertical: _vz4000(e, wide=w, vertical=v))  # type: ignore[misc]
        for name, vertical, elevation, wide, expected in (
            ("horizontal", False, 0, False, 15.16), ("horizontal", False, 0, True, 28.49),
            ("vertical", True, 0, False, 1.26), ("vertical", True, 0, True, 18.79),
            ("vertical", True, 40, False, 6.50), ("vertical", True, 40, True, 15.77),
        )
    ),
    PaperNumber(HARTZELL, "Fig. 7", "factor of the beam in the horizontal error, level", "1", 2.0, 1.879, 1e-3,
           lambda: _widening(0, vertical=False), "the text says 'roughly doubles'"),
    PaperNumber(HARTZELL, "Fig. 7", "factor of the beam in the vertical error, level", "1", 2.0, 14.92, 0.01,
           lambda: _widening(0, vertical=True), _DOUBLES_NOTE),
    PaperNumber(HARTZELL, "Fig. 7", "factor of the beam in the vertical error, at 40°", "1", 2.0, 2.425, 1e-3,
           lambda: _widening(40, vertical=True), _DOUBLES_NOTE),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, raster, Montezuma, cells of 22.2 and 12.3 mm", "m³", 4.743,
           4.743, 0.05, lambda: _net_volume(volume.raster_volume, 0.5, (70, 80), 100, (0.0222, 0.0123)),
           "the σ of the cells is derived from it", is_check=False),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, raster, Mammoth, cells of 2.6 and 1.6 mm", "m³", 0.0182,
           0.0182, 2e-4, lambda: _net_volume(volume.raster_volume, 0.25, (80, 112), 1, (0.0026, 0.0016)),
           "the σ of the cells is derived from it", is_check=False),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, mesh, Montezuma, one point per cell", "m³", 8.647, 4.720, 0.01,
           lambda: _net_volume(volume.mesh_volume, 0.5, (70, 80), 100, (0.0222, 0.0123)),
           "on level ground a mesh of as many points has the σ of the raster; the points are not published"),
    PaperNumber(HARTZELL, "Table 2", "σ of the net volume, mesh, Mammoth, one point per cell", "m³", 0.0155, 0.01798, 5e-5,
           lambda: _net_volume(volume.mesh_volume, 0.25, (80, 112), 1, (0.0026, 0.0016)), "as above"),
    PaperNumber(HARTZELL, "Eq. 14-15", "σ of the net volume, Montezuma, by registration alone", "m³", 4.743, 1847.0, 1.0,
           _registration_volume, "the paper takes errors as independent from point to point; the layout of the features is simulated"),
    PaperNumber(HARTZELL, "Table 2", "the same in percent of the net volume", "%", 0.004, 1.558, 1e-3,
           lambda: 100 * _registration_volume() / MONTEZUMA_NET_M3, "as above"),
    PaperNumber(HARTZELL, "section 2.2", "largest σ of a rotation of that registration", "0.001°", 6.0, 3.96, 0.01,
           lambda: 1e3 * math.degrees(_registration().covariance.diagonal()[:3].max() ** 0.5),
           "the paper has 0.003-0.006° for its own layout of features"),
    PaperNumber(HARTZELL, "section 2.2", "largest σ of a shift of that registration", "cm", 3.0, 1.82, 0.01,
           lambda: 100 * float(_registration().covariance.diagonal()[3:].max() ** 0.5),
           "the paper has 1-3 cm for its own layout of features"),
    PaperNumber(HARTZELL, "section 2.2", "σ of the filtered inclination, 0.006° per sample", "0.001°", 6.0, 0.788,
           1e-3, lambda: 6.0 * math.sqrt(float(np.sum(inclination.blackman(101) ** 2))),
           "0.006° is of one sample; the filtered signal is better, and its error is common to all points"),
)  # fmt: skip
