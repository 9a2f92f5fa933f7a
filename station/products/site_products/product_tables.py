"""Products of the site file as tables: over time, the newest values, and compared with observations."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from station.archive.derived.product_files import SIGMAS, ProductSeries
from station.archive.schema import VERDICTS
from station.products.area_tables import Span, text_table
from station.products.epoch_table import csv_times
from station.science.gridding.significance import SIGNIFICANT_SIGMAS

DIGITS = {"m": 3, "m3": 1}  # after the point, by unit
HEADING_OF_PART = {"": "", **{f"_{part}": f"_{part.replace('uncertainty', 'sigma')}" for part in SIGMAS}}


def product_rows(product: ProductSeries, span: Span) -> Iterator[dict[str, Any]]:
    """Yield the values of a product in each scan of a span and each place, or at each distance."""
    headings = {
        f"{name}{part}": f"{name}{heading}_{unit}"
        for name, unit in product.units.items()
        for part, heading in HEADING_OF_PART.items()
    }
    if "coverage" in product.columns:
        headings["coverage"] = "coverage"
    label_heading = _label_heading(product)
    for index, verdict in enumerate(product.verdict.tolist()):
        if datetime.fromtimestamp(float(product.start_s[index]), UTC) not in span:
            continue
        times = csv_times(float(product.start_s[index]), float(product.end_s[index]))
        for position, label in enumerate(product.labels):
            values = {
                heading: float(product.columns[name][index, position]) for name, heading in headings.items()
            }
            yield {**times, label_heading: label, **values, "verdict": VERDICTS[verdict]}


def _label_heading(product: ProductSeries) -> str:
    return "distance_m" if product.kind == "profile" else "place"


def as_csv(rows: Iterable[dict[str, Any]]) -> str:
    """Return a CSV table; a missing value is empty."""
    stream, writer = io.StringIO(), None
    for row in rows:
        if writer is None:
            writer = csv.DictWriter(stream, list(row), lineterminator="\n")
            writer.writeheader()
        writer.writerow({name: _csv_value(value) for name, value in row.items()})
    return stream.getvalue()


def _csv_value(value: object) -> object:
    if not isinstance(value, float):
        return value
    return f"{value:.6g}" if np.isfinite(value) else ""


def as_text(product: ProductSeries, rows: Sequence[dict[str, Any]]) -> str:
    """Return a text table with 95 % intervals; of a profile the newest scan only."""
    label = _label_heading(product)
    if product.kind == "profile":
        rows = [row for row in rows if row["time_utc"] == rows[-1]["time_utc"]]
    if not rows:
        return "no scan in this span"
    header = ["time, UTC", label.replace("_m", ", m")]
    for name, unit in product.units.items():
        header += [f"{name}, {unit}", "95 %"]
    body = []
    for row in rows:
        cells = [row["start_utc"][:16].replace("T", " "), _label(row[label])]
        for name, unit in product.units.items():
            cells += value_and_interval(row[f"{name}_{unit}"], row[f"{name}_sigma_{unit}"], unit)
        body.append((*cells, row["verdict"]))
    return text_table((*header, "verdict"), body, left_aligned=(0, 1, len(header)))


def _label(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def value_and_interval(value: float, sigma: float, unit: str) -> tuple[str, str]:
    """Return a value and the half-width of its 95 % interval as texts; empty if it is unknown."""
    if not np.isfinite(value):
        return "", ""
    digits = DIGITS[unit]
    return f"{value:z.{digits}f}", f"±{SIGNIFICANT_SIGMAS * sigma:.{digits}f}"


def newest_rows(products: Iterable[ProductSeries]) -> Iterator[dict[str, Any]]:
    """Yield the newest usable value of each quantity and place of products; none of profiles."""
    for product in (product.usable for product in products if product.kind != "profile"):
        for name, unit in product.units.items():
            for position, place in enumerate(product.labels):
                values = product.columns[name][:, position]
                known = np.flatnonzero(np.isfinite(values))
                if len(known):
                    yield {
                        "product": product.name,
                        "place": place,
                        "quantity": name,
                        "unit": unit,
                        "value": float(values[known[-1]]),
                        "sigma": float(product.columns[f"{name}_uncertainty"][known[-1], position]),
                        "start_s": float(product.start_s[known[-1]]),
                    }


def newest_as_text(rows: Iterable[dict[str, Any]]) -> str:
    """Return a text table of the newest values."""
    body = [
        (
            row["product"], row["place"], row["quantity"],
            *value_and_interval(row["value"], row["sigma"], row["unit"]),
            row["unit"], f"{datetime.fromtimestamp(row['start_s'], UTC):%Y-%m-%d %H:%M}",
        )
        for row in rows
    ]  # fmt: skip
    if not body:
        return "no product has a value yet"
    return text_table(("product", "place", "quantity", "value", "95 %", "unit", "time, UTC"), body,
                      left_aligned=(0, 1, 2, 5, 6))  # fmt: skip
