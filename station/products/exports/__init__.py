"""Files to pass on: the series, or a part of it, in formats that stand alone."""
