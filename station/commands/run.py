"""`station run`, `station status` and `station publish`."""

from __future__ import annotations

import json
import sys

from station.commands._options import Json, SiteArgument


def run(site: SiteArgument) -> None:
    """Run the service: catch up with the inbox, then watch it.

    Ends at SIGTERM, reads the site file again at SIGHUP.
    """
    from station.service.daemon import run as run_service

    sys.exit(run_service(site))


def status(site: SiteArgument, *, json_: Json = False) -> None:
    """Print what was done, what waits and what was set aside.

    With the reasons, and the quality of the last scan.
    """
    from station.config import read_site
    from station.monitoring.status import format_status
    from station.monitoring.status import status as read_status

    current = read_status(read_site(site))
    print(json.dumps(current, indent=2) if json_ else format_status(current))


def publish(site: SiteArgument) -> None:
    """Send what is new to the targets of [publish].

    Also runs its hook and sends its heartbeat. Run every minute by a timer, beside the service. Exits
    with 1 if a target could not be reached; it gets its files next time.
    """
    from station.config import read_site
    from station.service.publication.run import publish_once

    sys.exit(publish_once(read_site(site), print))
