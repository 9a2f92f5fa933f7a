"""Geometry: from a laser shot to a point on the map, and the surface below it."""
