"""Numbers of Ozendi et al. (2016): FARO X330."""

from __future__ import annotations

import math

import numpy as np

from station.papers.paper_number import PaperNumber, scalar
from station.science.analysis import precision
from station.science.geometry import beam

OZENDI = "ozendi2016"
_STEP_NOTE = "different spots are compared: the scatter is step/√12, not the encoder's"


def _sampling_cc(step_cc: float) -> float:
    return beam.sigma_resolution(step_cc * precision.CC_RAD) / precision.CC_RAD


def _more_than_residual_pct(incidence_deg: float) -> float:
    return 100 * (scalar(precision.sigma_range(np.array([1.0]), np.cos(np.radians([incidence_deg])))) - 1)


OZENDI_NUMBERS = (
    PaperNumber(OZENDI, "Table 1", "36.6cc of the horizontal angle", "0.001°", None, 3.294, 1e-3,
           lambda: 1e3 * math.degrees(36.6 * precision.CC_RAD), is_check=False),
    PaperNumber(OZENDI, "Table 1", "36.6cc of the horizontal angle", "µrad", None, 57.5, 0.05,
           lambda: 1e6 * 36.6 * precision.CC_RAD, is_check=False),
    PaperNumber(OZENDI, "Table 1", "17.8cc of the vertical angle", "0.001°", None, 1.602, 1e-3,
           lambda: 1e3 * math.degrees(17.8 * precision.CC_RAD), is_check=False),
    PaperNumber(OZENDI, "Table 1", "17.8cc of the vertical angle", "µrad", None, 28.0, 0.05,
           lambda: 1e6 * 17.8 * precision.CC_RAD, is_check=False),
    PaperNumber(OZENDI, "Table 1", "scatter from sampling alone at a step of 200cc", "cc", 36.6, 57.7, 0.1,
           lambda: _sampling_cc(200), _STEP_NOTE),
    PaperNumber(OZENDI, "Table 1", "scatter from sampling alone at a step of 400cc", "cc", 59.8, 115.5, 0.1,
           lambda: _sampling_cc(400), _STEP_NOTE),
    PaperNumber(OZENDI, "Table 1", "scatter from sampling alone at a step of 800cc", "cc", 154.1, 230.9, 0.1,
           lambda: _sampling_cc(800), _STEP_NOTE),
    PaperNumber(OZENDI, "section 4", "σ of the range above the residual across a plane at 30°", "%", None, 15.5, 0.1,
           lambda: _more_than_residual_pct(30), "the paper does not divide by cos α"),
    PaperNumber(OZENDI, "section 4", "σ of the range above the residual across a plane at 45°", "%", None, 41.4, 0.1,
           lambda: _more_than_residual_pct(45), "the paper does not divide by cos α"),
)  # fmt: skip
