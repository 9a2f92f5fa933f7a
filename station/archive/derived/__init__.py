"""Parts of files that are computed from the epochs: fingerprints, outlines of areas."""
