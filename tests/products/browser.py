"""Chromium without a window, driven over two pipes by its own protocol: no library, no port."""

import base64
import contextlib
import json
import os
import select
import subprocess
import time

PATIENCE_S = 60.0


class Page:
    """One tab: what it was told and what it said."""

    def __init__(self, executable, profile):
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()

        def pipes():
            os.dup2(to_browser, 13)  # out of the way of 3 and 4
            os.dup2(from_browser, 14)
            os.dup2(13, 3)
            os.dup2(14, 4)

        self._process = subprocess.Popen(
            [
                executable, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                "--no-first-run", "--disable-background-networking", "--disable-component-update",
                "--hide-scrollbars", "--remote-debugging-pipe", f"--user-data-dir={profile}", "about:blank",
            ],
            preexec_fn=pipes,  # noqa: PLW1509 - two calls that take no lock
            close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(from_browser)
        self._rest, self._number, self.events = b"", 0, []
        self._session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def close(self):
        os.close(self._out)  # it ends when nobody talks to it any more
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=10)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._in)

    def call(self, method, **arguments):
        """Return the answer; what happens meanwhile is kept in `events`."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": arguments}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + PATIENCE_S
        while True:
            told = self._hear(until)
            if told.get("id") == self._number:
                assert "error" not in told, told["error"]
                return told["result"]

    def _hear(self, until):
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(0.0, until - time.monotonic()))
            assert ready, "the browser does not answer"
            part = os.read(self._in, 1 << 20)
            assert part, "the browser has gone"
            self._rest += part
        whole, _, self._rest = self._rest.partition(b"\0")
        told = json.loads(whole)
        if "method" in told:
            self.events.append((told["method"], told["params"]))
        return told

    def open(self, url):
        seen = len(self.events)
        self.call("Page.navigate", url=url)
        self.await_event("Page.loadEventFired", seen)

    def await_event(self, name, seen=0):
        until = time.monotonic() + PATIENCE_S
        while not any(method == name for method, _ in self.events[seen:]):
            self._hear(until)

    def run(self, script):
        """Return the value of an expression in the page."""
        told = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in told, told
        return told["result"].get("value")

    def await_(self, script):
        until = time.monotonic() + PATIENCE_S
        while not (value := self.run(script)):
            assert time.monotonic() < until, script
            time.sleep(0.05)
        return value

    def before_all(self, script):
        """Run a script in each page before its own."""
        self.call("Page.addScriptToEvaluateOnNewDocument", source=script)

    def size(self, width, height, *, dark=False):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def picture(self, *, whole=False):
        """Return what is seen, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=whole)["data"])

    def complaints(self):
        """What the console, the page and the network had to say against."""
        told = []
        for method, what in self.events:
            if method == "Log.entryAdded" and what["entry"]["level"] in {"error", "warning"}:
                told.append(what["entry"]["text"])
            if method == "Runtime.exceptionThrown":
                told.append(what["exceptionDetails"]["text"])
            if method == "Runtime.consoleAPICalled" and what["type"] in {"error", "warning", "assert"}:
                told.append(str(what["args"]))
            if method == "Network.loadingFailed" and not what.get("canceled"):
                told.append(what["errorText"])
        return told

    def asked(self):
        """Return the addresses that were asked for."""
        return [
            what["request"]["url"] for method, what in self.events if method == "Network.requestWillBeSent"
        ]
