"""What a LAS record says about its echo: whether it is ground, and how bright.

Source: LAS 1.4 R15 (ASPRS, 2019), tables 8 to 17.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import log, log10

import numpy as np
from laspy import PackedPointRecord, PointFormat
from numpy.typing import NDArray

from station.quantities import Bools, Floats, IntensityScale
from station.readers.las_header import LasFileHeader

NOISE_CLASSES = (7, 18)  # low and high noise
FLAG_BYTES = ("bit_fields", "raw_classification", "classification_flags", "classification")
MAX_INTENSITY = 65535  # intensity has 16 bits
INTENSITY_POSITION = 12  # in the record of every point format [bytes]
# PDAL (readers.rxp, reflectance_as_intensity) and RIEGL map -25 to 5 dB to the 16 bits of intensity.
LOWEST_DB, SPAN_DB = -25.0, 30.0
# Intensity 1 is 6 dB above a white surface: fresh snow fits, reflectors are clipped. Dark rock at grazing
# incidence (-25 dB) is then 52 of 65535, so that whole numbers resolve a single echo to 1 %.
WHITE = 0.25
LOWEST_RELATIVE_DB, HIGHEST_DB = -60.0, -10 * log10(WHITE)

Records = NDArray[np.void]


def discard_tables(point_format: PointFormat) -> dict[str, Bools]:
    """Return by byte of a record a table (256,): True for values that tell that the echo is not ground.

    These are returns before the last one, withheld points and noise. Return numbers that are zero are
    unknown and count as last.
    """
    every_byte = PackedPointRecord.zeros(256, point_format)
    fields = [name for name in FLAG_BYTES if name in every_byte.array.dtype.names]
    for name in fields:
        every_byte.array[name] = np.arange(256)
    number, count = (np.asarray(every_byte[name]) for name in ("return_number", "number_of_returns"))
    withheld = np.asarray(every_byte["withheld"]) > 0
    noise = np.isin(np.asarray(every_byte["classification"]), NOISE_CLASSES)
    returns_byte, *other_bytes = fields
    share_a_byte = len(other_bytes) == 1  # formats 0 to 5
    others = [withheld | noise] if share_a_byte else [withheld, noise]
    return {returns_byte: (number > 0) & (number < count), **dict(zip(other_bytes, others, strict=True))}


@dataclass(frozen=True)
class Brightness:
    """Where the brightness of an echo is in its record, and how it is converted to intensity."""

    field: np.dtype[np.void]  # record with the one field `value`
    convert: Callable[[NDArray[np.number]], Floats]
    in_extra_bytes: bool

    def intensity(self, records: Records) -> Floats:
        """Return the intensity (n,) of contiguous records, linear, 0-1; zero where it is unknown."""
        return self.convert(records.view(self.field)["value"])


def brightness_candidates(header: LasFileHeader, scale: IntensityScale) -> list[Brightness]:
    """Return the fields that may hold the brightness as the site file states it, the best one first."""
    candidates = []
    if scale in {"auto", "reflectance"} and (extra := header.reflectance) is not None:
        field = header.only(extra.dtype, extra.position)
        candidates.append(Brightness(field, from_decibels(extra.scale, extra.offset), in_extra_bytes=True))
    if scale in {"auto", "linear", "decibel"}:
        field = header.only("<u2", INTENSITY_POSITION)
        convert = from_decibels(SPAN_DB / MAX_INTENSITY, LOWEST_DB) if scale == "decibel" else _from_linear
        candidates.append(Brightness(field, convert, in_extra_bytes=False))
    return candidates


def _from_linear(values: NDArray[np.number]) -> Floats:
    return np.asarray(values * (1 / MAX_INTENSITY))


def from_decibels(scale: float, offset: float) -> Callable[[NDArray[np.number]], Floats]:
    """Return the conversion of `scale` times a value plus `offset`, in dB relative to white, to intensity."""

    def convert(values: NDArray[np.number]) -> Floats:
        relative_db = values.astype(np.float64)
        with np.errstate(all="ignore"):  # whatever the extra bytes hold
            relative_db *= scale
            relative_db += offset
            np.clip(relative_db, LOWEST_RELATIVE_DB, HIGHEST_DB, out=relative_db)
        relative_db *= log(10) / 10
        linear = np.exp(relative_db, out=relative_db)
        linear *= WHITE
        return np.nan_to_num(linear, copy=False, nan=0.0) if values.dtype.kind == "f" else linear

    return convert
