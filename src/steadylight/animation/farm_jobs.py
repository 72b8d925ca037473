"""A run as a job of a render farm: the plan in the format of Open Job Description, Flamenco or OpenCue.

Each job does the tasks of the plan with `steadylight perform`, in the order that their dependencies allow, and makes
video, statistics and report at the end. The farm decides where and when; the bytes of the frames do not depend on it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

from steadylight.animation.farm import FINISH, FarmRun, number_of, step_of
from steadylight.engines import Task

OF_A_FRAME: Final = ("shade", "aovs")
"""Steps with a task per frame, of which one command does several."""


@dataclass(frozen=True)
class FarmOptions:
    """What a farm needs to know besides the plan.

    Attributes:
        program: name or path of the `steadylight` command on the machines of the farm.
        chunk: number of frames that one command renders, so that program and scene are loaded only once for them.
    """

    program: str = "steadylight"
    chunk: int = 8


def write_job(run: FarmRun, job_format: str, options: FarmOptions) -> str:
    """The text of a job.

    Args:
        run: the run whose tasks the job does.
        job_format: a key of FORMATS.
        options: settings of the farm.
    """
    return FORMATS[job_format].write(run, options)


def steps_of(tasks: Sequence[Task]) -> dict[str, list[Task]]:
    """Tasks by step, in the order of the plan."""
    steps: dict[str, list[Task]] = {}
    for task in tasks:
        steps.setdefault(step_of(task), []).append(task)
    return steps


def step_needs(tasks: Sequence[Task]) -> dict[str, list[str]]:
    """The steps that must be done before each step; FINISH needs every step that no other step needs."""
    own = {task.key: step_of(task) for task in tasks}
    needs = {
        step: list(dict.fromkeys(own[key] for task in group for key in task.needs))
        for step, group in steps_of(tasks).items()
    }
    needed = {before for steps in needs.values() for before in steps}
    return needs | {FINISH: [step for step in needs if step not in needed]}


# Open Job Description --------------------------------------------------------------------------------------


def _open_job_description(run: FarmRun, options: FarmOptions) -> str:
    """A template `jobtemplate-2023-09` as JSON: a step for each step of the plan, numbered tasks in chunks."""
    needs = step_needs(run.tasks)
    steps = [
        _openjd_step(step, [number_of(task) for task in group], needs[step], options)
        for step, group in steps_of(run.tasks).items()
    ]
    template = {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": _short(f"steadylight {run.title}", 128),
        "parameterDefinitions": [
            {
                "name": "RunDirectory",
                "type": "STRING",
                "description": "The run directory, as all machines of the farm see it.",
                "default": str(run.directory.root.resolve()),
            },
            {
                "name": "Program",
                "type": "STRING",
                "description": "The steadylight command on the machines of the farm.",
                "default": options.program,
            },
        ],
        "steps": [*steps, _openjd_step(FINISH, [None], needs[FINISH], options)],
    }
    return json.dumps(template, indent=2) + "\n"


def _openjd_step(
    step: str, numbers: Sequence[int | None], needs: Sequence[str], options: FarmOptions
) -> dict[str, Any]:
    """A step; if its tasks have numbers, each chunk of these is one command."""
    listed = [number for number in numbers if number is not None]
    key = f"{step}:{{{{Task.Param.Number}}}}" if listed else step
    command = {"command": "{{Param.Program}}", "args": ["perform", "{{Param.RunDirectory}}", key]}
    described: dict[str, Any] = {"name": step}
    if needs:
        described["dependencies"] = [{"dependsOn": before} for before in needs]
    if listed:
        chunks = {
            "defaultTaskCount": options.chunk if step in OF_A_FRAME else 1,
            "rangeConstraint": "NONCONTIGUOUS",
        }
        number = {"name": "Number", "type": "CHUNK[INT]", "range": ranges(listed), "chunks": chunks}
        described["parameterSpace"] = {"taskParameterDefinitions": [number]}
    return described | {"script": {"actions": {"onRun": command}}}


def ranges(numbers: Sequence[int]) -> str:
    """Ascending numbers as `1-8,12`."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in spans)


# Flamenco ---------------------------------------------------------------------------------------------------


def _flamenco(run: FarmRun, options: FarmOptions) -> str:
    """A job type in JavaScript, with the plan as data: a Flamenco task for each task or chunk of frames."""
    place = {task.key: number for number, task in enumerate(run.tasks)}
    plan = [[step_of(task), task.key, [place[key] for key in task.needs]] for task in run.tasks]
    script = resources.files("steadylight.animation").joinpath("flamenco.js").read_text(encoding="utf-8")
    values = {
        "TITLE": f"steadylight: {run.title}",
        "RUN_DIRECTORY": str(run.directory.root.resolve()),
        "PROGRAM": options.program,
        "CHUNK": options.chunk,
        "FINISH": FINISH,
    }
    for name, value in values.items():
        script = script.replace(f'"@{name}@"', _script(value))
    rows = ",\n".join(f"    {_script(row)}" for row in plan)
    return script.replace('"@PLAN@"', f"[\n{rows},\n]")


def _script(value: object) -> str:
    """A value as JavaScript: JSON, with the two line separators escaped that older JavaScript does not allow."""
    return json.dumps(value).replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


# OpenCue -----------------------------------------------------------------------------------------------------


def _opencue(run: FarmRun, options: FarmOptions) -> str:
    """An outline script: a layer for each step, and an OpenCue frame for each task or chunk of frames."""
    needs = step_needs(run.tasks)
    lines = [
        f'"""An outline for OpenCue by steadylight: {_short(run.title, 80)!a}; start it with `pycuerun`."""',
        "",
        "from outline.modules.shell import ShellSequence",
        "",
        f"program = {options.program!a}",
        f"run = {str(run.directory.root.resolve())!a}",
    ]
    for step, group in steps_of(run.tasks).items():
        lines += _opencue_layer(step, _chunks(step, group, options), needs[step])
    lines += _opencue_layer(FINISH, [[FINISH]], needs[FINISH])
    return "\n".join(lines) + "\n"


def _opencue_layer(step: str, chunks: Iterable[Sequence[str]], needs: Sequence[str]) -> Iterator[str]:
    """A layer in which each frame is one command; without functions, since an outline has no module of its own."""
    yield from ("", f'layer = ShellSequence("{step}", commands=[')
    for keys in chunks:
        yield '    [program, "perform", run, ' + ", ".join(f'"{key}"' for key in keys) + "],"
    yield "])"
    yield from (f'layer.depend_all("{before}")' for before in needs)


def _chunks(step: str, group: Sequence[Task], options: FarmOptions) -> Iterator[list[str]]:
    size = options.chunk if step in OF_A_FRAME else 1
    for first in range(0, len(group), size):
        yield [task.key for task in group[first : first + size]]


def _short(text: str, length: int) -> str:
    """Text on one line, cut to `length` characters."""
    return "".join(letter if letter.isprintable() else " " for letter in text)[:length]


@dataclass(frozen=True)
class Format:
    """A format of job descriptions.

    Attributes:
        suffix: suffix of its files.
        write: makes the text of a job.
    """

    suffix: str
    write: Callable[[FarmRun, FarmOptions], str]


FORMATS: Final = {
    "openjd": Format(".openjd.json", _open_job_description),
    "flamenco": Format(".flamenco.js", _flamenco),
    "opencue": Format(".opencue.py", _opencue),
}
"""Formats by the name that `--format` takes."""
