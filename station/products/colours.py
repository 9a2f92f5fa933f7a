"""Colour scales: perceptually uniform, readable for the colour-blind, with fixed limits.

Vik, lajolla and davos are scientific colour maps of Crameri (2018), doi:10.5281/zenodo.1243862, reduced to as
few colours as keep linear interpolation between them within 2 of 255.
Copyright (c) 2020 Fabio Crameri; MIT licence, text in assets/colours.LICENSE.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.quantities import Floats, Floats32

Pixels = NDArray[np.uint8]  # (ny, nx, 3)

_VIK = (
    "001261021f69022b710237790344810551890c5e921c6d9c307da6488db2619ebd7aaec894bed2adcdddc6dbe6dee6e9ece5e0"
    "eedbd0e9ccbae3bca5dcac90d69d7ccf8e68c98056c37243bd6431b3531fa5400f942f06832106741506670a07590008"
)
_LAJOLLA = (
    "191900201c04271e082f210d3724114127164d2b1c592f2267342a763931853e3996423fa64644b74a48c54f4ad1564cd9604e"
    "dd694fe1744fe37d50e58751e79052e99a52eba353ecac54efb655f1c159f4cd61f7d971fae587fcef9ffef7b6fffecb"
)
_DAVOS = (
    "00054a031256081c610e276c1432771a3c802147892851902f5a9637639a3e6b9c46729d4e799d567f9b5d84996589966c8e93"
    "7392907a978d829d8a8ba38895aa87a0b289adbc8cbbc794cbd39fd9dfade6e9bceff0cbf5f6d9faf9e6fcfcf3fefefe"
)


@dataclass(frozen=True)
class ColourScale:
    """The colour scale of a quantity; values beyond a limit have the colour of the limit."""

    title: str
    low: float
    high: float
    ticks: tuple[float, ...]
    colours: Pixels  # (k, 3), from low to high
    logarithmic: bool = False

    def position(self, values: Floats | Floats32) -> Any:  # noqa: ANN401 - an array of the shape and type given
        """Return the position of values between the limits, 0 to 1."""
        if self.logarithmic:
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.log(values / self.low) / np.log(self.high / self.low)
        else:
            share = (values - self.low) / (self.high - self.low)
        return np.clip(np.nan_to_num(share, copy=False, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)

    def paint(self, values: Floats | Floats32) -> Pixels:
        """Return the colour of each value (…, 3)."""
        step = (self.position(values) * 255 + 0.5).astype(np.uint8)
        return np.asarray(self.colour_table()[step])

    def colour_table(self) -> Pixels:
        """Return 256 colours from low to high (256, 3)."""
        positions = np.linspace(0, 255, len(self.colours))
        bands = [np.interp(np.arange(256), positions, self.colours[:, band]) for band in range(3)]
        return np.stack(bands, axis=-1).round().astype(np.uint8)


def change_scale(limit_m: float, since: str, *, on_map: bool = True) -> ColourScale:
    """Return the scale of change up to `limit_m` [m]: red where the surface sank, blue where it rose.

    Of a grid that lies on another plane than the map: where it moved in, and out.
    """
    ticks = tuple(limit_m * share for share in (-1.0, -0.5, 0.0, 0.5, 1.0))
    quantity = "elevation change" if on_map else "change along the normal"
    return ColourScale(f"{quantity} since {since}, m", -limit_m, limit_m, ticks, _from_hex(_VIK)[::-1])


def sigma_scale(limit_m: float) -> ColourScale:
    """Return the scale of sigma [m]: dark where it is large, two decades up to the limit of the change."""
    return _log_scale("1 σ of the change, m", limit_m / 100, limit_m, _from_hex(_LAJOLLA)[::-1])


def points_scale() -> ColourScale:
    """Return the scale of points per cell: dark where there are many."""
    return _log_scale("laser points per cell", 1.0, 100.0, _from_hex(_DAVOS)[-5::-1])  # without the white end


def _log_scale(title: str, low: float, high: float, colours: Pixels) -> ColourScale:
    count = round(np.log10(high / low)) + 1
    ticks = tuple(float(tick) for tick in low * 10.0 ** np.arange(count))
    return ColourScale(title, low, high, ticks, colours, logarithmic=True)


def _from_hex(hex_text: str) -> Pixels:
    return np.frombuffer(bytes.fromhex(hex_text), np.uint8).reshape(-1, 3)


def shared_palette() -> Pixels:
    """Return up to 256 colours (k, 3) shared by all maps: neutral greys, and the scales lit and shaded."""
    greys = np.repeat(np.linspace(96, 252, 40).round()[:, None], 3, axis=1)
    shaded = [np.minimum(_from_hex(_VIK) * brightness, 255) for brightness in (0.86, 0.93, 1.0, 1.05)]
    text_colours = [
        (250, 250, 248),
        (30, 33, 38),
        (70, 72, 76),
        (105, 110, 118),
        (158, 60, 0),
        (203, 155, 125),
        (176, 168, 188),  # hatching
    ]
    return (
        np.vstack([greys, *shaded, _from_hex(_LAJOLLA), _from_hex(_DAVOS), text_colours])
        .round()
        .astype(np.uint8)
    )


def round_up(value: float) -> float:
    """Return the value rounded up to the next of 0.1, 0.2, 0.5, 1, 2, 5 and so on."""
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(decade * step for step in (1, 2, 5, 10) if decade * step >= value * (1 - 1e-9)))
