"""Become a command with no more system calls than a systemd unit leaves it: `confined.py UNIT COMMAND…`."""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
from pathlib import Path

ALLOW, REFUSE = 0x7FFF0000, 0x00050000 | errno.EPERM
SET_MDWE, REFUSE_EXEC_GAIN = 65, 1


def groups():
    """Return the groups of system calls that systemd knows: their members, which may be groups."""
    told = subprocess.run(["systemd-analyze", "syscall-filter"], capture_output=True, text=True, check=True)
    known = {}
    for line in told.stdout.splitlines():
        if line.startswith("@"):
            members = known[line.strip()] = []
        elif line.startswith(" ") and not line.strip().startswith("#"):
            members.append(line.strip())
    return known


def named(names, known):
    """Return the system calls of some names and groups."""
    return {one for name in names for one in (named(known[name], known) if name in known else {name})}


def allowed(values, known):
    """Return the system calls that lines of SystemCallFilter leave, one after the other."""
    left = set()
    for value in values:
        some = named(value.removeprefix("~").split(), known)
        left = left - some if value.startswith("~") else left | some
    return left


def confine(keys):
    """Give up, for good, what the (key, value) lines of a unit refuse."""
    seccomp = ctypes.CDLL("libseccomp.so.2")
    seccomp.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(seccomp.seccomp_init(REFUSE))
    for name in allowed([value for key, value in keys if key == "SystemCallFilter"], groups()):
        number = seccomp.seccomp_syscall_resolve_name(name.encode())
        if number >= 0:
            assert seccomp.seccomp_rule_add(context, ALLOW, number, 0) == 0
    if ("MemoryDenyWriteExecute", "yes") in keys:
        ctypes.CDLL(None).prctl(SET_MDWE, REFUSE_EXEC_GAIN, 0, 0, 0)  # kernels before 6.3 do not know it
    assert seccomp.seccomp_load(context) == 0


if __name__ == "__main__":
    unit, *command = sys.argv[1:]
    confine([tuple(line.split("=", 1)) for line in Path(unit).read_text().splitlines() if "=" in line])
    os.execv(command[0], command)
