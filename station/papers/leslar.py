"""Numbers of Leslar et al. (2014): a mobile lidar, Table 1, "expected" and "ideal"."""

from __future__ import annotations

import math

import numpy as np

from station.papers import mobile_lidar
from station.papers.paper_number import PaperNumber
from station.science.analysis import sensitivity

LESLAR = "leslar2014"
_IDEAL_NOTE = "the σ of the INS is not printed, 0.007 m is assumed; nor is the geometry"


def _share(
    variables: tuple[str, ...],
    range_m: float,
    stated: dict[str, float] = mobile_lidar.EXPECTED,
    elevation_deg: float = 0.0,
) -> float:
    point, sigma = mobile_lidar.side_shot(range_m, math.radians(elevation_deg)), mobile_lidar.sigmas(stated)
    _, shares = sensitivity.first_order_variance(mobile_lidar.height, point, sigma)
    return 100 * sum(float(shares[mobile_lidar.VARIABLES.index(name)]) for name in variables)


def _sobol(variable: str, range_m: float, *, total: bool) -> float:
    point, sigma = mobile_lidar.side_shot(range_m), mobile_lidar.sigmas(mobile_lidar.EXPECTED)
    mask = np.array([name == variable for name in mobile_lidar.VARIABLES])
    indices = sensitivity.sobol(
        mobile_lidar.height, sensitivity.independent_normal(sigma, point), [mask, ~mask]
    )
    return 100 * float((indices.total if total else indices.first)[0])


def _third_order(*, printed: bool) -> float:
    """Third-order index of x y z, each with a sigma as large as its mean, by simulation [%]."""
    ones = np.ones(3)
    each = [np.arange(3) == index for index in range(3)]
    indices = sensitivity.interactions(
        lambda x: np.prod(x, axis=0), sensitivity.independent_normal(ones, ones), each, 32_768
    )
    return 100 * sum(
        share for combination, (share, _) in indices.items() if len(combination) > (1 if printed else 2)
    )


def _largest_interaction(order: int) -> float:
    """Interaction index of the mobile lidar's height for its `order` largest inputs, 100 m away [%]."""
    point, sigma = mobile_lidar.side_shot(100.0), mobile_lidar.sigmas(mobile_lidar.EXPECTED)
    largest = ("boresight_x", "lever_z", "vertical_angle")[:order]
    groups = [np.array([name == variable for name in mobile_lidar.VARIABLES]) for variable in largest]
    indices = sensitivity.interactions(
        mobile_lidar.height, sensitivity.independent_normal(sigma, point), groups
    )
    return 100 * indices[tuple(range(order))][0]


LESLAR_NUMBERS = (
    PaperNumber(LESLAR, "Eq. 6-7", "share of the lever arm's Z in the height, 2 m away", "%", 90.0, 88.98, 0.01,
           lambda: _share(("lever_z",), 2.0)),
    PaperNumber(LESLAR, "Eq. 6-7", "share of the INS's height, 2 m away", "%", 12.0, 10.90, 0.01,
           lambda: _share(("x",), 2.0), "σ of the INS is not printed; 0.007 m is chosen for 'about 12 %'", is_check=False),
    PaperNumber(LESLAR, "Eq. 6-7", "share of the boresight roll in the height, 100 m away", "%", 70.0, 69.25, 0.01,
           lambda: _share(("boresight_x",), 100.0)),
    PaperNumber(LESLAR, "Table 1", "ideal system: share of the INS's height, 2 m below", "%", 45.0, 49.49, 0.01,
           lambda: _share(("x",), 2.0, mobile_lidar.IDEAL, -90.0), _IDEAL_NOTE),
    PaperNumber(LESLAR, "Table 1", "ideal system: share of range and zero error, 2 m below", "%", 40.0, 34.34, 0.01,
           lambda: _share(("range", "zero_error"), 2.0, mobile_lidar.IDEAL, -90.0), _IDEAL_NOTE),
    PaperNumber(LESLAR, "Table 1", "ideal system: share of the vertical angle, 100 m away", "%", 40.0, 57.52, 0.01,
           lambda: _share(("vertical_angle",), 100.0, mobile_lidar.IDEAL), _IDEAL_NOTE),
    PaperNumber(LESLAR, "Eq. 10", "first Sobol index of the boresight roll, 100 m away", "%", 70.0, 69.2, 5.0,
           lambda: _sobol("boresight_x", 100.0, total=False)),
    PaperNumber(LESLAR, "Eq. 12", "total Sobol index of the boresight roll, 100 m away", "%", 70.0, 69.2, 5.0,
           lambda: _sobol("boresight_x", 100.0, total=True)),
    PaperNumber(LESLAR, "Eq. 11", "third-order index of x y z, each with σ equal to its mean", "%", None, 14.3, 2.0,
           lambda: _third_order(printed=False)),
    PaperNumber(LESLAR, "Eq. 11", "the same with only first-order terms subtracted, as printed", "%", None, 57.1, 4.0,
           lambda: _third_order(printed=True), "the pairs remain: the indices sum to more than 100 %"),
    PaperNumber(LESLAR, "Eq. 11", "interaction of boresight roll, lever Z, vertical angle, 100 m", "%", None, 0.0, 3.0,
           lambda: _largest_interaction(3)),
    PaperNumber(LESLAR, "Eq. 11", "subsets of 9 of the 18 variables", "1", 48620, 48620, 0.0,
           lambda: float(math.comb(len(mobile_lidar.VARIABLES), 9)), is_check=False),
)  # fmt: skip
