"""Uncertainty: random errors of single shots, and parameters shared by all points of a scan."""
