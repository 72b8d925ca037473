"""A real Grid Engine with one host and two slots."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from private_machine import PrivateMachine, missing

USER = "nobody"  # Grid Engine runs no jobs of root

QUEUE = """
qname main.q
hostlist @allhosts
seq_no 0
load_thresholds NONE
suspend_thresholds NONE
nsuspend 1
suspend_interval 00:05:00
priority 0
min_cpu_interval 00:05:00
processors UNDEFINED
qtype BATCH INTERACTIVE
ckpt_list NONE
pe_list make
rerun TRUE
slots 2
tmpdir /tmp
shell /bin/sh
prolog NONE
epilog NONE
shell_start_mode unix_behavior
starter_method NONE
suspend_method NONE
resume_method NONE
terminate_method NONE
notify 00:00:60
owner_list NONE
user_lists NONE
xuser_lists NONE
subordinate_list NONE
complex_values NONE
projects NONE
xprojects NONE
calendar NONE
initial_state default
"""
LIMITS = "rt cpu fsize data stack core rss vmem"

SETUP = """
for place in /var/lib/gridengine /var/spool/gridengine; do
    mkdir -p {folder}/private$place
    cp -a $place/. {folder}/private$place/
    mount --bind {folder}/private$place $place
done
find /var/spool/gridengine -type f -delete
chown sgeadmin: /var/spool/gridengine /var/spool/gridengine/* /var/lib/gridengine
mkdir -p /var/lib/gridengine/default/common
echo n0 >/var/lib/gridengine/default/common/act_qmaster
chown -R sgeadmin: /var/lib/gridengine/default
# The scripts of the package ask for the services by name or by number.
export SGE_ROOT=/var/lib/gridengine SGE_CELL=default
runuser -u sgeadmin -- /usr/share/gridengine/scripts/init_cluster /var/lib/gridengine default \
    /var/spool/gridengine/spooldb sgeadmin
/usr/sbin/sge_qmaster
as_admin() {{ runuser -u sgeadmin -- "$@"; }}
until as_admin qconf -sh; do sleep 0.3; done
/usr/sbin/sge_execd
as_admin qconf -ah n0 || true
as_admin qconf -as n0
printf 'group_name @allhosts\\nhostlist n0\\n' >{folder}/hosts.conf
chmod 644 {folder}/*.conf
as_admin qconf -Ahgrp {folder}/hosts.conf
as_admin qconf -Aq {folder}/queue.conf
as_admin qconf -ssconf | sed 's/^schedule_interval .*/schedule_interval 0:0:1/' >{folder}/scheduler.conf
as_admin qconf -Msconf {folder}/scheduler.conf
until qstat -f | grep -q 'main.q@n0 .* lx-\\|main.q@n0 .* [0-9.]* *[a-z]*-amd64 *$'; do sleep 0.3; done
"""


def why_not():
    """Why there can be no Grid Engine here; empty if there can."""
    return missing("sge_qmaster", "sge_execd", "qsub", "qconf")


class GridEngine(PrivateMachine):
    """One host, n0, with two slots in main.q."""

    def __init__(self, folder):
        limits = "\n".join(f"{kind}_{name} INFINITY" for name in LIMITS.split() for kind in "sh")
        (folder / "queue.conf").write_text(QUEUE.lstrip() + limits + "\n")
        work = folder / "work"
        work.mkdir()
        work.chmod(0o777)
        super().__init__(folder, "n0", open_to_others(folder) + SETUP.format(folder=folder))

    @property
    def environment(self):
        home = self.folder / "work"
        return {"SGE_ROOT": "/var/lib/gridengine", "SGE_CELL": "default", "HOME": str(home), "USER": USER}

    def jobs(self, state="r"):
        """Ids of the jobs that run; with state a, those that wait or end too."""
        lines = self.run("qstat", "-s", state, "-u", "*", env=self._variables).splitlines()
        return [line.split()[0] for line in lines if line.split()[0].isdigit()]

    def cancel(self, job):
        """Cancel a job."""
        self.run("qdel", job, user=USER, env=self._variables)

    def clear(self):
        """Have no jobs; by force, since those whose watcher was killed would be ending for ever."""
        for job in self.jobs("a"):
            # It may end by itself meanwhile, and then it cannot be deleted.
            words = self.command("qdel", "-f", job, user="sgeadmin")
            subprocess.run(words, env=self._variables, capture_output=True, check=False)
        self.wait_until(lambda: not self.jobs("a"), 240)

    def kill_daemons(self):
        """The execution daemon goes, with those that watch over jobs, and comes back."""
        self.run("pkill", "-9", "sge_execd", env=self._variables)
        self.run("pkill", "-9", "sge_shepherd", env=self._variables)
        time.sleep(2)
        self.run("/usr/sbin/sge_execd", env=self._variables)

    @property
    def _variables(self):
        return {**self.environment, "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}


def open_to_others(folder):
    """Shell lines after which every user may read our Python and our modules, wherever they lie.

    They often lie in somebody's home. What is there is mounted again, with only what is needed, in folders that
    anybody may enter.
    """
    needed = {Path(path).resolve() for path in (sys.prefix, sys.base_prefix, *sys.path) if path}
    needed = {path for path in needed if path.is_dir() and not any(p in needed for p in path.parents)}
    hidden = {path: _private_ancestor(path) for path in sorted(needed)}
    hidden = {path: ancestor for path, ancestor in hidden.items() if ancestor is not None}
    lines = []
    for number, path in enumerate(hidden):
        lines += [f"mkdir -p {folder}/open/{number}", f"mount --bind {path} {folder}/open/{number}"]
    lines += [f"mount -t tmpfs -o mode=755 tmpfs {ancestor}" for ancestor in sorted(set(hidden.values()))]
    for number, path in enumerate(hidden):
        lines += [f"mkdir -p {path}", f"mount --move {folder}/open/{number} {path}"]
    return "\n".join(lines) + "\n"


def _private_ancestor(path):
    """The outermost folder on the way to `path`, or itself, that others may not enter."""
    for ancestor in [*reversed(path.parents), path]:
        if not ancestor.stat().st_mode & 0o001:
            return ancestor
    return None
