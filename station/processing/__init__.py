"""Processing of a scan, a reference or the store, from files to files; knows no loop."""
