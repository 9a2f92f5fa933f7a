"""The service with a worker that measures nothing: what a test runs as a process of its own.

A stored scan is a file `<data>/stored/<name>` with its bytes. Names tell what to do: `bad` is set aside,
`slow` takes until it is stopped, `bug` trips.
"""

from __future__ import annotations

import hashlib
import sys
import time
from pathlib import Path

from station.errors import NotReadyError, StoreError
from station.service.daemon import Pace, run


class FakeWorker:
    """Keeps a line of what it was asked to do in `<data>/did`."""

    def __init__(self, site, journal, *, on_progress, should_stop, on_joined, patient):
        self.site, self.journal, self.patient = site, journal, patient
        self.on_progress, self.should_stop, self.on_joined = on_progress, should_stop, on_joined
        self.folder = site.station.data / "stored"
        self.folder.mkdir(exist_ok=True)

    def say(self, *words):
        with (self.site.station.data / "did").open("a", encoding="utf-8") as file:
            file.write(" ".join(words) + "\n")

    def recover(self):
        self.say("recover")
        self.on_progress()

    def begin_joining(self):
        self.say("join")
        if (self.site.station.data / "bug").exists():
            raise ZeroDivisionError("division by zero")

    def note_joined(self):
        pass

    def close(self):
        pass

    def sweep(self):
        self.say("sweep")

    def glance(self, arrival):
        self.say("glance", arrival.name)

    def take(self, arrival):
        self.on_progress()
        if (self.site.station.data / "full").exists():
            raise StoreError("no space left on the device")
        self.say("take", arrival.name)
        if "bug" in arrival.name:
            raise ZeroDivisionError("division by zero")
        if "bad" in arrival.name:
            self.journal.set_aside(arrival.name, "cut off")
            return False
        try:
            self.measure(arrival)
        except NotReadyError as error:
            self.journal.later(arrival.name, str(error))
            return False
        content = arrival.path.read_bytes()
        sha256 = hashlib.sha256(content).hexdigest()
        beside = self.folder / f".{arrival.name}"
        beside.write_bytes(content)
        beside.replace(self.folder / arrival.name)
        self.journal.stored(
            arrival.name,
            sha256=sha256,
            verdict="good",
            epoch=f"stored/{arrival.name}",
            start_utc_s=0.0,
            revision=1,
            figures={"points": len(content)},
        )
        return True

    def measure(self, arrival):
        until_s = time.monotonic() + (60.0 if "slow" in arrival.name else 0.002)
        while time.monotonic() < until_s:
            if self.should_stop():
                raise NotReadyError("stopped before it was done")
            self.on_progress()
            time.sleep(0.002)


if __name__ == "__main__":
    pace = Pace(period_s=float(sys.argv[2]), grace_s=float(sys.argv[3]), calm_s=0.02, first_pause_s=0.1)
    sys.exit(run(Path(sys.argv[1]), make_worker=FakeWorker, pace=pace))
