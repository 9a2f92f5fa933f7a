"""What a series of scans tells: trends, filtered levels and rates, events."""
