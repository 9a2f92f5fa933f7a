"""Start services without three seconds of imports each: fork them from a process that has imported all.

Each service runs its own code in a separate process with a separate fork server. A line of JSON on stdin
({"site", "log", "environment"}) starts one; the answer is its process id.
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


def run_service(order):
    """Run `station run SITE` until it ends."""
    import boundaries

    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.environ.update(order["environment"])
    os.setsid()
    log = os.open(order["log"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    nothing = os.open(os.devnull, os.O_RDWR)
    for opened, target in ((nothing, 0), (nothing, 1), (log, 2)):
        os.dup2(opened, target)
    boundaries.install()
    boundaries.shorten_delays(order["period_s"])
    if order["clock"]:
        boundaries.set_clock(order["clock"])
    start_fork_server()
    from station.cli import main

    sys.argv = ["station", "run", order["site"]]
    main()


def start_fork_server():
    """Start the fork server of `station.processing.workers.fork_server`, itself by a fork."""
    from station.processing.workers.fork_server import ensure_running

    spawn = multiprocessing.util.spawnv_passfds
    multiprocessing.util.spawnv_passfds = fork_server
    try:
        ensure_running()
    finally:
        multiprocessing.util.spawnv_passfds = spawn


def fork_server(_, args, keep):
    """Fork what Python starts as `python -c 'from multiprocessing.forkserver import main…'`."""
    command = args[-1] if isinstance(args[-1], str) else args[-1].decode()
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        for descriptor in [int(path.name) for path in Path("/proc/self/fd").iterdir()]:
            if descriptor > 2 and descriptor not in keep:
                try:
                    os.close(descriptor)
                except OSError:
                    continue
        multiprocessing.util._finalizer_registry.clear()
        forkserver._forkserver.__init__()
        exec(command, {})  # noqa: S102 - the command of the new interpreter
        status = 0
    finally:
        os._exit(status)


def log_fault():
    """Write to the log why a service ended, also under a limit of the file size."""
    _, hard_limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard_limit, hard_limit))
    traceback.print_exc()


def main():
    """Start services until stdin ends."""
    import laspy  # noqa: F401

    import station.cli
    import station.service.worker  # noqa: F401

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # no child is waited for
    print("warm", flush=True)
    for line in sys.stdin:
        pid = os.fork()
        if not pid:
            status = 1
            try:
                run_service(json.loads(line))
            except SystemExit as ended:
                status = ended.code or 0
                if status:
                    log_fault()
            except BaseException:
                log_fault()
                raise
            finally:
                os._exit(status)
        print(pid, flush=True)


if __name__ == "__main__":
    main()
