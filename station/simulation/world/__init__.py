"""The simulated valley: terrain, surface change, air, stable ground."""
