"""Monitoring of a station from its journal and store: status, alarms, daily digest, metrics."""
