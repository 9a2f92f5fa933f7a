"""Products of the site file: the quantities of `[[product]]`."""
