"""Products of the site file as tables, and compared with what others observed."""
