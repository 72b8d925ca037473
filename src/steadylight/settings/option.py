"""One option: how it is shown on the command line, and how a wrong value is reported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from steadylight.errors import SettingsError

SCENE, ANIMATION, IMAGE, DISPLAY = "Scene", "Animation", "Image", "Video and pictures"
METHOD, MACHINE, SIMULATION, WALK = "Method", "Machine", "Simulation", "Walk"
PANELS: Final = (WALK, SCENE, ANIMATION, IMAGE, DISPLAY, METHOD, MACHINE, SIMULATION)
"""How `--help` groups the options."""


@dataclass(frozen=True)
class Option:
    """How an option is shown on the command line, where a field `some_name` is `--some-name`.

    Attributes:
        help: help text, a sentence.
        panel: one of PANELS.
        metavar: placeholder for the value; that of the type if None.
        shown: text to show instead of the default, where the default is None or uninformative.
        worded: whether a word may be given instead of a number.
        names: names as typed, instead of that of the field.
    """

    help: str
    panel: str
    metavar: str | None = None
    shown: str | None = None
    worded: bool = False
    names: tuple[str, ...] = ()


class CheckedSettings(BaseModel):
    """Settings whose validation errors use the option names of the command line."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def checked(cls, **values: Any) -> Self:
        """Make settings; an invalid value raises a SettingsError with the option, the value and what is expected."""
        try:
            return cls(**values)
        except ValidationError as error:
            raise SettingsError(_explain(error)) from None

    def values_of(self, settings: type[BaseModel]) -> dict[str, Any]:
        """Values of the options that `settings` shares with this class."""
        return {name: getattr(self, name) for name in settings.model_fields}


def _explain(error: ValidationError) -> str:
    """Pydantic's errors, one line each, with the option names of the command line."""
    lines = []
    for finding in error.errors():
        option = option_name(str(finding["loc"][0])) if finding["loc"] else "settings"
        lines.append(f"{option}: {finding['input']!r} is not valid; {_reason(finding['msg'])}")
    return "\n".join(lines)


def _reason(message: str) -> str:
    reason = message.removeprefix("Value error, ")
    return reason[:1].lower() + reason[1:]


def option_name(setting: str) -> str:
    """The command-line option that sets a setting."""
    if setting == "parameters":
        return "-D"
    return "--size" if setting in {"width", "height"} else "--" + setting.replace("_", "-")
