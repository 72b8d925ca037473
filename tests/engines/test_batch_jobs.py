"""Job scripts of every batch system, and what happens to jobs; the systems here are stand-ins of a few lines.

Real Slurm and Grid Engine: tests/grid.
"""

import os
import re
import signal
import stat
import subprocess
import threading

import dask
import psutil
import pytest

from steadylight.engines import batch_workers, check_engine
from steadylight.engines.batch_jobs import (
    Scheduler,
    cores_of,
    is_listed,
    last_words,
    listed_jobs,
    make_job,
    walltime_of,
)
from steadylight.engines.certificates import forget_others, temporary_security
from steadylight.engines.scheduler import OwnScheduler
from steadylight.errors import RunError, SettingsError
from steadylight.settings import ExecutionSettings
from steadylight.sites import BATCH_SYSTEMS, SiteSettings

SCHEDULER = Scheduler("tcp://a:1")
SITE = SiteSettings(
    queue="long",
    account="lab7",
    cores=16,
    memory="60 GB",
    walltime="04:00:00",
    scratch="/scratch",
    python="/opt/venv/bin/python",
    prologue=("module load llvm",),
)

# What the head of each system's script must say of the site above, and how a directive of its own looks.
HEADS = {
    "slurm": ["#SBATCH -p long", "#SBATCH -A lab7", "#SBATCH --cpus-per-task=16", "#SBATCH -n 1"],
    "sge": ["#$ -q long", "#$ -P lab7", "#$ -l h_rt=04:00:00", "#$ -S /bin/bash", "#$ -r n"],
    "pbs": ["#PBS -q long", "#PBS -A lab7", "#PBS -l select=1:ncpus=16:mem=56GB", "#PBS -r n"],
    "lsf": ["#BSUB -q long", '#BSUB -P "lab7"', "#BSUB -n 16", '#BSUB -R "span[hosts=1]"', "#BSUB -rn"],
    "htcondor": ["MY.DaskWorkerCores = 16", "RequestCpus = MY.DaskWorkerCores", "Queue"],
    "oar": ["#OAR -q long", "#OAR --project lab7", "#OAR -l /nodes=1/core=16,walltime=04:00:00"],
}
WALLTIMES = {"slurm": "#SBATCH -t 04:00:00", "pbs": "#PBS -l walltime=04:00:00", "lsf": "#BSUB -W 04:00:00"}


def site_for(system, **more):
    """The site above, less what a system cannot be told."""
    values = SITE.model_dump(exclude_unset=True) | more
    if system == "htcondor":
        values = {k: v for k, v in values.items() if k not in {"queue", "account", "walltime"}} | {
            "disk": "5 GB"
        }
    return SiteSettings(**values)


def script_of(system, tmp_path, **more):
    marker = tmp_path / "wanted-1"
    job = make_job(
        system,
        site_for(system, **more),
        Scheduler("tls://10.0.0.1:8786"),
        name="w-1",
        folder=tmp_path,
        marker=marker,
    )
    return job.job_script()


@pytest.mark.parametrize("system", BATCH_SYSTEMS)
def test_a_job_is_one_worker_that_leaves_the_cores_to_the_renderer(system, tmp_path):
    script = script_of(system, tmp_path)
    assert script.count("steadylight.engines.job_worker tls://10.0.0.1:8786 --name w-1") == 1
    assert "/opt/venv/bin/python -m steadylight.engines.job_worker" in script
    # The last of an option that is given twice counts.
    assert re.findall(r"--nthreads (\d+)", script)[-1] == "1"
    assert re.findall(r"--memory-limit (\S+)", script)[-1].strip("'\"") == "0"
    assert "--nworkers" not in script
    assert "--local-directory /scratch" in script


@pytest.mark.parametrize("system", BATCH_SYSTEMS)
def test_a_script_tells_the_system_what_the_site_file_says(system, tmp_path):
    lines = script_of(system, tmp_path).splitlines()
    assert set(HEADS[system]) <= set(lines), "\n".join(lines)
    if system in WALLTIMES:
        assert WALLTIMES[system] in lines


@pytest.mark.parametrize("system", BATCH_SYSTEMS)
def test_nobody_waits_for_a_job_without_its_sign_and_the_prologue_comes_before_the_worker(system, tmp_path):
    script = script_of(system, tmp_path)
    places = [script.index(words) for words in ("wanted-1 ] || exit 0", "module load llvm", "job_worker tls")]
    assert places == sorted(places)


def test_directives_of_the_site_are_added_and_lines_can_be_left_out(tmp_path):
    script = script_of("slurm", tmp_path, directives=("--constraint=avx2",), skip_directives=("--mem",))
    assert "#SBATCH --constraint=avx2" in script
    assert "#SBATCH --no-requeue" in script
    assert "--mem=" not in script
    script = script_of("htcondor", tmp_path, directives=("+Project = lab7",))
    assert "+Project = lab7" in script
    script = script_of("sge", tmp_path, parallel_environment="smp")
    assert "#$ -pe smp 16" in script


def test_certificates_go_by_their_files_and_never_by_their_content(tmp_path):
    security = temporary_security(tmp_path / "tls")
    job = make_job("slurm", SITE, Scheduler("tls://10.0.0.1:8786", security), name="w-1", folder=tmp_path)
    script = job.job_script()
    assert f"--tls-key {tmp_path}/tls/key.pem" in script
    assert f"--tls-cert {tmp_path}/tls/certificate.pem" in script
    assert "PRIVATE KEY" not in script
    assert "--protocol tls://" in script


TRAP = "my run; $(touch taken) `touch taken` & it's \"#%"


def arguments_of(system, script, folder):
    """What the worker of a job is called with: the script runs, with a stand-in for Python."""
    if system == "htcondor":
        # As its manual says: the value is in double quotes, its words in single ones, and quotes within are doubled.
        (line,) = re.findall(r'^Arguments = "(.*)"$', script, re.MULTILINE)
        words = re.findall(r"(?:[^ ']|'(?:[^']|'')*')+", line.replace('""', '"'))
        command = [re.sub(r"'((?:[^']|'')*)'", lambda m: m[1].replace("''", "'"), word) for word in words]
        command = ["/bin/sh", *command]
    else:
        (folder / "script.sh").write_text(script)
        command = ["bash", str(folder / "script.sh")]
    subprocess.run(command, cwd=folder, check=True)
    return (folder / "said.txt").read_text().splitlines()


@pytest.mark.parametrize("system", BATCH_SYSTEMS)
def test_a_path_with_signs_of_the_shell_reaches_the_worker_as_it_is(system, tmp_path):
    folder = tmp_path / (TRAP.translate({ord("$"): None, ord("%"): None}) if system == "htcondor" else TRAP)
    security = temporary_security(folder / "tls-1")
    marker = folder / "wanted-1"
    marker.touch()
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {tmp_path}/said.txt; echo some words\n')
    python.chmod(0o700)
    site = site_for(system, python=str(python), prologue=(), scratch="/scratch of $USER")
    scheduler = Scheduler("tls://10.0.0.1:8786", security)
    script = make_job(system, site, scheduler, name="w-1", folder=folder, marker=marker).job_script()
    head = [line for line in script.splitlines() if re.match(r"#[A-Z$]|Output|Error|Log", line)]
    assert not [line for line in head if "my run" in line]
    said = arguments_of(system, script, tmp_path)
    assert said[said.index("--tls-key") + 1] == str(folder / "tls-1" / "key.pem")
    assert said[said.index("--local-directory") + 1] == "/scratch of $USER"
    assert not (tmp_path / "taken").exists()
    assert last_words(folder, "17", "w-1") == "some words"
    marker.unlink()
    (tmp_path / "said.txt").write_text("")
    assert arguments_of(system, script, tmp_path) == []


@pytest.mark.parametrize(("system", "sign"), [("slurm", "\n"), ("sge", "\r"), ("htcondor", "$")])
def test_a_path_that_no_quotes_bring_through_is_refused_and_the_sign_is_named(system, sign, tmp_path):
    with pytest.raises(SettingsError, match=rf"the character {re.escape(repr(sign))} cannot be written"):
        make_job(system, site_for(system), SCHEDULER, name="w", folder=tmp_path / f"a{sign}b")


def test_a_worker_of_a_job_listens_where_it_is_needed_only_and_keeps_its_files_to_itself(
    tmp_path, importing_environment
):
    from distributed import Client

    security = temporary_security(tmp_path / "tls-1")
    own = OwnScheduler("127.0.0.1", 0, security, tmp_path)
    scratch = tmp_path / "scratch"
    script = make_job(
        "slurm",
        SiteSettings(cores=1, memory="1 GB", scratch=str(scratch)),
        Scheduler(own.cluster.scheduler_address, security),
        name="w-1",
        folder=tmp_path,
    ).job_script()
    (tmp_path / "script.sh").write_text(f"{script.rstrip()} & wait")
    try:
        with (
            Client(own.cluster, set_as_default=False) as client,
            subprocess.Popen(
                ["bash", "script.sh"], cwd=tmp_path, env=importing_environment, start_new_session=True
            ) as job,
        ):
            try:
                client.wait_for_workers(1, timeout=60)
                family = psutil.Process(job.pid).children(recursive=True)
                places = {
                    place.laddr.ip
                    for process in family
                    for place in process.net_connections("inet")
                    if place.status == psutil.CONN_LISTEN
                }
                assert places == {"127.0.0.1"}
                (private,) = scratch.iterdir()
                assert private.stat().st_mode & 0o077 == 0
            finally:
                os.killpg(job.pid, signal.SIGTERM)
                psutil.wait_procs(family, timeout=30)
        assert list(scratch.iterdir()) == []
    finally:
        own.cluster.close()


def test_certificates_of_killed_commands_are_removed_by_the_next(tmp_path):
    for number in (1, 2):
        temporary_security(tmp_path / f"tls-{number}")
    (tmp_path / "steadylight-1.out").touch()
    forget_others(tmp_path / "tls-2")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["steadylight-1.out", "tls-2"]


def test_what_the_site_file_leaves_out_comes_from_dasks_configuration(tmp_path):
    mine = {
        "jobqueue.slurm.cores": 8,
        "jobqueue.slurm.memory": "20 GB",
        "jobqueue.slurm.queue": "ours",
        "jobqueue.slurm.walltime": "2-00:00:00",
        "jobqueue.slurm.job-extra-directives": ["--exclusive"],
        "jobqueue.slurm.job-script-prologue": ["module load site"],
    }
    make_job("slurm", SITE, SCHEDULER, name="w")  # reads the library's own defaults first
    with dask.config.set(mine):
        site = SiteSettings()
        script = make_job("slurm", site, SCHEDULER, name="w", folder=tmp_path).job_script()
        assert cores_of("slurm", site) == 8
        assert walltime_of("slurm", site) == 2 * 86400
    assert {"#SBATCH -p ours", "#SBATCH --exclusive", "#SBATCH --no-requeue", "module load site"} <= set(
        script.splitlines()
    )


def test_modules_of_this_process_are_found_on_the_nodes(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}/a b:/opt/modules")
    script = make_job(
        "slurm", SITE.model_copy(update={"python": None}), SCHEDULER, name="w", folder=tmp_path
    ).job_script()
    assert f"export PYTHONPATH='{tmp_path}/a b:/opt/modules'" in script


@pytest.mark.parametrize("system", BATCH_SYSTEMS)
def test_what_a_system_needs_and_is_not_told_is_named(system):
    with pytest.raises(SettingsError, match=r'cores and memory.*`cores = 16`, `memory = "60 GB"`'):
        make_job(system, SiteSettings(), SCHEDULER, name="w")


def test_a_setting_that_a_system_does_not_know_is_refused():
    with pytest.raises(SettingsError, match=r"are not valid for this batch system.*resource_spec"):
        make_job("slurm", site_for("slurm", resources="gpu=1"), SCHEDULER, name="w")


def test_a_system_whose_commands_are_missing_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SettingsError, match="command bsub not found"):
        check_engine(ExecutionSettings(cluster="lsf", site=SITE))


def test_site_settings_for_jobs_have_no_meaning_elsewhere():
    with pytest.raises(SettingsError, match=r"account, cores, .* has no effect with --cluster local"):
        check_engine(ExecutionSettings(cluster="local", site=SITE))


def test_lsf_and_oar_read_two_parts_of_a_walltime_as_hours_and_minutes():
    assert walltime_of("lsf", SiteSettings(walltime="04:00")) == 4 * 3600
    assert walltime_of("slurm", SiteSettings(walltime="04:00")) == 4 * 60


def stand_in(folder, monkeypatch, name, body):
    program = folder / name
    program.write_text(f"#!/bin/sh\n{body}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")


@pytest.mark.parametrize(
    ("system", "program", "says", "job"),
    [
        ("slurm", "squeue", "17\n18", "17"),
        ("sge", "qstat", "job-ID prior name\n-----\n     17 0.50 steadyligh me r 11/21/2026 14:18:00", "17"),
        ("pbs", "qstat", "Job id  Name\n17.server  steadyli me 00:00:18 R long", "17"),
        ("lsf", "bjobs", "17", "17"),
        ("htcondor", "condor_q", "17.0", "17.0"),
        ("oar", "oarstat", "Job id  Name\n17  steadyli me", "17"),
    ],
)
def test_jobs_are_found_in_listings(system, program, says, job, tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, program, f"cat <<'END'\n{says}\nEND")
    listed = listed_jobs(system)
    assert is_listed(job, listed)
    assert not is_listed("1", listed)
    assert not is_listed("14", listed)


def test_a_listing_that_fails_says_nothing_about_jobs(tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, "squeue", "exit 1")
    assert listed_jobs("slurm") is None
    stand_in(tmp_path, monkeypatch, "bjobs", "echo No unfinished job found >&2; exit 255")
    assert listed_jobs("lsf") == set()
    assert listed_jobs("oar") is None


def test_the_last_words_of_a_job_are_the_end_of_its_logs(tmp_path):
    (tmp_path / "steadylight-17.err").write_text("x" * 5000 + "module: not found\n")
    (tmp_path / "steadylight-18.err").write_text("another")
    assert last_words(tmp_path, "17").endswith("module: not found")
    assert "another" not in last_words(tmp_path, "17")


@pytest.mark.parametrize(
    "name", ["steadylight-17.err", "steadylight.e17", "steadylight.pe17", "17.server.ER", "worker-17.0.err"]
)
def test_logs_of_other_jobs_are_not_taken_for_those_of_a_job(name, tmp_path):
    for other in ("steadylight-117.err", "steadylight.o171", "a17b-17-203.err", "170.server.OU"):
        (tmp_path / other).write_text("another")
    (tmp_path / name).write_text("mine")
    assert last_words(tmp_path, "17.server") == "mine"
    assert last_words(tmp_path, "7") == ""


class Workload:
    def __init__(self, tasks, busy=(), avoided=()):
        self.tasks, self.busy, self.avoided = tasks, busy, avoided


class Queue:
    """A batch system that exists in this process only."""

    def __init__(self, monkeypatch):
        self.submitted, self.cancelled, self.listed = [], [], set()
        self.refuses = ""
        self.now = 1000.0
        self.scheduler = self
        self.address = "tcp://here:1"
        monkeypatch.setattr(batch_workers, "make_job", self.make)
        self.asked = 0
        self.answers = threading.Event()
        self.answers.set()
        monkeypatch.setattr(batch_workers, "listed_jobs", self.list_jobs)
        monkeypatch.setattr(batch_workers.time, "monotonic", lambda: self.now)

    def make(self, _system, _site, _scheduler, *, name, **_):
        queue = self

        class Job:
            job_id = str(len(queue.submitted) + 1)

            def start(self):
                if queue.refuses:
                    raise RuntimeError(queue.refuses)
                queue.submitted.append(name)
                queue.listed.add(self.job_id)

            def close(self):
                queue.cancelled.append(name)

        return Job()

    def list_jobs(self, _system):
        self.asked += 1
        listed = set(self.listed)
        assert self.answers.wait(30)
        return listed

    @staticmethod
    def sync(function):
        return function()


@pytest.fixture
def queue(monkeypatch):
    return Queue(monkeypatch)


def pool_of(queue, folder, most=3, **site):
    settings = SiteSettings(walltime="01:00:00", idle_after=100.0, **site)
    return batch_workers.BatchWorkers(queue, "slurm", settings, most, folder, security=None)


def answered(pool):
    """Wait until the listing that was asked for is there."""
    pool._listing._thread.join(30)


def list_jobs(pool, queue):
    """Let the pool ask for a listing and read it."""
    queue.now += 6
    pool.tend((), Workload(5))
    answered(pool)
    pool.tend((), Workload(5))


class TestBatchWorkers:
    def test_there_are_as_many_jobs_as_tasks_between_the_least_and_the_most(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path)
        pool.tend((), Workload(0))
        assert len(queue.submitted) == 1
        pool.tend((), Workload(50))
        assert len(queue.submitted) == 3
        pool.tend((), Workload(50))
        assert len(queue.submitted) == 3

    def test_a_gap_in_the_work_does_not_give_workers_back_and_a_long_one_does(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path)
        pool.tend((), Workload(3))
        names = set(queue.submitted)
        busy = queue.submitted[0]
        pool.tend(names, Workload(1, {busy}))
        queue.now += 90
        pool.tend(names, Workload(1, {busy}))
        assert not queue.cancelled
        queue.now += 20
        pool.tend(names, Workload(1, {busy}))
        assert len(queue.cancelled) == 2
        assert busy not in queue.cancelled

    def test_a_job_whose_worker_left_is_replaced_after_a_while(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=1)
        pool.tend((), Workload(5))
        pool.tend(queue.submitted, Workload(5))
        pool.tend((), Workload(5))
        queue.now += 10
        pool.tend((), Workload(5))
        assert not queue.cancelled
        queue.now += 15
        pool.tend((), Workload(5))
        assert queue.cancelled == queue.submitted[:1]
        assert len(queue.submitted) == 2

    def test_a_registered_worker_works_whatever_the_queue_says(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=1)
        pool.tend((), Workload(5))
        queue.listed.clear()
        for _ in range(10):
            queue.now += 10
            pool.tend(queue.submitted, Workload(5, queue.submitted))
        assert len(queue.submitted) == 1

    def test_a_job_that_two_listings_lack_is_replaced_and_the_third_such_ends_the_run(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=1)
        pool.tend((), Workload(5))
        for lost in (1, 2):
            list_jobs(pool, queue)
            queue.listed.clear()
            list_jobs(pool, queue)
            # Two looks at one listing are not two listings.
            pool.tend((), Workload(5))
            assert len(queue.submitted) == lost
            list_jobs(pool, queue)
            assert len(queue.submitted) == lost + 1
        queue.listed.clear()
        list_jobs(pool, queue)
        with pytest.raises(RunError, match="3 jobs ended before their worker could connect to this machine"):
            list_jobs(pool, queue)

    def test_a_listing_that_takes_long_holds_nothing_up(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=2)
        pool.tend((), Workload(1))
        queue.listed.clear()
        queue.answers.clear()
        queue.now += 6
        for _ in range(5):
            pool.tend((), Workload(1))
            queue.now += 6
        assert queue.asked == 1
        pool.tend((), Workload(5))
        assert len(queue.submitted) == 2
        queue.answers.set()
        answered(pool)
        # What was submitted after the question cannot be in the answer.
        pool._list(queue.now)
        assert [job.unlisted for job in pool._jobs.values()] == [1, 0]

    def test_there_is_hope_for_other_hosts_until_all_jobs_that_may_be_have_come(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=2)
        assert pool.may_grow
        pool.tend((), Workload(9))
        bad = set(queue.submitted)
        pool.tend(bad, Workload(9))
        assert not pool.may_grow
        pool.tend(bad, Workload(9, (), bad))
        assert pool.may_grow
        pool.tend(queue.submitted, Workload(9, (), bad))
        assert not pool.may_grow
        pool.tend(queue.submitted, Workload(9, (), set(queue.submitted)))
        assert len(queue.submitted) == 4
        assert not pool.may_grow

    def test_a_job_that_nobody_needs_is_not_waited_for(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=2)
        assert pool.grows
        pool.tend((), Workload(1))
        first = set(queue.submitted)
        assert pool.grows  # the job waits
        pool.tend(first, Workload(1))
        assert pool.may_grow
        assert not pool.grows
        pool.tend(first, Workload(1, (), first))
        assert pool.grows  # one will come in the place of that on a bad host
        pool.tend(queue.submitted, Workload(1, (), first))
        assert not pool.grows

    def test_jobs_on_bad_hosts_are_kept_and_others_come_in_their_place(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=2)
        pool.tend((), Workload(9))
        bad = set(queue.submitted)
        for _ in range(5):
            pool.tend(queue.submitted, Workload(9, (), bad))
        assert len(queue.submitted) == 4
        assert not queue.cancelled

    def test_a_worker_near_its_walltime_gets_no_long_task_and_is_replaced(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=1)
        pool.tend((), Workload(5))
        (name,) = queue.submitted
        pool.tend([name], Workload(5, [name]))
        assert pool.has_time(name, 7200)
        queue.now += 3000
        assert pool.has_time(name, 300)
        assert not pool.has_time(name, 500)
        assert not pool.expired(name)
        queue.now += 560
        assert pool.expired(name)
        pool.tend([name], Workload(5))
        assert queue.cancelled == [name]
        assert len(queue.submitted) == 2

    def test_an_old_worker_that_no_task_suits_makes_room_for_a_fresh_one(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=1)
        pool.tend((), Workload(5))
        (name,) = queue.submitted
        pool.tend([name], Workload(5, [name]))
        queue.now += 2400
        pool.tend([name], Workload(5))
        assert not queue.cancelled
        queue.now += 31
        pool.tend([name], Workload(5))
        assert queue.cancelled == [name]
        assert len(queue.submitted) == 2

    def test_the_first_refusal_is_final_and_later_ones_are_waited_out(self, queue, tmp_path):
        queue.refuses = "invalid account"
        with pytest.raises(SettingsError, match="rejected the job: invalid account"):
            pool_of(queue, tmp_path).tend((), Workload(5))
        queue.refuses = ""
        pool = pool_of(queue, tmp_path)
        pool.tend((), Workload(1))
        queue.refuses = "the controller is away"
        pool.tend((), Workload(5))
        queue.refuses = ""
        pool.tend((), Workload(5))
        assert len(queue.submitted) == 1
        queue.now += 20
        pool.tend((), Workload(5))
        assert len(queue.submitted) == 3

    def test_jobs_of_a_killed_command_find_their_sign_gone(self, queue, tmp_path):
        first = pool_of(queue, tmp_path)
        (sign,) = tmp_path.glob("wanted-*")
        second = pool_of(queue, tmp_path)
        assert not sign.exists()
        assert len(list(tmp_path.glob("wanted-*"))) == 1
        second.close()
        first.close()
        assert not list(tmp_path.glob("wanted-*"))

    def test_workers_of_other_sites_are_welcome_and_those_given_up_are_not(self, queue, tmp_path):
        pool = pool_of(queue, tmp_path, most=1)
        pool.tend((), Workload(5))
        (name,) = queue.submitted

        class Worker:
            def __init__(self, name):
                self.name = name

        known = {"tls://a": Worker(name), "tls://b": Worker("of-another-site")}
        assert set(pool.ours(known)) == {"tls://a", "tls://b"}
        pool.end(name, "tls://a", hung=True)
        assert queue.cancelled == [name]
        assert set(pool.ours(known)) == {"tls://b"}
