"""Copying files to another place with rclone: SSH, S3, WebDAV, a folder, and whatever else it knows."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from station.errors import ConfigError

CONFIG_NAME = "rclone.conf"  # of the credential with the remotes and their keys
LIMIT_S = 6 * 3600.0  # of one call; rclone itself gives up a connection that is silent for a minute
MARKUP = re.compile(r"<(head|style|script)\b.*?</\1>|<[^>]*>", re.DOTALL | re.IGNORECASE)
LOG_TIME = re.compile(r"^\d{4}/\d\d/\d\d \d\d:\d\d:\d\d ")
PATIENCE = (
    "--contimeout=20s",
    "--timeout=60s",
    "--retries=1",
    "--low-level-retries=2",
    "--ask-password=false",
)


@dataclass(frozen=True)
class Transfer:
    """What one call of rclone did: the files that are complete at the target, bytes sent, why it failed."""

    copied: frozenset[str]
    sent_bytes: int
    fault: str


def copy(
    source: Path,
    names: Sequence[str],
    to: str,
    *,
    oldest_first: bool,
    immutable: bool,
    bandwidth_kbit_s: float | None,
) -> Transfer:
    """Copy files of a folder, one after the other, and return what was sent.

    `names` are relative to `source`. An `immutable` file is skipped if the target has one of its name and
    size. Raises ConfigError if rclone is not installed.
    """
    if shutil.which("rclone") is None:
        raise ConfigError("publishing needs rclone, which is not installed (Debian: apt install rclone)")
    command = [
        "rclone", "copy", str(source), to, "--files-from-raw=-", "--no-traverse", "--check-first",
        f"--order-by=modtime,{'ascending' if oldest_first else 'descending'}", "--transfers=1",
        "--size-only" if immutable else "--ignore-times",
        *PATIENCE, "--use-json-log", "--verbose", "--stats=24h", *_config(),
        *([f"--bwlimit={bandwidth_kbit_s * 125:.0f}B"] if bandwidth_kbit_s else []),
    ]  # fmt: skip
    try:
        result = subprocess.run(  # noqa: S603 - no shell; `to` comes from the site file
            command, input="\n".join(names), capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Transfer(frozenset(), 0, f"no end after {LIMIT_S / 3600:.0f} h")
    except OSError as error:
        return Transfer(frozenset(), 0, f"rclone cannot be started: {error.strerror}")
    return _parse(result, names)


def _config() -> list[str]:
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    path = Path(folder or "") / CONFIG_NAME
    return [f"--config={path}"] if folder and path.is_file() else []


def _parse(result: subprocess.CompletedProcess[str], names: Sequence[str]) -> Transfer:
    """Read rclone's log: one JSON object per line, the last with its statistics."""
    copied, sent_bytes, fault = set[str](), 0, ""
    for line in result.stderr.splitlines():
        record = _record(line)
        message = str(record.get("msg", "")).strip()
        sent_bytes = int(record.get("stats", {}).get("bytes", sent_bytes))
        if message.startswith("Copied ("):
            copied.add(str(record.get("object")))
        elif record.get("level") not in {"debug", "info", "notice", "warning"} and not fault:
            fault = _plain(message)
    if result.returncode == 0:
        return Transfer(frozenset(names), sent_bytes, "")
    return Transfer(frozenset(copied), sent_bytes, fault[:300] or f"rclone: exit status {result.returncode}")


def _plain(message: str) -> str:
    """Return a message on one line: without its time, and without the markup of a page that a server sent."""
    return " ".join(MARKUP.sub(" ", LOG_TIME.sub("", message)).split())


def _record(line: str) -> dict[str, Any]:
    """Return a line of the log; rclone writes its last words as plain text."""
    try:
        record = json.loads(line)
    except ValueError:
        record = None
    return record if isinstance(record, dict) else {"level": "critical", "msg": line}
