"""What is computed from the epochs: files, parts of them, and rasters that are not stored."""
