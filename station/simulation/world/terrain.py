"""A valley like that of Hintereisferner.

East-north-up at the station's mark on the ridge. The glacier flows from the west, 0.5-1.5 km north of the
scanner and 500 m below it; its tongue ends in the north-east, and rock walls surround it. The lengths below
are those of the valley at full size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from station.quantities import Floats
from station.simulation.randomness import rng_for

WEST_M, EAST_M, SOUTH_M, NORTH_M = -4700.0, 2100.0, -500.0, 3100.0
TONGUE_M = 750.0  # eastern end of the ice
CREST_M = -10.0  # north coordinate of the ridge at the mark


@dataclass(frozen=True)
class NodeField:
    """A field on nodes, bilinear between them, NaN outside; row 0 in the south."""

    west_m: float
    south_m: float
    step_m: float
    node: Floats  # (ny, nx)

    def at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the field at each place, in its own unit."""
        return self.with_slope(east_m, north_m)[0]

    def with_slope(self, east_m: Floats, north_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the field and its derivatives to the east and to the north, per metre."""
        ny, nx = self.node.shape
        across = (east_m - self.west_m) / self.step_m
        up = (north_m - self.south_m) / self.step_m
        inside = (across >= 0) & (across < nx - 1) & (up >= 0) & (up < ny - 1)
        column = np.where(inside, across, 0).astype(np.int64)
        row = np.where(inside, up, 0).astype(np.int64)
        across, up = across - column, up - row
        corner = row * nx + column
        flat = self.node.ravel()
        sw, se, nw, ne = (flat.take(corner + shift) for shift in (0, 1, nx, nx + 1))
        south, north = sw + across * (se - sw), nw + across * (ne - nw)
        value = np.where(inside, south + up * (north - south), np.nan)
        east = ((se - sw) + up * ((ne - nw) - (se - sw))) / self.step_m
        return value, east, (north - south) / self.step_m

    def with_nodes(self, node: Floats) -> NodeField:
        """Return another field on the same nodes."""
        return NodeField(self.west_m, self.south_m, self.step_m, node)


@dataclass(frozen=True)
class Valley:
    """The ground before any change, and its share of ice (1 ice, 0 rock, between at the edge)."""

    ground: NodeField
    ice: NodeField
    size: float


def build_valley(
    seed: int, size: float, step_m: float, roughness_m: float, roughness_length_m: float
) -> Valley:
    """Build the valley at `size` times its real size, on nodes `step_m` apart.

    `roughness_m` is the standard deviation of bumps with wavelengths from `roughness_length_m` to four times
    that.
    """
    nx = round((EAST_M - WEST_M) * size / step_m) + 1
    ny = round((NORTH_M - SOUTH_M) * size / step_m) + 1
    x: Floats = (WEST_M + np.arange(nx, dtype=np.float64) * step_m / size)[None, :]
    y: Floats = (SOUTH_M + np.arange(ny, dtype=np.float64) * step_m / size)[:, None]
    waves = [
        bumps(rng_for(seed, 10, kind), (ny, nx), step_m / size, short, long, stretch)
        for kind, (short, long, stretch) in enumerate([(350.0, 1400.0, 1.3), (110.0, 420.0, 3.5)])
    ]
    fine = bumps(rng_for(seed, 10, 9), (ny, nx), step_m, roughness_length_m, 4 * roughness_length_m, 1.0)
    rock, ice = _landforms(x, y, waves)
    calm = 1 - np.exp(-(x**2 + y**2) / 220.0**2)  # keeps the ridge near the scanner from blocking its view
    nearest = rock[np.abs(y).argmin(), np.abs(x).argmin()]
    height = size * (rock - nearest * np.exp(-(x**2 + y**2) / 300.0**2)) + calm * roughness_m * fine
    west_m, south_m = WEST_M * size, SOUTH_M * size
    ground = NodeField(west_m, south_m, step_m, height)
    return Valley(ground, ground.with_nodes(ice), size)


def _landforms(x: Floats, y: Floats, waves: list[Floats]) -> tuple[Floats, Floats]:
    """Return height [m] and share of ice from axis, crests, ribs and glacier."""
    axis = 1080 + 170 * np.sin(x / 830 + 0.5)
    floor = -500 - 0.10 * x + 25 * np.sin(x / 420)
    south_crest = CREST_M - 150 * (1 - np.cos(x / 760))
    south_top = -4 + 260 * (1 - np.exp(-((x / 1500) ** 2))) * np.where(x < 0, 1, -0.9)
    north_crest = axis + 1330 + 150 * np.sin(x / 610 + 2)
    north_top = 230 + 110 * np.sin(x / 480 + 1) + 60 * np.sin(x / 210)
    away = y - axis
    southern = away < 0
    reach = np.where(southern, axis - south_crest, north_crest - axis)
    top = np.where(southern, south_top, north_top)
    share = np.abs(away) / reach
    rise = np.where(southern, share**2.1, share**1.75)
    rise = np.where(share > 1, np.maximum(2 - share, -0.5), rise)  # descends beyond the crest
    calm = 1 - np.exp(-(x**2 + y**2) / 330.0**2)
    ribs = calm * np.clip(2.2 * (share - 0.33), 0, 1)
    coarse, middle = waves
    gullies = np.hypot(middle, 0.25) - 0.85  # gullies are sharper than the ribs between them
    bed = floor + (top - floor) * rise + ribs * (40 * coarse - 16 * gullies)
    half = 560 * np.sqrt(np.clip((TONGUE_M - x) / 2600, 1e-4, 1.15))
    crown = np.clip(1 - (away / half) ** 2, -1, 1) - np.clip((x - TONGUE_M) / 20, 0, 2)
    thick = np.clip(0.09 * half, 20, 70) * crown
    ice = 1 / (1 + np.exp(-np.clip(thick / 3.0, -40, 40)))
    surface = bed + np.where(thick > 0, thick, 0) + ice * (1.6 * coarse + 0.5 * middle)
    return surface, ice


def bumps(
    rng: np.random.Generator,
    shape: tuple[int, int],
    step_m: float,
    short_m: float,
    long_m: float,
    stretch: float,
) -> Floats:
    """Draw normal noise of standard deviation 1 with wavelengths between `short_m` and `long_m`.

    Long wavelengths have larger amplitudes. The noise is `stretch` times as long down the valley's sides as
    along them.
    """
    padded = (fft.next_fast_len(shape[0], real=True), fft.next_fast_len(shape[1], real=True))
    spectrum = fft.rfft2(rng.standard_normal(padded))
    per_m = np.hypot(
        stretch * fft.fftfreq(padded[0], step_m)[:, None], fft.rfftfreq(padded[1], step_m)[None, :]
    ).clip(1e-9)
    band = 1 / (1 + (per_m * short_m) ** 8) / (1 + (per_m * long_m) ** -8)
    field = fft.irfft2(spectrum * band * per_m**-1.5, s=padded)[: shape[0], : shape[1]]
    return np.asarray(field / field.std())
