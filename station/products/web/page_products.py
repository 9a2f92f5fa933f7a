"""Products on the page: the newest value of each quantity, and a curve of the first one in each place."""

from __future__ import annotations

from typing import Any

import numpy as np

from station.archive.derived.product_files import ProductSeries
from station.products.site_products.product_tables import DIGITS, newest_rows
from station.science.gridding.significance import SIGNIFICANT_SIGMAS


def product_values(products: list[ProductSeries], text: dict[str, str]) -> list[dict[str, Any]]:
    """Return the newest usable value of each quantity and place with the half-width of its 95 % interval."""
    return [
        row
        | {
            "quantity": text[f"quantity_{row['quantity']}"],
            "unit": row["unit"].replace("m3", "m³"),
            "half": SIGNIFICANT_SIGMAS * row["sigma"],
            "digits": DIGITS[row["unit"]],
        }
        for row in newest_rows(products)
    ]


def product_curves(products: list[ProductSeries], text: dict[str, str]) -> list[dict[str, Any]]:
    """Return the curve of the first quantity of each product and place, without unusable scans."""
    curves = []
    for product in (product.usable for product in products if product.kind != "profile"):
        name, unit = next(iter(product.units.items()))
        for position, place in enumerate(product.labels):
            values = product.columns[name][:, position]
            known = np.isfinite(values)
            curves.append(
                {
                    "product": product.name,
                    "place": place,
                    "title": product.name if place == product.name else f"{product.name}, {place}",
                    "quantity": text[f"quantity_{name}"],
                    "unit": unit.replace("m3", "m³"),
                    "digits": DIGITS[unit],
                    "time_s": product.start_s[known],
                    "values": values[known],
                    "sigma": product.columns[f"{name}_uncertainty"][:, position][known],
                }
            )
    return curves
