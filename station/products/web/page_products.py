"""Products on the page: the newest value of each quantity, a curve of the first one, and newest profiles."""

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


def product_profiles(products: list[ProductSeries], text: dict[str, str]) -> list[dict[str, Any]]:
    """Return each quantity along the line of each profile, of the newest usable scan with a value."""
    profiles = []
    for product in (product.usable for product in products if product.kind == "profile"):
        for name, unit in product.units.items():
            observed = np.flatnonzero(np.isfinite(product.columns[name]).any(axis=1))
            if not len(observed):
                continue
            profiles.append(
                {
                    "title": product.name,
                    "quantity": text[f"quantity_{name}"],
                    "unit": unit,
                    "digits": DIGITS[unit],
                    "time_s": float(product.start_s[observed[-1]]),
                    "distance_m": np.array(product.labels, np.float64),
                    "values": product.columns[name][observed[-1]],
                    "sigma": product.columns[f"{name}_uncertainty"][observed[-1]],
                }
            )
    return profiles
