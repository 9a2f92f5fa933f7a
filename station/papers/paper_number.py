"""A number of a paper that can be computed, and what its computations share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Floats


@dataclass(frozen=True)
class PaperNumber:
    """A number of a paper.

    `printed` is the value in the paper, None if it prints none; `expected` that of an independent
    computation; `computed` returns that of this program. `note` explains a difference between the printed and
    the expected value. `is_check` is False if the row cannot disagree: it converts a unit, or its inputs were
    chosen to give the printed value.
    """

    paper: str
    equation: str
    what: str
    unit: str
    printed: float | None
    expected: float
    tolerance: float  # of `computed` from `expected`
    computed: Callable[[], float]
    note: str = ""
    is_check: bool = True


def scalar(values: Floats) -> float:
    """Return the only number of an array."""
    return float(np.ravel(values)[0])
