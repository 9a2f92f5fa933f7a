"""The simulated scanner: its motion, its inclination sensor, its shots."""
