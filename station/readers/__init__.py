"""File formats to arrays: the readers know formats and no equations."""
