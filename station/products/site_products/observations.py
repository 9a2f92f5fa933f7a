"""Observations of others (a stake, a gauge, a survey) in a CSV file, and how a product agrees with them."""

from __future__ import annotations

import csv
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from station.archive.derived.product_files import ProductSeries
from station.errors import ConfigError
from station.readers.regular_file import read_text

TIME, PLACE, SIGMA = "time_utc", "place", "_sigma"
MAX_GAP_S = 86_400.0  # between two scans, for a value between them


class ObservedValue(NamedTuple):
    """A value that was observed at a time, its one sigma (0 if not given), and the place, "" if only one."""

    time_s: float
    place: str
    quantity: str
    value: float
    sigma: float


@dataclass(frozen=True)
class Agreement:
    """Differences of a product to observations: product less observation, in the unit of the quantity."""

    quantity: str
    unit: str
    count: int
    bias: float
    rms: float
    z: float  # rms of the differences over one sigma of both; 1 if sigma is right


def compare(product: ProductSeries, observations: Path) -> list[Agreement]:
    """Return how a product agrees with observations, interpolated between scans at most a day apart.

    Raises ConfigError if the file cannot be used, or names a place that the product does not have.
    """
    product = product.usable
    pairs: dict[str, list[tuple[float, float]]] = {}
    for observed in read_observations(observations, product.units):
        place = observed.place or (product.labels[0] if len(product.labels) == 1 else "")
        if place not in product.labels:
            known = ", ".join(str(label) for label in product.labels)
            raise ConfigError(f"{observations}: no place {place!r}: give a column place with one of {known}")
        position = product.labels.index(place)  # type: ignore[arg-type] # names, not distances
        value, sigma = (
            _value_at(product, f"{observed.quantity}{part}", position, observed.time_s)
            for part in ("", "_uncertainty")
        )
        if np.isfinite(value):
            difference = value - observed.value, float(np.hypot(sigma, observed.sigma))
            pairs.setdefault(observed.quantity, []).append(difference)
    agreements = []
    for quantity, differences in pairs.items():
        difference_of, sigma_of = np.array(differences).T
        rms, z = (float(np.sqrt(np.mean(v**2))) for v in (difference_of, difference_of / sigma_of))
        bias, unit = float(difference_of.mean()), product.units[quantity]
        agreements.append(Agreement(quantity, unit, len(differences), bias, rms, z))
    return agreements


def _value_at(product: ProductSeries, name: str, position: int, time_s: float) -> float:
    """Return a value at a time, on the line between the scans on either side; NaN without them."""
    values = product.columns[name][:, position]
    known = np.isfinite(values)
    times_s, values = (product.start_s + product.end_s)[known] / 2, values[known]
    after = int(np.searchsorted(times_s, time_s))
    if after < len(times_s) and times_s[after] == time_s:
        return float(values[after])
    if not 0 < after < len(times_s) or times_s[after] - times_s[after - 1] > MAX_GAP_S:
        return float("nan")
    return float(np.interp(time_s, times_s[after - 1 : after + 1], values[after - 1 : after + 1]))


def agreement_text(agreement: Agreement) -> str:
    """Return a line about the agreement with observations."""
    unit = agreement.unit
    return (
        f"{agreement.quantity} less observations: n = {agreement.count}, bias {agreement.bias:+.4g} {unit},"
        f" rms {agreement.rms:.4g} {unit}, z {agreement.z:.2f}"
    )


def read_observations(path: Path, units: dict[str, str]) -> list[ObservedValue]:
    """Read rows `time_utc,NAME_UNIT[,NAME_sigma_UNIT][,place]`; `units` are those of the quantities by name.

    The columns are those that `station product --csv` writes; empty fields are left out. Raises ConfigError,
    with the line number, for an invalid row.
    """
    try:
        lines = read_text(path).splitlines()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not text in UTF-8") from error
    rows = csv.DictReader(lines)
    columns = {f"{name}_{unit}": (name, f"{name}{SIGMA}_{unit}") for name, unit in units.items()}
    present = columns.keys() & set(rows.fieldnames or ())
    if TIME not in (rows.fieldnames or ()) or not present:
        raise ConfigError(f"{path}: must begin with a line such as {TIME},{next(iter(columns))}")
    return [
        observation
        for row in rows
        for observation in _observations(f"{path}: line {rows.line_num}", row, columns, sorted(present))
    ]


def _observations(
    location: str,
    row: dict[str, str | None],
    columns: dict[str, tuple[str, str]],
    present: Collection[str],
) -> list[ObservedValue]:
    try:
        time = datetime.fromisoformat((row[TIME] or "").strip())
        time = time.replace(tzinfo=UTC) if time.tzinfo is None else time
        return [
            ObservedValue(
                time.timestamp(),
                (row.get(PLACE) or "").strip(),
                columns[column][0],
                float(row[column] or ""),
                float(row.get(columns[column][1]) or 0),
            )
            for column in present
            if (row[column] or "").strip()
        ]
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{location}: {error}: write times as 2026-03-01T06:00 and numbers") from error
