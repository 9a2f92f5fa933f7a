"""Metrics for Prometheus: served on loopback, and as a file for node_exporter's textfile collector."""

from __future__ import annotations

import logging
import shutil
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from station.config import Site
from station.errors import ConfigError, StationError
from station.inbox.journal_reader import JournalReader
from station.logs import logfmt
from station.monitoring.alarm_state import active

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry
    from prometheus_client.core import GaugeMetricFamily

log = logging.getLogger("station")

# Metrics of the newest scan, from its journal entry.
SCAN_METRICS = {
    "seconds": ("station_scan_duration_seconds", "Processing time of the newest scan."),
    "sigma_median_m": ("station_sigma_median_metres", "Median uncertainty of the newest scan."),
    "stable_z_std": ("station_stable_z_std", "Scatter of hold-out stable ground over its sigma; ideally 1."),
    "stable_nmad": ("station_stable_nmad_metres", "Scatter (NMAD) of hold-out stable ground."),
    "roll_deg": ("station_roll_degrees", "Mean roll of the scanner in the newest scan."),
    "pitch_deg": ("station_pitch_degrees", "Mean pitch of the scanner in the newest scan."),
}
THREADS = 2  # that answer requests: one for Prometheus, one for a person
MAX_CONNECTIONS = 16  # answered or waiting; further ones are closed at once
CONNECTION_TIMEOUT_S = 3.0  # for which a client may be silent


class _Server(WSGIServer):
    """Web server with a limited number of threads and connections, however many clients connect."""

    request_queue_size = 128

    def __init__(self, address: tuple[str, int], app: Any) -> None:  # noqa: ANN401 - of prometheus_client
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._threads = ThreadPoolExecutor(THREADS, "metrics")
        self._free_connections = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__(address, _RequestHandler)
        self.set_app(app)

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401 - of the base class
        if not self._free_connections.acquire(blocking=False):
            self.shutdown_request(request)
            return
        self._threads.submit(self._answer, request, client_address)

    def _answer(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        try:
            self.finish_request(request, client_address)
        except OSError:  # the client has gone, or was silent for too long
            return
        finally:
            self.shutdown_request(request)
            self._free_connections.release()

    def server_close(self) -> None:
        super().server_close()
        self._threads.shutdown(cancel_futures=True)


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _only_for_loopback(app: Any) -> Any:  # noqa: ANN401 - WSGI
    """Return a WSGI app that refuses requests to other host names: a web page may point one at loopback."""

    def answer(environ: dict[str, Any], start_response: Any) -> Any:  # noqa: ANN401
        host = urlsplit(f"//{environ.get('HTTP_HOST', '')}").hostname or ""
        if _is_loopback(host):
            return app(environ, start_response)
        start_response("403 Forbidden", [("Content-Type", "text/plain")])
        return [b"only for this machine\n"]

    return answer


class _RequestHandler(WSGIRequestHandler):
    timeout = CONNECTION_TIMEOUT_S

    def log_message(self, *_: object) -> None:
        """Log no requests."""


class Metrics:
    """Collects metrics from the journal on request, in parallel with the service."""

    def __init__(self, site: Callable[[], Site]) -> None:
        self._site = site
        self._has_failed = False

    @contextmanager
    def serving(self) -> Iterator[None]:
        """Serve metrics at `service.metrics`, if set; raise ConfigError if that is impossible."""
        address = self._site().service.metrics
        if address is None:
            yield
            return
        registry = self._registry()
        from prometheus_client import make_wsgi_app  # noqa: PLC0415 - an extra

        host, _, port = address.rpartition(":")
        try:
            server = _Server((host.strip("[]"), int(port)), _only_for_loopback(make_wsgi_app(registry)))
        except OSError as error:
            raise ConfigError(f"service.metrics = {address!r}: cannot listen: {error.strerror}") from error
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            server.server_close()
            thread.join()

    def write(self) -> None:
        """Write the metrics to `service.metrics_file`, if set; log the first of consecutive failures."""
        path = self._site().service.metrics_file
        if path is None:
            return
        try:
            registry = self._registry()
            from prometheus_client import write_to_textfile  # noqa: PLC0415 - an extra

            write_to_textfile(str(path), registry)
        except (OSError, ConfigError) as error:  # no reason to stop processing scans
            if not self._has_failed:
                log.warning(logfmt(metrics_file=path, reason=error))
            self._has_failed = True
        else:
            self._has_failed = False

    def collect(self) -> Iterable[GaugeMetricFamily]:
        """Yield all current metrics; called by prometheus_client."""
        from prometheus_client.core import GaugeMetricFamily as Gauge  # noqa: PLC0415 - an extra

        site = self._site()
        data = site.station.data
        try:
            with JournalReader(data / "journal.sqlite") as journal:
                counts, verdicts, last = journal.counts(), journal.verdicts(), journal.newest(1)
        except StationError:
            counts, verdicts, last = {}, {}, []
        scans = Gauge("station_scans", "Scans by state.", labels=["state"])
        for state, count in counts.items():
            scans.add_metric([state], count)
        epochs = Gauge("station_epochs", "Epochs in the series by verdict.", labels=["verdict"])
        for verdict, count in verdicts.items():
            epochs.add_metric([verdict], count)
        yield from (scans, epochs)
        for entry in last:
            times = {
                "station_last_scan": entry.start_utc_s or 0.0,
                "station_last_stored": entry.changed_utc_s,
            }
            for name, time_s in times.items():
                yield Gauge(f"{name}_timestamp_seconds", "When the newest scan began or was stored.", time_s)
            for metric, (name, description) in SCAN_METRICS.items():
                if (value := entry.metrics.get(metric)) is not None:
                    yield Gauge(name, description, float(value))
        yield Gauge(
            "station_disk_free_bytes",
            "Free space on the file system of the data folder.",
            shutil.disk_usage(data).free,
        )
        alarms = Gauge("station_alarm_firing", "Active alarms that were sent.", labels=["alarm"])
        for key in active(data):
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
