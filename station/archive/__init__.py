"""File formats of the store: arrays to bytes."""
