"""Reports on how good the results of a station are, and why."""
