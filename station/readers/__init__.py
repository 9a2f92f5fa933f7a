"""Bytes to arrays: knows formats, knows no equation."""
