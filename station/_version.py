"""The version of the program, which is part of the provenance of each epoch."""

__version__ = "0.1.0"
