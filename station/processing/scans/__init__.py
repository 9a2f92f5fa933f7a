"""Scans as files: where they lie, and reading them."""
