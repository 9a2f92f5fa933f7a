"""Logging to stderr: one line per event, as `key=value` pairs."""

from __future__ import annotations

import json
import logging
import os
import re
import sys
import time

_UNQUOTED = re.compile(r"[^\s\"=\\\x00-\x1f\x7f-\x9f]+")
# Priority prefixes that journald understands (sd-daemon.h).
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


def logfmt(**fields: object) -> str:
    """Return `key=value` pairs on one line; values are quoted where necessary."""
    texts = ((key, str(value)) for key, value in fields.items())
    return " ".join(
        f"{key}={text if _UNQUOTED.fullmatch(text) else json.dumps(text, ensure_ascii=False)}"
        for key, text in texts
    )


class LineFormatter(logging.Formatter):
    """Formats a record on one line: with its priority for journald, otherwise with time and level."""

    converter = staticmethod(time.gmtime)

    def __init__(self, *, for_journald: bool) -> None:
        super().__init__("%(asctime)s level=%(levelname)s %(message)s", "time=%Y-%m-%dT%H:%M:%SZ")
        self._for_journald = for_journald

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as one line."""
        record.levelname = record.levelname.lower()
        line = super().format(record).replace("\r", "").replace("\n", "\\n")
        if not self._for_journald:
            return line
        message = line.split(" ", 1)[1]  # journald adds the time
        return f"<{_PRIORITY.get(record.levelno, 6)}>{message}"


def log_to_stderr() -> None:
    """Send log records to stderr; those of third-party libraries only from warnings upwards."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter(for_journald="JOURNAL_STREAM" in os.environ))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("station").setLevel(logging.INFO)
    logging.captureWarnings(capture=True)
