"""What can go wrong, and what the service does about it.

Anything that is none of these is a bug: the process ends, systemd starts it anew, nothing is lost.
"""

from __future__ import annotations


class StationError(Exception):
    """A fault with a known answer; `exit_status` is what a command returns for it."""

    exit_status = 1


class ConfigError(StationError):
    """The site file cannot be used: the service refuses to start, or keeps the old one on reload."""

    exit_status = 78


class ScanError(StationError):
    """This scan cannot be used: it is set aside with the reason and not tried again until it changes."""

    exit_status = 3


class NotReadyError(StationError):
    """Not now: the scan, its log or the disk is not ready; tried again later, never given up."""

    exit_status = 75


class StoreError(StationError):
    """The store cannot be written: no more scans are taken until it can."""

    exit_status = 74
