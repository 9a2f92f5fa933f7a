"""Log lines: one a thing, `key=value` words, to stderr."""

from __future__ import annotations

import json
import logging
import os
import re
import sys
import time

_BARE = re.compile(r"[^\s\"=\\\x00-\x1f\x7f-\x9f]+")
# What journald takes a line's priority from (sd-daemon.h).
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


def logfmt(**words: object) -> str:
    """Return `key=value` words on one line, quoted where a value needs it."""
    texts = ((key, str(value)) for key, value in words.items())
    return " ".join(
        f"{key}={text if _BARE.fullmatch(text) else json.dumps(text, ensure_ascii=False)}"
        for key, text in texts
    )


class OneLine(logging.Formatter):
    """A record on one line: with its priority for journald, else with the time and the level."""

    converter = staticmethod(time.gmtime)

    def __init__(self, *, for_journald: bool) -> None:
        super().__init__("%(asctime)s level=%(levelname)s %(message)s", "time=%Y-%m-%dT%H:%M:%SZ")
        self._for_journald = for_journald

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        record.levelname = record.levelname.lower()
        line = super().format(record).replace("\r", "").replace("\n", "\\n")
        if not self._for_journald:
            return line
        message = line.split(" ", 1)[1]  # journald knows the time
        return f"<{_PRIORITY.get(record.levelno, 6)}>{message}"


def log_to_stderr() -> None:
    """Send log records to stderr; other people's libraries only from a warning on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(OneLine(for_journald="JOURNAL_STREAM" in os.environ))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("station").setLevel(logging.INFO)
    logging.captureWarnings(capture=True)
