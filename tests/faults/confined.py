"""Run a command with only the system calls that a systemd unit allows: `confined.py UNIT COMMAND…`."""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
from pathlib import Path

ALLOW, REFUSE = 0x7FFF0000, 0x00050000 | errno.EPERM
SET_MDWE, REFUSE_EXEC_GAIN = 65, 1


def call_groups():
    """Return the members, calls or groups, of each group of system calls known to systemd."""
    listing = subprocess.run(
        ["systemd-analyze", "syscall-filter"], capture_output=True, text=True, check=True
    )
    known = {}
    for line in listing.stdout.splitlines():
        if line.startswith("@"):
            members = known[line.strip()] = []
        elif line.startswith(" ") and not line.strip().startswith("#"):
            members.append(line.strip())
    return known


def expand(names, known):
    """Return the system calls of names and groups."""
    return {call for name in names for call in (expand(known[name], known) if name in known else {name})}


def allowed_calls(values, known):
    """Return the system calls allowed by successive lines of SystemCallFilter."""
    remaining = set()
    for value in values:
        calls = expand(value.removeprefix("~").split(), known)
        remaining = remaining - calls if value.startswith("~") else remaining | calls
    return remaining


def confine(keys):
    """Apply the restrictions of the (key, value) lines of a unit to this process, irrevocably."""
    seccomp = ctypes.CDLL("libseccomp.so.2")
    seccomp.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(seccomp.seccomp_init(REFUSE))
    for name in allowed_calls([value for key, value in keys if key == "SystemCallFilter"], call_groups()):
        call_number = seccomp.seccomp_syscall_resolve_name(name.encode())
        if call_number >= 0:
            assert seccomp.seccomp_rule_add(context, ALLOW, call_number, 0) == 0
    if ("MemoryDenyWriteExecute", "yes") in keys:
        ctypes.CDLL(None).prctl(SET_MDWE, REFUSE_EXEC_GAIN, 0, 0, 0)  # kernels before 6.3 do not know it
    assert seccomp.seccomp_load(context) == 0


if __name__ == "__main__":
    unit, *command = sys.argv[1:]
    confine([tuple(line.split("=", 1)) for line in Path(unit).read_text().splitlines() if "=" in line])
    os.execv(command[0], command)
