"""The service with a fake worker; a test runs it as a separate process.

A stored scan is a file `<data>/stored/<name>` with its bytes. The name decides: `bad` is set aside, `slow`
runs until it is stopped, `bug` raises.
"""

from __future__ import annotations

import hashlib
import sys
import time
from pathlib import Path

from station.errors import NotReadyError, StoreError
from station.service.daemon import LoopTiming, run


class FakeWorker:
    """Appends a line to `<data>/calls` for each call."""

    def __init__(
        self, site, journal, *, on_progress, should_stop, on_compacted, before_task, in_service, host
    ):
        self.site, self.journal, self.in_service, self.host = site, journal, in_service, host
        self.before_task = before_task
        self.on_progress, self.should_stop, self.on_compacted = on_progress, should_stop, on_compacted
        self.folder = site.station.data / "stored"
        self.folder.mkdir(exist_ok=True)

    def record_call(self, *fields):
        with (self.site.station.data / "calls").open("a", encoding="utf-8") as file:
            file.write(" ".join(fields) + "\n")

    def recover(self):
        self.record_call("recover")
        self.on_progress()

    def start_compaction(self):
        self.record_call("compact")
        if (self.site.station.data / "bug").exists():
            raise ZeroDivisionError("division by zero")

    def publish_compacted(self):
        pass

    def close(self):
        pass

    def proceed_with_renewals(self):
        pass

    def run_maintenance(self):
        self.record_call("maintenance")

    def precheck(self, scan):
        self.record_call("precheck", scan.name)

    def process(self, scan, *, ahead=False):
        self.on_progress()
        if (self.site.station.data / "full").exists():
            raise StoreError("no space left on the device")
        self.record_call("process", scan.name, *(["ahead"] if ahead else []))
        if "bug" in scan.name:
            raise ZeroDivisionError("division by zero")
        if "bad" in scan.name:
            self.journal.set_aside(scan.name, "cut off")
            return False
        try:
            self.measure(scan)
        except NotReadyError as error:
            self.journal.defer(scan.name, str(error))
            return False
        content = scan.path.read_bytes()
        sha256 = hashlib.sha256(content).hexdigest()
        partial = self.folder / f".{scan.name}"
        partial.write_bytes(content)
        partial.replace(self.folder / scan.name)
        self.journal.record_stored(
            scan.name,
            sha256=sha256,
            verdict="good",
            epoch=f"stored/{scan.name}",
            start_utc_s=0.0,
            revision=1,
            metrics={"points": len(content)},
        )
        return True

    def measure(self, scan):
        until_s = time.monotonic() + (60.0 if "slow" in scan.name else 0.002)
        while time.monotonic() < until_s:
            if self.should_stop():
                raise NotReadyError("stopped before it was done")
            self.on_progress()
            time.sleep(0.002)


if __name__ == "__main__":
    timing = LoopTiming(
        period_s=float(sys.argv[2]), grace_s=float(sys.argv[3]), debounce_s=0.02, first_pause_s=0.1
    )
    sys.exit(run(Path(sys.argv[1]), make_worker=FakeWorker, timing=timing))
