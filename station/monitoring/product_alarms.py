"""Alarms on the value of a product: beyond a level by more than its uncertainty, in scans in a row."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

import numpy as np

from station.archive.derived.product_files import ProductSeries, product_path, read_product
from station.config import Site
from station.errors import ConfigError
from station.monitoring.alarm_state import Alarm
from station.quantities import Bools, Floats
from station.science.gridding.significance import SIGNIFICANT_SIGMAS
from station.sections.product import product_key
from station.sections.results import ProductAlarm


def product_alarms(site: Site, rule: ProductAlarm, assessed_until_utc_s: float | None) -> Iterator[Alarm]:
    """Yield an alarm for each place where scans not assessed yet, or the newest, are beyond a level.

    Raises StoreError if the product cannot be read; nothing is yielded before it has a file.
    """
    if not product_path(site.station.data, product_key(rule.product)).is_file():
        return
    product = read_product(site.station.data, rule.product).usable
    if rule.quantity not in product.units:
        raise ConfigError(
            f"alarms.product: {rule.product} has no {rule.quantity}; it has {', '.join(product.units)}"
        )
    for position, place in enumerate(product.labels):
        values = product.columns[rule.quantity][:, position]
        known = np.flatnonzero(np.isfinite(values))
        half = SIGNIFICANT_SIGMAS * product.columns[f"{rule.quantity}_uncertainty"][:, position]
        beyond = _beyond(values[known], half[known], rule)
        since_s = np.inf if assessed_until_utc_s is None else assessed_until_utc_s
        is_new = product.start_s[known] > since_s
        is_new[-1:] = True
        if (beyond & is_new).any():
            row = int(known[np.flatnonzero(beyond & is_new)[-1]])
            yield _alarm(product, rule, str(place), row, float(values[row]), float(half[row]))


def _beyond(values: Floats, half: Floats, rule: ProductAlarm) -> Bools:
    """Return True for scans (n,) that are beyond a level with as many before them as the rule asks for."""
    beyond = np.zeros(len(values), np.bool_)
    if rule.above is not None:
        beyond |= values - half > rule.above
    if rule.below is not None:
        beyond |= values + half < rule.below
    lasting = beyond.copy()
    for scans in range(1, rule.scans):
        lasting[scans:] &= beyond[:-scans]
        lasting[:scans] = False
    return lasting


def _alarm(
    product: ProductSeries, rule: ProductAlarm, place: str, row: int, value: float, half: float
) -> Alarm:
    unit = product.units[rule.quantity]
    is_above = rule.above is not None and value > rule.above
    level = f"above {rule.above:g}" if is_above else f"below {rule.below:g}"
    when = f"{datetime.fromtimestamp(float(product.start_s[row]), UTC):%Y-%m-%d %H:%M}"
    text = (
        f"{product.name}, {place}: {rule.quantity} is {value:.3g} {unit} (± {half:.2g} {unit} at 95 %),"
        f" {level} {unit}, at {when} UTC"
    )
    return Alarm(f"product {product.key} {place} {rule.quantity}", text, size=abs(value))
