"""Resolution of heights, changes and standard deviations as stored: finer than σ tells, and no finer."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats32, Reals

MANTISSA_BITS, EXPONENT = 23, np.uint32(0x7F800000)  # of a float32
SIGMA_BITS = 5  # of the mantissa: two digits, 1.6 % at most
LEAST_STEP_M = 2.0**-24  # of the total σ
QUANTA_PER_SIGMA = 4.0  # at least, of heights and changes as stored
QUANTUM_M = (2.0**-14, 2.0**-4)  # smallest and largest


def round_sigma(sigma_m: Reals) -> Floats32:
    """Return standard deviations (n,) rounded to two digits, so that they take less space [m]."""
    step = np.uint32(1 << (MANTISSA_BITS - SIGMA_BITS))
    bits = sigma_m.astype(np.float32).view(np.uint32)
    return ((bits + step // np.uint32(2)) & ~(step - np.uint32(1))).view(np.float32)


def round_total(random_m: Floats32, systematic_m: Floats32) -> Floats32:
    """Return the total σ (n,) of a random and a systematic part, rounded [m].

    As many digits are kept as its difference to the systematic part needs to give the random part with two.
    """
    total_m = np.sqrt(random_m * random_m + systematic_m * systematic_m)
    with np.errstate(invalid="ignore"):
        range_m = np.asarray(random_m * random_m / total_m, np.float32)
    step_m = np.fmax(_power_of_two(range_m) * np.float32(2.0**-SIGMA_BITS), np.float32(LEAST_STEP_M))
    return np.asarray(np.rint(total_m / step_m) * step_m)


def quantum(random_m: Floats32) -> Floats32:
    """Return the power of two that heights and changes of cells (n,) are rounded to, by their random σ [m].

    Its error, at most an 8th of σ, adds less than 0.3 % to σ.
    """
    quantum_m = _power_of_two(random_m) * np.float32(1 / QUANTA_PER_SIGMA)
    return np.asarray(np.clip(quantum_m, np.float32(QUANTUM_M[0]), np.float32(QUANTUM_M[1])))


def _power_of_two(values: Floats32) -> Floats32:
    """Return the greatest power of two that is not above each of the positive values (n,)."""
    return (values.view(np.uint32) & EXPONENT).view(np.float32)
