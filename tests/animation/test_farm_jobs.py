"""Jobs for render farms have the graph of the plan, in each farm's own words, read by each farm's own code."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import quickjs
from fake_tasks import FakeRenderer, session
from openjd.model import IntRangeExpr, decode_job_template

from steadylight.animation import farm
from steadylight.animation.farm import FINISH, FarmRun, number_of, step_of
from steadylight.animation.farm_jobs import FarmOptions, ranges, step_needs, steps_of, write_job

ODD = """it's a "run" of $HOME {{Param.X}} & 50% \u2028 é"""
"""A name that shells, templates and scripts could misread."""


@pytest.fixture(params=[1, 2], ids=["whole", "parts"])
def run(request, tmp_path, monkeypatch):
    """A prepared run of 20 frames with a cache in one part or two, under an odd name."""
    monkeypatch.setattr(farm, "find_renderer", lambda _: FakeRenderer())
    with session(tmp_path / ODD, frames="1-19,25", cache_parts=request.param):
        pass
    return FarmRun.open(tmp_path / ODD)


def after(graph):
    """Every node with all that must be done before it, near or far."""
    known = {}

    def of(node):
        if node not in known:
            known[node] = set(graph[node]) | {far for near in graph[node] for far in of(near)}
        return known[node]

    return {node: of(node) for node in graph}


def test_steps_depend_on_the_steps_of_what_their_tasks_need_and_the_end_on_all(run):
    needs = step_needs(run.tasks)
    before = after(needs)
    own = {task.key: step_of(task) for task in run.tasks}
    for task in run.tasks:
        assert {own[key] for key in task.needs} <= before[own[task.key]]
        assert own[task.key] not in before[own[task.key]]
    assert before[FINISH] == set(own.values())


@pytest.mark.parametrize(("numbers", "text"), [([4], "4"), ([1, 2, 3, 7], "1-3,7"), ([1, 3], "1,3")])
def test_ranges_are_short(numbers, text):
    assert ranges(numbers) == text


class TestOpenJobDescription:
    def test_the_template_is_valid_and_has_the_plans_steps_tasks_and_order(self, run):
        template = json.loads(write_job(run, "openjd", FarmOptions(chunk=4)))
        found = decode_job_template(template=template, supported_extensions=["TASK_CHUNKING"])
        assert found.specificationVersion == "jobtemplate-2023-09"
        steps = steps_of(run.tasks)
        assert [step.name for step in found.steps] == [*steps, FINISH]
        needs = {step.name: [each.dependsOn for each in step.dependencies or ()] for step in found.steps}
        assert needs == step_needs(run.tasks)
        for step in found.steps[:-1]:
            numbers = [number_of(task) for task in steps[step.name]]
            if step.parameterSpace is None:
                assert numbers == [None]
                continue
            (parameter,) = step.parameterSpace.taskParameterDefinitions
            assert list(IntRangeExpr.from_str(str(parameter.range))) == numbers
            assert parameter.chunks.defaultTaskCount == (4 if step.name == "shade" else 1)

    def test_names_are_parameters_which_nothing_reads_as_a_template(self, run):
        template = json.loads(write_job(run, "openjd", FarmOptions("/opt/my farm/steadylight")))
        defaults = {each["name"]: each["default"] for each in template["parameterDefinitions"]}
        assert defaults == {"RunDirectory": str(run.directory.root), "Program": "/opt/my farm/steadylight"}
        assert ODD not in json.dumps(template["steps"], ensure_ascii=False)


FLAMENCO = """
const author = {
    Task: (name, type) => ({ name: name, type: type, commands: [], before: [],
        addCommand(command) { this.commands.push(command); },
        addDependency(task) { this.before.push(task.name); } }),
    Command: (name, parameters) => ({ name: name, parameters: parameters }),
};
// As in Flamenco, a job keeps a copy of the task as it is when it is added.
const job = { settings: {}, tasks: [], addTask(task) { this.tasks.push(JSON.parse(JSON.stringify(task))); } };
for (const setting of JOB_TYPE.settings) { job.settings[setting.key] = setting.default; }
"""
"""What a script of Flamenco finds there."""


def compiled(run, chunk, program="steadylight"):
    """The tasks that Flamenco would make."""
    context = quickjs.Context()
    context.eval(write_job(run, "flamenco", FarmOptions(program, chunk)) + FLAMENCO)
    context.eval("compileJob(job)")
    return json.loads(context.eval("JSON.stringify({ label: JOB_TYPE.label, tasks: job.tasks })"))


class TestFlamenco:
    def test_the_graph_of_the_job_is_that_of_the_plan(self, run):
        tasks = {task["name"]: task["before"] for task in compiled(run, 1)["tasks"]}
        last = tasks.pop(FINISH)
        assert tasks == {task.key: list(task.needs) for task in run.tasks}
        assert after(tasks | {FINISH: last})[FINISH] == {task.key for task in run.tasks}

    def test_each_task_performs_itself(self, run):
        program = "C:\\\\farm\\steadylight 'x'"
        for task in compiled(run, 1, program)["tasks"]:
            (command,) = task["commands"]
            assert command["name"] == "exec"
            assert command["parameters"]["exe"] == program
            assert command["parameters"]["args"] == ["perform", str(run.directory.root), task["name"]]

    def test_in_chunks_every_task_is_performed_once_and_after_its_needs(self, run):
        tasks = compiled(run, 3)["tasks"]
        keys = {task["name"]: task["commands"][0]["parameters"]["args"][2:] for task in tasks}
        assert sorted(key for name in keys for key in keys[name]) == sorted(
            [*(task.key for task in run.tasks), FINISH]
        )
        assert max(map(len, keys.values())) == 3
        place = {key: name for name in keys for key in keys[name]}
        before = after({task["name"]: task["before"] for task in tasks})
        for task in run.tasks:
            assert {place[key] for key in task.needs} <= before[place[task.key]]
        assert before[FINISH] == keys.keys() - {FINISH}


LOAD = """
import json, sys
import outline
layers = outline.load_outline(sys.argv[1]).get_layers()
print(json.dumps({layer.get_name(): [
    layer.get_frame_range(), layer.get_arg("commands"),
    [each.get_depend_on_layer().get_name() for each in layer.get_depends()],
] for layer in layers}))
"""


def test_pyoutline_loads_the_script_with_the_plans_layers_commands_and_order(run, tmp_path):
    pytest.importorskip("outline", reason="opencue-pyoutline is not installed", exc_type=ImportError)
    script = tmp_path / "job.py"
    script.write_text(write_job(run, "opencue", FarmOptions(chunk=8)), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", LOAD, script], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    layers = json.loads(done.stdout.splitlines()[-1])
    steps = steps_of(run.tasks)
    assert list(layers) == [*steps, FINISH]
    assert {name: layer[2] for name, layer in layers.items()} == step_needs(run.tasks)
    for name, (numbers, commands, _) in layers.items():
        assert all(command[:3] == ["steadylight", "perform", str(run.directory.root)] for command in commands)
        keys = [key for command in commands for key in command[3:]]
        assert keys == ([task.key for task in steps[name]] if name in steps else [FINISH])
        assert numbers in {f"1-{len(commands)}", "1"}
