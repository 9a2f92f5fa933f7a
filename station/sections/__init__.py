"""The tables of the site file."""
