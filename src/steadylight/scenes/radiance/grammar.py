"""Radiance's grammar: parses text into primitives with their places, and writes primitives as text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from steadylight.errors import SceneError

VOID = "void"
MOST_ARGUMENTS = 10_000_000
"""Maximum number of arguments of a primitive: no polygon has more, and a wrong count must not exhaust memory."""

_WORD = re.compile(r"\"[^\"\n]*\"|'[^'\n]*'|\S+")


@dataclass(frozen=True)
class Primitive:
    """A surface, a material, a pattern, or an alias.

    Attributes:
        modifier: name of the modifier, or `void`.
        kind: kind of primitive, such as `polygon` or `plastic`.
        name: name of the primitive.
        words: string arguments; for an alias, what it stands for.
        numbers: numeric arguments.
        place: file and line, for messages.
    """

    modifier: str
    kind: str
    name: str
    words: tuple[str, ...] = ()
    numbers: tuple[float, ...] = ()
    place: str = field(default="", compare=False)


@dataclass(frozen=True)
class Command:
    """A line that begins with `!`: its output belongs to the scene.

    Attributes:
        line: command line, without `!`.
        place: file and line, for messages.
    """

    line: str
    place: str


def primitives_of(text: str, source: str) -> Iterator[Primitive | Command]:
    """Read a scene file.

    Args:
        text: content of the file.
        source: name of the file, for messages.

    Raises:
        SceneError: the text is not valid; the message says where.
    """
    return _Scanner(text, source).items()


def text_of(primitives: Iterable[Primitive]) -> str:
    """Primitives in Radiance's grammar."""
    lines = []
    for p in primitives:
        head = f"{_quoted(p.modifier)} {p.kind} {_quoted(p.name)}"
        words = "".join(f" {_quoted(word)}" for word in p.words)
        if p.kind == "alias":
            lines.append(head + words)
        else:
            numbers = "".join(f" {number!r}" for number in p.numbers)
            lines.append(f"{head}\n{len(p.words)}{words}\n0\n{len(p.numbers)}{numbers}\n")
    return "\n".join(lines) + "\n"


def decoded(data: bytes) -> str:
    """Text of a scene file: UTF-8, or an older encoding."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def read_text(path: Path) -> str:
    """Text of a scene file.

    Raises:
        SceneError: it cannot be read.
    """
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from None


class _Scanner:
    """Splits text into words, and counts lines."""

    def __init__(self, text: str, source: str) -> None:
        self.text, self.source = text, source
        self.words = _WORD.finditer(text)
        self.counted, self.line = 0, 1

    def items(self) -> Iterator[Primitive | Command]:
        """Everything in the text."""
        resume = 0  # where the last comment or command ended
        for match in self.words:
            if match.start() < resume:
                continue
            first = self.text[match.start()]
            if first in "#!":
                line, resume = self._line_from(match.start())
                if first == "!":
                    yield Command(line[1:].strip(), self._place(match.start()))
            else:
                yield self._primitive(_bare(match[0]), match.start())

    def _line_from(self, begin: int) -> tuple[str, int]:
        """The rest of a line, including continuation lines after a backslash, and where it ends."""
        end = begin
        while True:
            end = self.text.find("\n", end)
            if end < 0:
                return self.text[begin:].replace("\\\n", " "), len(self.text)
            if self.text[end - 1] != "\\" or self.text[begin] == "#":
                return self.text[begin:end].replace("\\\n", " "), end
            end += 1

    def _place(self, at: int) -> str:
        self.line += self.text.count("\n", self.counted, at)
        self.counted = at
        return f"{self.source}: line {self.line}"

    def _primitive(self, modifier: str, at: int) -> Primitive:
        place = self._place(at)
        what = "after its modifier, a primitive has a type and a name"
        kind, name = self._next(place, what), self._next(place, what)
        if kind == "alias":
            return Primitive(
                modifier, kind, name, (self._next(place, "an alias names what it stands for"),), (), place
            )
        place_of = f"{place}: {kind} `{name}`"
        words = tuple(
            self._next(place_of, "words are missing") for _ in range(self._count(place_of, "words"))
        )
        for _ in range(self._count(place_of, "whole numbers")):
            self._next(place_of, "whole numbers are missing")
        numbers = [self._number(place_of) for _ in range(self._count(place_of, "numbers"))]
        return Primitive(modifier, kind, name, words, tuple(numbers), place)

    def _next(self, place: str, expected: str) -> str:
        match = next(self.words, None)
        if match is None:
            raise SceneError(f"{place}: the file ends within it; {expected}")
        return _bare(match[0])

    def _count(self, place: str, what: str) -> int:
        word = self._next(place, f"the number of {what} is missing")
        if not (word.isascii() and word.isdecimal()) or int(word) > MOST_ARGUMENTS:
            raise SceneError(f"{place}: {word[:40]!r} stands where the number of its {what} is expected")
        return int(word)

    def _number(self, place: str) -> float:
        word = self._next(place, "numbers are missing")
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise SceneError(f"{place}: {word[:40]!r} stands where a number is expected")
        return number


def _bare(word: str) -> str:
    """A word without its quotes."""
    return word[1:-1] if len(word) > 1 and word[0] in "\"'" and word[-1] == word[0] else word


def _quoted(word: str) -> str:
    """A word, quoted if needed to stay one word."""
    if word and not re.search(r"\s", word) and word[0] not in "\"'":
        return word
    return f"'{word}'" if '"' in word else f'"{word}"'
