"""Options of the command line, from `settings.Options`, and arguments that several commands take."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer

from steadylight.quality import quality_word
from steadylight.settings import PANELS, CheckedSettings, Option

SceneArgument = Annotated[
    str,
    typer.Argument(
        help="A bundled scene (see `steadylight scenes`), or a scene file: docs/scenes.md lists the formats."
    ),
]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Run directory.")]


def with_options(**groups: type[CheckedSettings]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a command take each option of the groups by name, instead of each group as one argument."""
    fields = {name: field for group in groups.values() for name, field in group.model_fields.items()}
    assert len(fields) == sum(len(group.model_fields) for group in groups.values()), "two options of one name"
    order = sorted(fields, key=lambda name: PANELS.index(_option_of(fields[name].metadata).panel))
    options = [_parameter(name, fields[name]) for name in order]

    def adapt(function: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(function, eval_str=True).parameters.values()

        @functools.wraps(function)
        def command(**given: Any) -> None:
            for name, group in groups.items():
                values = {field: given.pop(field) for field in group.model_fields}
                given[name] = group.checked(**values)
            function(**given)

        rest = [parameter for parameter in own if parameter.name not in groups]
        command.__signature__ = inspect.Signature([*rest, *options])  # type: ignore[attr-defined]
        return command

    return adapt


def _parameter(name: str, field: Any) -> inspect.Parameter:
    """An option as a parameter that typer understands."""
    option = _option_of(field.metadata)
    shown = typer.Option(
        *option.names,
        help=option.help,
        rich_help_panel=option.panel,
        metavar=option.metavar,
        show_default=True if option.shown is None else option.shown,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=_default_of(field),
        annotation=Annotated[str if option.worded else _typed_as(field.annotation), shown],
    )


def _default_of(field: Any) -> Any:
    """The default on the command line; an empty list for an option that may be repeated."""
    if isinstance(field.default, Mapping):
        return []
    return quality_word(field.default) if _option_of(field.metadata).worded else field.default


def _option_of(metadata: list[Any]) -> Option:
    return next(each for each in metadata if isinstance(each, Option))


def _typed_as(annotation: Any) -> Any:
    """The command-line type for an annotation: a number, one of several words, or else text."""
    if get_origin(annotation) is Mapping:
        return list[str]
    members = get_args(annotation) if get_origin(annotation) in {Union, UnionType} else (annotation,)
    optional = type(None) in members
    (kind, *others) = [member for member in members if member is not type(None)]
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    plain = not others and (kind in {bool, int, float, str} or get_origin(kind) is Literal)
    kind = kind if plain else str
    return kind | None if optional else kind
