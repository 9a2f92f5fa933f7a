"""Analysis of adjusted scans: verdicts, calibration, change, volumes, sensitivity and precision."""
