"""Start services without paying three seconds of imports for each: fork them from a process that has them.

What runs is the service's own code, in a process of its own, with a fork server of its own. A line of JSON on
stdin ({"site", "log", "environment"}) starts one; the answer is its number. It ends with this process.
"""

from __future__ import annotations

import json
import multiprocessing.util
import os
import resource
import signal
import sys
import traceback
from multiprocessing import forkserver
from pathlib import Path

sys.path.insert(0, str(Path(__file__).with_name("hooks")))


def be_service(order):
    """Be `station run SITE` until it ends."""
    import boundaries

    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.environ.update(order["environment"])
    os.setsid()
    log = os.open(order["log"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    nothing = os.open(os.devnull, os.O_RDWR)
    for opened, at in ((nothing, 0), (nothing, 1), (log, 2)):
        os.dup2(opened, at)
    boundaries.install()
    boundaries.hurry(order["period_s"])
    if order["clock"]:
        boundaries.set_clock(order["clock"])
    start_fork_server()
    from station.cli import main

    sys.argv = ["station", "run", order["site"]]
    main()


def start_fork_server():
    """Start the server of `station.service.child` by a fork too; nothing else of it is different."""
    from station.service import child

    spawn = multiprocessing.util.spawnv_passfds
    multiprocessing.util.spawnv_passfds = fork_instead
    try:
        child.prepare()
    finally:
        multiprocessing.util.spawnv_passfds = spawn


def fork_instead(_, args, keep):
    """Start what Python's own would start as `python -c 'from multiprocessing.forkserver import main…'`."""
    command = args[-1] if isinstance(args[-1], str) else args[-1].decode()
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        for number in [int(path.name) for path in Path("/proc/self/fd").iterdir()]:
            if number > 2 and number not in keep:
                try:
                    os.close(number)
                except OSError:
                    continue
        multiprocessing.util._finalizer_registry.clear()
        forkserver._forkserver.__init__()
        exec(command, {})  # noqa: S102 - what the new interpreter would have been given
        status = 0
    finally:
        os._exit(status)


def tell_fault():
    """Write to the log why a service ended, also where no file of it may grow."""
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    traceback.print_exc()


def main():
    """Take orders until there are no more."""
    import laspy  # noqa: F401

    import station.cli
    import station.service.worker  # noqa: F401

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody here waits for them
    print("warm", flush=True)
    for line in sys.stdin:
        pid = os.fork()
        if not pid:
            status = 1
            try:
                be_service(json.loads(line))
            except SystemExit as ended:
                status = ended.code or 0
                if status:
                    tell_fault()
            except BaseException:
                tell_fault()
                raise
            finally:
                os._exit(status)
        print(pid, flush=True)


if __name__ == "__main__":
    main()
