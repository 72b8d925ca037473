"""The command line application: its groups of commands, and the options that every command has."""

from __future__ import annotations

from typing import Annotated

import typer

from steadylight.display import out

app = typer.Typer(
    name="steadylight",
    help="Walkthrough animations with physically based global illumination, without flicker.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
cache_app = typer.Typer(help="Inspect, merge and compare cache files.", no_args_is_help=True)
app.add_typer(cache_app, name="cache")

_debug = False


def debugging() -> bool:
    """Whether `--debug` was given."""
    return _debug


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        out.print(f"steadylight {version('steadylight')}")
        raise typer.Exit


@app.callback()
def steadylight(
    *,
    version: Annotated[  # noqa: ARG001 - its callback does the work
        bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_show_version)
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Walkthrough animations with physically based global illumination, without flicker."""
    global _debug  # noqa: PLW0603 - one process is one command
    _debug = debug
