"""A product of a small site, written as the service would write it."""

import numpy as np

from station.archive.derived.boxes import Entries
from station.archive.derived.product_files import QUANTITIES, SIGMAS, ProductFile, update_product
from station.processing.site_files import series_for


def write_melt(site, start_s, values, verdicts=None):
    """Write the product `Ice melt` of one stake: values [m] with a sigma of 0.1 m."""
    write_product(site, "melt", "melt", start_s, values, verdicts, name="Ice melt")


def write_product(site, kind, quantity, start_s, values, verdicts=None, *, name="Rock"):
    """Write a product of one stake: values of one of its quantities [m] with a sigma of 0.1 m."""
    start_s = np.asarray(start_s, dtype=float)
    texts = np.array([f"e{index}".encode() for index in range(len(values))])
    key = name.lower().replace(" ", "_")
    product = ProductFile(key, name, kind, str(values), "place", np.zeros(1), np.zeros(1), ("stake",))

    def row(index):
        columns = {spec.name: np.full(1, np.nan) for spec in QUANTITIES[kind]}
        sigmas = {f"{quantity}_{part}": np.array([0.1]) for part in SIGMAS}
        return columns | {quantity: np.array([values[index]]), "coverage": np.ones(1), **sigmas}

    verdict = np.zeros(len(values), int) if verdicts is None else np.array(verdicts)
    entries = Entries(start_s, start_s + 60, texts, texts)
    update_product(series_for(site), product, entries, verdict, row, lambda: None)
