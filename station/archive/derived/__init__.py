"""Files that are computed from the epochs, and parts of them: fingerprints, outlines of areas, boxes."""
