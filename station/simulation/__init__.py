"""Simulation of a station with a known truth: terrain, air, motion and scanner become scan files."""
