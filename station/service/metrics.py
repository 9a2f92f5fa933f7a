"""Figures for Prometheus: on loopback, and as a file for node_exporter's textfile collector."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from station.config import Site
from station.errors import ConfigError, StationError
from station.service.alarm_memory import firing
from station.service.journal import Journal
from station.service.logs import logfmt

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry
    from prometheus_client.core import GaugeMetricFamily

log = logging.getLogger("station")

# What a journal's row tells of the newest scan.
OF_SCAN = {
    "seconds": ("station_scan_duration_seconds", "How long the newest scan took."),
    "sigma_median_m": ("station_sigma_median_metres", "Median of the uncertainty of the newest scan."),
    "stable_z_std": ("station_stable_z_std", "Scatter of withheld stable ground over its sigma; 1 is right."),
    "stable_nmad": ("station_stable_nmad_metres", "Scatter of withheld stable ground."),
    "roll_deg": ("station_roll_degrees", "Mean roll of the scanner in the newest scan."),
    "pitch_deg": ("station_pitch_degrees", "Mean pitch of the scanner in the newest scan."),
}


class Metrics:
    """What is measured is read when it is asked for, from the journal, beside the service's own work."""

    def __init__(self, site: Callable[[], Site]) -> None:
        self._site = site
        self._has_failed = False

    @contextmanager
    def serving(self) -> Iterator[None]:
        """Answer at `service.metrics`, if it is set; raise ConfigError where that cannot be."""
        address = self._site().service.metrics
        if address is None:
            yield
            return
        registry = self._registry()
        from prometheus_client import start_http_server  # noqa: PLC0415 - an extra

        host, _, port = address.rpartition(":")
        try:
            server, thread = start_http_server(int(port), host.strip("[]"), registry)
        except OSError as error:
            raise ConfigError(f"service.metrics = {address!r}: cannot be had: {error.strerror}") from error
        try:
            yield
        finally:
            server.shutdown()
            server.server_close()
            thread.join()

    def write(self) -> None:
        """Put the figures into `service.metrics_file`, if it is set; say once where that cannot be."""
        path = self._site().service.metrics_file
        if path is None:
            return
        try:
            registry = self._registry()
            from prometheus_client import write_to_textfile  # noqa: PLC0415 - an extra

            write_to_textfile(str(path), registry)
        except (OSError, ConfigError) as error:  # no reason to measure nothing
            if not self._has_failed:
                log.warning(logfmt(metrics_file=path, reason=error))
            self._has_failed = True
        else:
            self._has_failed = False

    def collect(self) -> Iterable[GaugeMetricFamily]:
        """Give all figures as they are now; prometheus_client calls it."""
        from prometheus_client.core import GaugeMetricFamily as Gauge  # noqa: PLC0415 - an extra

        site = self._site()
        data = site.station.data
        try:
            with Journal(data / "journal.sqlite", read_only=True) as journal:
                counts, verdicts, last = journal.counts(), journal.verdicts(), journal.newest(1)
        except StationError:
            counts, verdicts, last = {}, {}, []
        scans = Gauge("station_scans", "Scans by what became of them.", labels=["state"])
        for state, count in counts.items():
            scans.add_metric([state], count)
        epochs = Gauge("station_epochs", "Epochs in the series by their verdict.", labels=["verdict"])
        for verdict, count in verdicts.items():
            epochs.add_metric([verdict], count)
        yield from (scans, epochs)
        for row in last:
            times = {"station_last_scan": row.start_utc_s or 0.0, "station_last_stored": row.changed_utc_s}
            for name, time_s in times.items():
                yield Gauge(f"{name}_timestamp_seconds", "When the newest scan began or was stored.", time_s)
            for figure, (name, words) in OF_SCAN.items():
                if (value := row.figures.get(figure)) is not None:
                    yield Gauge(name, words, float(value))
        yield Gauge("station_disk_free_bytes", "Room where the data folder is.", shutil.disk_usage(data).free)
        alarms = Gauge("station_alarm_firing", "Alarms that were told and last.", labels=["alarm"])
        for key in firing(data):
            alarms.add_metric([key], 1)
        yield alarms

    def _registry(self) -> CollectorRegistry:
        try:
            from prometheus_client import CollectorRegistry  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise ConfigError("service.metrics needs: pip install 'tls-station[metrics]'") from error
        registry = CollectorRegistry()
        registry.register(self)
        return registry
