"""Lets functions take the command-line options as keyword arguments."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Concatenate, ParamSpec, TypeVar, get_args, get_origin

from steadylight.scenes.description import SceneDescription
from steadylight.settings import Options

Scene = str | Path | SceneDescription
"""Name of a bundled scene, a scene file, or a description."""

Given = ParamSpec("Given")
Result = TypeVar("Result")


def with_options(
    _model: Callable[Given, Options],
) -> Callable[[Callable[[Scene, Options], Result]], Callable[Concatenate[Scene, Given], Result]]:
    """Let a function of a scene and `Options` take each option by name, for callers, `help` and type checkers."""
    scene = inspect.Parameter("scene", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=Scene)
    options = [
        parameter.replace(annotation=_plain(parameter.annotation))
        for parameter in inspect.signature(Options).parameters.values()
    ]

    def adapt(function: Callable[[Scene, Options], Result]) -> Callable[Concatenate[Scene, Given], Result]:
        returned = inspect.signature(function).return_annotation
        signature = inspect.Signature([scene, *options], return_annotation=returned)

        @functools.wraps(function)
        def call(*arguments: Any, **given: Any) -> Result:
            values = signature.bind(*arguments, **given).arguments
            return function(values.pop("scene"), Options.checked(**values))

        call.__signature__ = signature  # type: ignore[attr-defined]
        return call

    return adapt


def _plain(annotation: Any) -> Any:
    """A type without the metadata of its field."""
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
