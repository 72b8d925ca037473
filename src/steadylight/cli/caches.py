"""Commands `cache info`, `cache merge` and `cache diff`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from steadylight.cli.application import cache_app
from steadylight.display import out, show_table
from steadylight.errors import CacheFileError


@cache_app.command()
def info(files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Cache files.")]) -> None:
    """Show the contents of cache files."""
    from steadylight.renderers import renderer_of

    for path in files:
        renderer, cache_files = renderer_of(path)
        show_table(str(path), {"renderer": renderer.name, **cache_files.describe(path)})


@cache_app.command()
def merge(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Cache files of one scene.")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The merged cache.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite the output if it exists.")] = False,
) -> None:
    """Merge caches of one scene into one, without duplicates."""
    from steadylight.atomic_file import atomic_write
    from steadylight.renderers import renderer_of

    if output.exists() and not force:
        raise CacheFileError(
            f"{output}: exists already; choose another --output, or overwrite it with --force"
        )
    _, cache_files = renderer_of(_of_one_renderer(*files))
    with atomic_write(output, cache_files.describe) as temporary:
        counts = cache_files.merge(files, temporary)
    words = f"{counts['records_out']:,} records, merged from {counts['records_in']:,}"
    out.print(f"{output}: {words}", soft_wrap=True)


@cache_app.command()
def diff(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A cache file.")],
    other: Annotated[Path, typer.Argument(metavar="FILE", help="A second cache file.")],
) -> None:
    """Compare two caches. Exit code 0 if they hold the same records of the same scene, otherwise 1."""
    from steadylight.renderers import renderer_of

    _, cache_files = renderer_of(_of_one_renderer(file, other))
    same, differences = cache_files.differences(file, other)
    show_table("same records" if same else "caches differ", differences)
    raise typer.Exit(0 if same else 1)


def _of_one_renderer(first: Path, *others: Path) -> Path:
    """The first of several cache files, after checking that all belong to one renderer."""
    for path in others:
        if path.suffix != first.suffix:
            raise CacheFileError(
                f"{path}: belongs to a different renderer than {first}; give files of one renderer"
            )
    return first
