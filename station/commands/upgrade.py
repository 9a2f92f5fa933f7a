"""`station upgrade`."""

from __future__ import annotations

from typing import Annotated

import typer

from station.commands._options import SiteArgument


def upgrade(
    site: SiteArgument,
    *,
    back: Annotated[
        bool, typer.Option("--back", help="Restore the store as it was before the last upgrade.")
    ] = False,
) -> None:
    """Bring the store to this version of the program, or back.

    Stop the service before. The store as it was is kept beside it in hard links, which take no space until
    files are replaced.
    """
    from station.config import read_site
    from station.operations import store_upgrade

    run = store_upgrade.take_back if back else store_upgrade.upgrade
    run(read_site(site), print)
