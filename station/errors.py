"""The errors of the program, and the response of the service to each.

Any other exception is a bug: the process ends, systemd restarts it, nothing is lost.
"""

from __future__ import annotations


class StationError(Exception):
    """An error with a defined response; `exit_status` is the exit status of a command that raises it."""

    exit_status = 1


class ConfigError(StationError):
    """The site file cannot be used: the service does not start, or keeps the previous one on reload."""

    exit_status = 78


class ScanError(StationError):
    """The scan cannot be used: it is set aside with the reason until it or the settings change."""

    exit_status = 3


class NotReadyError(StationError):
    """The scan, its log or the disk is not ready: the scan is tried again later, without limit."""

    exit_status = 75


class InconclusiveError(NotReadyError):
    """An attempt failed, by scan or machine: it is repeated ever more rarely, then given up for now."""


class StoreError(StationError):
    """The store cannot be written: no scan is processed until it can."""

    exit_status = 74
