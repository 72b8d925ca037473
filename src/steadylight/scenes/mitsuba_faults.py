"""Rewrites Mitsuba's error messages: what is wrong and what would be right, without names of its source files."""

from __future__ import annotations

import difflib
import re
from pathlib import Path

_TAG = re.compile(r"\[[\w.:]+\] ")  # place in Mitsuba's source, or class name
_IN_TEXT = re.compile(r"(?:Error while loading|While loading|At) string \(line (\d+), col \d+\): ")
_UNUSED = re.compile(r'Found \d+ unreferenced propert\w+ in \w+ plugin of type "(\w+)":\s*')
_NO_PLUGIN = re.compile(r'failed to instantiate (\w+) plugin of type "([^"]*)": Plugin "[^"]*" not found!')
_DOCUMENTED = "; see Mitsuba's documentation for the available ones"
_REWRITES = (
    (re.compile(r' in property "_arg_\d+"'), ""),
    (re.compile(r'^(?:At|While loading) dictionary node "(?:root\.)?(.+?)": '), r"`\1`: "),
    (re.compile(r"^`root`: "), ""),
    (re.compile(r'failed to instantiate \w+ plugin of type "(\w+)": '), r"`\1`: "),
)


def explain_fault(error: Exception) -> str:
    """Mitsuba's error message in one or two lines.

    Args:
        error: raised by Mitsuba's parser or by a plugin.
    """
    return locate_fault(error)[1]


def locate_fault(error: Exception) -> tuple[int | None, str]:
    """The line in the parsed text, from 1, if the message gives one, and the message without it."""
    text = _TAG.sub("", str(error)).strip()
    place = _IN_TEXT.search(text)
    if place is not None:
        text = text.replace(place[0], "", 1)
    missing = _NO_PLUGIN.search(text)
    if missing:
        text = text.replace(missing[0], _no_plugin(missing[1], missing[2]))
    if _UNUSED.search(text):
        text = _UNUSED.sub(r"`\1` does not have the property ", text)
        text = text.replace("\n  - ", ", ").replace("- ", "", 1) + _DOCUMENTED
    for pattern, replacement in _REWRITES:
        text = pattern.sub(replacement, text)
    return (None if place is None else int(place[1])), text


def _no_plugin(kind: str, name: str) -> str:
    """Error message for an unknown plugin, with a suggestion."""
    import mitsuba as mi

    plugins = [file.stem for file in (Path(mi.__file__).parent / "plugins").glob("*.*")]
    near = difflib.get_close_matches(name, plugins, n=1)
    what = "plugin" if kind == "unknown" else f"{kind} plugin"
    return f"Mitsuba has no {what} `{name}`" + (f"; did you mean `{near[0]}`?" if near else _DOCUMENTED)
