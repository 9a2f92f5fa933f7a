"""Scans in other formats than LAS, scans that are converted, and projects of other programs."""
