"""Headless Chromium, driven over two pipes by the DevTools protocol: no library, no port."""

import base64
import contextlib
import json
import os
import select
import subprocess
import time

TIMEOUT_S = 60.0


class Page:
    """One tab, with the events it has sent."""

    def __init__(self, executable, profile):
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()

        def connect_pipes():
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
            preexec_fn=connect_pipes,  # noqa: PLW1509 - two calls that take no lock
            close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(from_browser)
        self._buffer, self._message_id, self.events = b"", 0, []
        self._session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def close(self):
        os.close(self._out)  # it ends when the pipe is closed
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=10)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._in)

    def call(self, method, **arguments):
        """Return the response; events that arrive meanwhile are appended to `events`."""
        self._message_id += 1
        message = {"id": self._message_id, "method": method, "params": arguments}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            response = self._receive(deadline)
            if response.get("id") == self._message_id:
                assert "error" not in response, response["error"]
                return response["result"]

    def _receive(self, deadline):
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._in], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, "the browser does not answer"
            part = os.read(self._in, 1 << 20)
            assert part, "the browser has gone"
            self._buffer += part
        raw, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(raw)
        if "method" in message:
            self.events.append((message["method"], message["params"]))
        return message

    def open(self, url):
        first = len(self.events)
        self.call("Page.navigate", url=url)
        self.await_event("Page.loadEventFired", first)

    def await_event(self, name, first=0):
        deadline = time.monotonic() + TIMEOUT_S
        while not any(method == name for method, _ in self.events[first:]):
            self._receive(deadline)

    def run(self, script):
        """Return the value of an expression in the page."""
        response = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in response, response
        return response["result"].get("value")

    def await_(self, script):
        deadline = time.monotonic() + TIMEOUT_S
        while not (value := self.run(script)):
            assert time.monotonic() < deadline, script
            time.sleep(0.05)
        return value

    def add_startup_script(self, script):
        """Run a script in each page before its own scripts."""
        self.call("Page.addScriptToEvaluateOnNewDocument", source=script)

    def set_size(self, width, height, *, dark=False):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def tap(self, x, y):
        """Press and release the mouse at a place of the window [px]."""
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def screenshot(self, selector=None):
        """Return a screenshot of the window, or of an element in sight, as PNG."""
        clip = {}
        if selector is not None:
            box = self.run(
                f"(() => {{ const b = document.querySelector('{selector}').getBoundingClientRect();"
                " return { x: b.left + scrollX, y: b.top + scrollY, width: b.width, height: b.height }; })()"
            )
            clip = {"clip": {**box, "scale": 1}}
        return base64.b64decode(self.call("Page.captureScreenshot", **clip)["data"])

    def errors(self):
        """Errors and warnings of the console, the page and the network."""
        errors = []
        for method, params in self.events:
            if method == "Log.entryAdded" and params["entry"]["level"] in {"error", "warning"}:
                errors.append(params["entry"]["text"])
            if method == "Runtime.exceptionThrown":
                errors.append(params["exceptionDetails"]["text"])
            if method == "Runtime.consoleAPICalled" and params["type"] in {"error", "warning", "assert"}:
                errors.append(str(params["args"]))
            if method == "Network.loadingFailed" and not params.get("canceled"):
                errors.append(params["errorText"])
        return errors

    def requested_urls(self):
        """Return the URLs of all requests."""
        return [
            params["request"]["url"]
            for method, params in self.events
            if method == "Network.requestWillBeSent"
        ]
