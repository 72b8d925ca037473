"""Commands in scene files (`!genbox ...`): Radiance's own programs by name, without a shell.

A scene file may come from anyone. Only the programs in `PROGRAMS` are therefore started, from pyradiance; no shell ever
sees a line; files are read from the scene's folder only; and time, memory and output are limited. `xform` and `cat`
would run the commands inside the files that they read. Here, those files are expanded like any other, and `xform` gets
the result.
"""

from __future__ import annotations

import resource
import shlex
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

from steadylight.errors import BackendError, SceneError
from steadylight.scenes.radiance.grammar import Command, Primitive, decoded, primitives_of, read_text, text_of
from steadylight.scenes.radiance.programs import command, environment

PROGRAMS = (
    "xform",
    "cat",
    "gensky",
    "gendaylit",
    "genbox",
    "genrev",
    "genworm",
    "gensurf",
    "genprism",
    "genblinds",
    "genclock",
    "replmarks",
    "obj2rad",
    "tmesh2rad",
    "cnt",
    "rcalc",
)
"""Programs that a scene file may start."""

MOST_SECONDS = 60
MOST_BYTES = 256 << 20
MOST_MEMORY = 4 << 30
DEEPEST = 32
"""Limits: seconds, output and memory of one program, and nesting depth of files and commands."""

MOST_PRIMITIVES, MOST_COMMANDS = 5_000_000, 100_000
"""Limits of a scene: primitives including those from commands, which take 4 GB, and number of commands."""

_XFORM = {"-t": 3, "-rx": 1, "-ry": 1, "-rz": 1, "-s": 1, "-mx": 0, "-my": 0, "-mz": 0, "-i": 1, "-a": 1}
_XFORM_ONCE = {"-n": 1, "-m": 1, "-I": 0, "-c": 0, "-e": 0}
_SHELL = set("|;&<>()`")


@dataclass
class Expansion:
    """Reads files, and runs all commands in them.

    Attributes:
        folder: folder of the scene.
        files: every file that was read.
        anywhere: whether files outside the folder may be read.
        count: number of primitives so far.
        commands: number of commands run so far.
    """

    folder: Path
    files: list[Path]
    anywhere: bool = False
    count: int = 0
    commands: int = 0

    @classmethod
    def of(cls, path: Path, *, anywhere: bool = False) -> Expansion:
        """For a scene file that may refer to files in its folder, or anywhere."""
        return cls(path.parent.resolve(), [], anywhere)

    def file(self, path: Path, depth: int = 0) -> list[Primitive]:
        """Primitives of a file."""
        self.files.append(path)
        return self.text(read_text(path), str(path), depth)

    def text(self, text: str, source: str, depth: int = 0) -> list[Primitive]:
        """Primitives of a text.

        Raises:
            SceneError: the text is not valid, or a command is refused or fails.
            BackendError: pyradiance is not installed.
        """
        if depth > DEEPEST:
            raise SceneError(
                f"{source}: files and commands are nested more than {DEEPEST} deep; does it include itself?"
            )
        found: list[Primitive] = []
        for item in primitives_of(text, source):
            if isinstance(item, Command):
                found += self._output(item, depth)
            else:
                self.counted([item], source)
                found.append(item)
        return found

    def counted(self, primitives: Sequence[Primitive], source: str) -> None:
        """Count and check primitives that were read.

        Raises:
            SceneError: there are too many of them, or they name files that may not be read.
        """
        self.count += len(primitives)
        if self.count > MOST_PRIMITIVES:
            raise SceneError(
                f"{source}: more than {MOST_PRIMITIVES:,} primitives, counting those from commands"
            )
        for primitive in primitives:
            if primitive.kind != "alias":
                for word in primitive.words:
                    self.check_named(word, primitive.place)

    def _output(self, given: Command, depth: int) -> list[Primitive]:
        """Primitives in the output of a command line."""
        self.commands += 1
        if self.commands > MOST_COMMANDS:
            raise SceneError(f"{given.place}: more than {MOST_COMMANDS:,} commands")
        text, source = "", given.place
        for number, words in enumerate(_stages(given)):
            source = f"{given.place}: `{words[0]}`"
            program, arguments = words[0], words[1:]
            if program == "cat":
                text = text_of(self._files(arguments, source, depth))
                continue
            if program == "xform":
                arguments, files = _divided(arguments, source)
                if files:
                    text = text_of(self._files(files, source, depth))
                elif number == 0:
                    raise SceneError(f"{source} has no file to transform")
                else:
                    text = text_of(self.text(text, source, depth + 1))
            for word in arguments:
                self._check(word, source)
            text = self._run(program, arguments, text, source)
        return self.text(text, source, depth + 1)

    def named(self, name: str, source: str, depth: int) -> list[Primitive]:
        """Primitives of a file, given its name in the scene."""
        return self.file(self.found(name, source), depth)

    def found(self, name: str, source: str, *, missing: bool = False) -> Path:
        """Path of a file that may be read, given its name in the scene; with `missing`, it need not exist."""
        self._check(name, source)
        path = self.folder / name
        if not missing and not path.is_file():
            raise SceneError(f"{source}: {name}: no such file in {self.folder}")
        return path

    def moved(self, primitives: list[Primitive], arguments: Sequence[str], source: str) -> list[Primitive]:
        """Primitives transformed by the arguments of `xform`."""
        options, files = _divided(list(arguments), source)
        if files:
            raise SceneError(f"{source}: {files[0]!r} appears where options of xform are expected")
        if not options:
            return primitives
        return self.text(self._run("xform", options, text_of(primitives), source), source, 1)

    def _files(self, names: list[str], source: str, depth: int) -> list[Primitive]:
        found: list[Primitive] = []
        for name in names:
            found += self.named(name, source, depth + 1)
        return found

    def _check(self, word: str, source: str) -> None:
        """Refuse arguments that would start a command, and files outside the scene's folder."""
        if word.startswith("!"):
            raise SceneError(f"{source}: {word!r}: nested commands are not run; write their output to a file")
        found = place_of(word, self.folder)
        if found is None or found.is_relative_to(self.folder):
            return
        if found.exists() or word.startswith(("/", "..", "~")):
            self._refuse(word, source)

    def check_named(self, word: str, source: str) -> None:
        """Refuse a word of a primitive that names a file outside the scene's folder: a picture, data, or an octree.

        A word that Radiance does not find as a file is a formula, or a text to show.
        """
        found = file_of(word, self.folder)
        if found is not None and not found.is_relative_to(self.folder):
            self._refuse(word, source)

    def _refuse(self, word: str, source: str) -> None:
        if not self.anywhere:
            raise SceneError(
                f"{source}: {word} lies outside {self.folder}; put the scene file in a folder above all that it uses, "
                "copy the file there, or give --allow-outside"
            )

    def _run(self, program: str, arguments: list[str], given: str, source: str) -> str:
        """Standard output of one program."""
        call = command(program, *arguments)
        with TemporaryFile() as output, TemporaryFile() as errors:
            try:
                process = subprocess.Popen(  # noqa: S603 - a program of an installed package, named above
                    call,
                    cwd=self.folder,
                    env=environment(self.folder, alone=True),
                    stdin=subprocess.PIPE,
                    stdout=output,
                    stderr=errors,
                )
            except (OSError, ValueError) as error:
                raise BackendError(f"{call[0]}: cannot be started ({error}); reinstall pyradiance") from error
            _limit(process.pid)
            try:
                process.communicate(given.encode(), timeout=MOST_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                raise SceneError(f"{source}: took more than {MOST_SECONDS} s") from None
            errors.seek(0)
            said = errors.read(2000).decode(errors="replace").strip()
            if output.tell() >= MOST_BYTES or output.seek(0, 2) >= MOST_BYTES:
                raise SceneError(f"{source}: wrote more than {MOST_BYTES >> 20} MiB")
            if process.returncode:
                raise SceneError(f"{source} failed: {said or f'exit code {process.returncode}'}")
            output.seek(0)
            return decoded(output.read())


def place_of(word: str, folder: Path) -> Path | None:
    """Path at which Radiance's programs look for a file name, links resolved; None if the name cannot be a file."""
    try:
        return (folder / Path(word).expanduser()).resolve()
    except (OSError, ValueError, RuntimeError):
        return None


def file_of(word: str, folder: Path) -> Path | None:
    """The file that Radiance's programs find for a word, links resolved; None if there is none."""
    found = place_of(word, folder)
    try:
        return found if found is not None and found.is_file() else None
    except (OSError, ValueError):
        return None


def _limit(process: int) -> None:
    """Limit time, memory and output of a process."""
    for what, most in (
        (resource.RLIMIT_CPU, MOST_SECONDS),
        (resource.RLIMIT_FSIZE, MOST_BYTES),
        (resource.RLIMIT_AS, MOST_MEMORY),
    ):
        try:
            resource.prlimit(process, what, (most, most))
        except (OSError, ValueError):  # it has ended, or has a lower limit already
            return


def _stages(given: Command) -> list[list[str]]:
    """Programs of a pipeline with their arguments.

    Raises:
        SceneError: it needs other features of a shell, or other programs.
    """
    lexer = shlex.shlex(given.line, posix=True, punctuation_chars="|;&<>()`")
    lexer.whitespace_split, lexer.commenters = True, ""
    stages: list[list[str]] = [[]]
    try:
        for word in lexer:
            if word == "|":
                stages.append([])
            elif word and set(word) <= _SHELL:
                raise SceneError(
                    f"{given.place}: the shell operator `{word}` is not supported in a command; write files instead"
                )
            else:
                stages[-1].append(word)
    except ValueError as error:
        raise SceneError(
            f"{given.place}: {given.line[:80]!r} is not a command: {str(error).lower()}"
        ) from None
    for words in stages:
        if not words:
            raise SceneError(f"{given.place}: {given.line[:80]!r} is not a command: a program is missing")
        if words[0] not in PROGRAMS:
            raise SceneError(
                f"{given.place}: `{words[0][:80]}` is not run; scene files may run only {', '.join(PROGRAMS)}. Run "
                "it yourself, and replace the command with its output"
            )
    return stages


def _divided(arguments: list[str], source: str) -> tuple[list[str], list[str]]:
    """Options of `xform`, and its file arguments."""
    at = 0
    while at < len(arguments):
        word = arguments[at]
        arity = _XFORM.get(word, _XFORM_ONCE.get(word))
        if arity is None:
            if word.startswith("-"):
                raise SceneError(f"{source}: option {word!r} is not supported")
            break
        at += 1 + arity
    return arguments[:at], arguments[at:]
