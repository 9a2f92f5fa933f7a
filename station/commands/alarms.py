"""`station alarms check` and `station alarms test`."""

from __future__ import annotations

import typer

from station.commands._options import SiteArgument

app = typer.Typer(
    help="Notify people of problems; test whether they can be reached.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.command()
def check(site: SiteArgument) -> None:
    """Evaluate the rules of [alarms] and send messages.

    They say what is new, unresolved or over. Run every few minutes by a timer, beside the service. Exits
    with 1 if a target could not be reached; its message is sent again next time.
    """
    from station.config import read_site
    from station.monitoring.alarms import evaluate
    from station.monitoring.notifiers import exit_now

    exit_now(evaluate(read_site(site), report=print))


@app.command()
def test(site: SiteArgument) -> None:
    """Send a test message to every target and print which failed.

    Exits with 1 if one did.
    """
    from station.config import read_site
    from station.monitoring.alarms import test as send_test
    from station.monitoring.notifiers import exit_now

    exit_now(send_test(read_site(site), print))
