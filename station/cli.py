"""The table of commands. Data goes to stdout, logs and progress to stderr."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from station.commands import (
    alarms,
    calibrate,
    check,
    exports,
    papers,
    process,
    products,
    reprocess,
    run,
    sensitivity,
    simulate,
    sop,
    upgrade,
)
from station.errors import StationError

app = typer.Typer(
    name="station",
    help="Run a permanently mounted laser scanner as a measuring instrument:"
    " elevation change with an uncertainty that can be trusted.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
COMMANDS = (
    check.init, check.check, process.process, reprocess.retry, reprocess.reprocess, run.run, run.status,
    upgrade.upgrade, simulate.simulate, simulate.demo, products.areas, products.product, products.trend,
    products.events, products.plot,
    exports.export, run.publish, products.serve, products.index, calibrate.calibrate,
    sensitivity.sensitivity, calibrate.score, papers.papers,
)  # fmt: skip
for command in COMMANDS:
    app.command()(command)
app.add_typer(sop.app, name="sop")
app.add_typer(sop.import_app, name="import")
app.add_typer(alarms.app, name="alarms")


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        from station import __version__

        print(__version__)
        raise typer.Exit


def main() -> None:
    """Run a command and exit with the status that its error carries.

    0 done, 1 failed, 2 wrong usage, 3 a scan was set aside, 74 cannot write, 75 try again later, 78 bad
    configuration.
    """
    try:
        app()
    except StationError as error:
        print(f"station: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:
        sys.exit(130)
