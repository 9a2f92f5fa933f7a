"""Headless Firefox, driven over a socket by its Marionette protocol: no library, no second program."""

import base64
import json
import os
import socket
import subprocess
import time

TIMEOUT_S = 60.0
PREFERENCES = {
    "marionette.port": 0,  # any that is free
    "datareporting.policy.dataSubmissionEnabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
}


class Page:
    """One window."""

    def __init__(self, executable, profile):
        profile.mkdir(parents=True)
        lines = [
            f"user_pref({json.dumps(name)}, {json.dumps(value)});" for name, value in PREFERENCES.items()
        ]
        (profile / "user.js").write_text("\n".join(lines))
        self._process = subprocess.Popen(
            [executable, "--headless", "--marionette", "--no-remote", "--profile", profile],
            env=os.environ | {"HOME": str(profile)}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self._deadline = time.monotonic() + TIMEOUT_S
        port = profile / "MarionetteActivePort"
        while not (port.is_file() and port.read_text()):
            self._wait("Firefox does not start")
        self._socket = socket.create_connection(("127.0.0.1", int(port.read_text())), TIMEOUT_S)
        self._message_id, self._buffer = 0, b""
        self._receive()  # its greeting
        self.call("WebDriver:NewSession")

    def close(self):
        self.call("Marionette:Quit", flags=["eForceQuit"])
        self._socket.close()
        self._process.wait(timeout=TIMEOUT_S)

    def call(self, command, **arguments):
        """Return the value of a response."""
        self._message_id += 1
        message = json.dumps([0, self._message_id, command, arguments])
        self._socket.sendall(f"{len(message)}:{message}".encode())
        _, _, error, result = self._receive()
        assert error is None, error
        return result.get("value") if isinstance(result, dict) else result

    def _receive(self):
        while b":" not in self._buffer:
            self._read()
        size, _, self._buffer = self._buffer.partition(b":")
        while len(self._buffer) < int(size):
            self._read()
        message, self._buffer = self._buffer[: int(size)], self._buffer[int(size) :]
        return json.loads(message)

    def _read(self):
        part = self._socket.recv(1 << 20)
        assert part, "Firefox has gone"
        self._buffer += part

    def _wait(self, what):
        assert time.monotonic() < self._deadline, what
        time.sleep(0.05)

    def open(self, url):
        self.call("WebDriver:Navigate", url=url)

    def run(self, expression):
        """Return the value of an expression, which sees the document but not the variables of the page."""
        return self.call("WebDriver:ExecuteScript", script=f"return {expression};", args=[])

    def await_(self, expression):
        self._deadline = time.monotonic() + TIMEOUT_S
        while not (value := self.run(expression)):
            self._wait(expression)
        return value

    def set_size(self, width, height):
        self.call("WebDriver:SetWindowRect", width=width, height=height)

    def tap(self, x, y):
        """Press and release the mouse at a place of the window [px]."""
        move = {"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)}
        press, release = ({"type": kind, "button": 0} for kind in ("pointerDown", "pointerUp"))
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}}
        self.call("WebDriver:PerformActions", actions=[mouse | {"actions": [move, press, release]}])

    def screenshot(self, selector=None):
        """Return a screenshot of the window, or of an element, as PNG."""
        element = {}
        if selector is not None:
            found = self.call("WebDriver:FindElement", using="css selector", value=selector)
            element = {"id": next(iter(found.values()))}
        return base64.b64decode(self.call("WebDriver:TakeScreenshot", full=False, **element))
