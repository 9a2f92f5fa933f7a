"""Gridding: cell sums of a scan, viewing geometry, cell estimates and the reference surface."""
