"""The `ctmap` application. Its commands, in the modules beside this one, import what they need when called."""

from __future__ import annotations

from typing import Annotated

import typer

from ctmap_gtsam.cli import benches, estimators, learners, runs, tools
from ctmap_gtsam.cli.guard import GuardedGroup

app = typer.Typer(
    cls=GuardedGroup,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from ctmap_gtsam.runtime.versions import versions

        for package, version in versions().items():
            typer.echo(f"{package} {version}")
        raise typer.Exit


@app.callback()
def ctmap(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print what is installed.")
    ] = False,
) -> None:
    """What was where and when: filter and smooth recorded RGB-D runs into maps of objects, and compare the two.

    Results go to stdout and into the folder given by --out, progress goes to stderr. Exit codes: 0 done, 2 the input
    can't be used (the message names file, field and remedy), 130 stopped.
    """


app.command()(tools.demo)
app.command()(runs.inspect)
app.command()(estimators.filter)
app.command()(estimators.smooth)
app.command()(estimators.compare)
app.command()(estimators.report)
app.command()(tools.config)
app.add_typer(runs.simulate_app, name="simulate")
app.add_typer(learners.train_app, name="train")
app.add_typer(benches.bench_app, name="bench")
