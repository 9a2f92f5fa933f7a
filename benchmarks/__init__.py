"""What the station reaches, measured: accuracy against simulated truth, and time as ratios."""
