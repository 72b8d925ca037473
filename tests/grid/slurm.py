"""A real Slurm with two nodes on one machine."""

from __future__ import annotations

import subprocess
import time

from private_machine import ADDRESS, PrivateMachine, missing

CONFIGURATION = """
ClusterName=test
SlurmctldHost=n0
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=1,bf_interval=2,sched_min_interval=100000
StateSaveLocation={spool}/state
SlurmdSpoolDir={spool}/%n
SlurmctldPidFile={spool}/slurmctld.pid
SlurmdPidFile={spool}/slurmd.%n.pid
SlurmctldLogFile={spool}/slurmctld.log
SlurmdLogFile={spool}/slurmd.%n.log
ReturnToService=2
SlurmctldTimeout=10
SlurmdTimeout=10
KillWait=5
MinJobAge=60
InactiveLimit=0
Waittime=0
NodeName=n[1-2] NodeHostname=n0 NodeAddr={address} Port=[17001-17002] CPUs=2 RealMemory=4000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE DefaultTime=10 State=UP
"""

SETUP = """
mkdir -p {spool}/state {spool}/n1 {spool}/n2 {folder}/munge
dd if=/dev/urandom of={folder}/munge.key bs=128 count=1 status=none
chown -R munge: {folder}/munge {folder}/munge.key
chmod 755 {folder}/munge
chmod 400 {folder}/munge.key
mount -t tmpfs tmpfs /run
mkdir -p /run/munge
chown munge: /run/munge
runuser -u munge -- /usr/sbin/munged --key-file={folder}/munge.key --pid-file={folder}/munge/pid \
    --log-file={folder}/munge/log --seed-file={folder}/munge/seed
export SLURM_CONF={folder}/slurm.conf
/usr/sbin/slurmctld -i
/usr/sbin/slurmd -N n1
/usr/sbin/slurmd -N n2
until [ "$(sinfo --noheader --format=%t%D)" = idle2 ]; do sleep 0.2; done
"""


def why_not():
    """Why there can be no Slurm here; empty if there can."""
    return missing("slurmctld", "slurmd", "munged", "sbatch", "squeue")


class Slurm(PrivateMachine):
    """Two nodes, n1 and n2, with two cores each."""

    def __init__(self, folder):
        spool = folder / "spool"
        (folder / "slurm.conf").write_text(CONFIGURATION.format(spool=spool, address=ADDRESS))
        # The key of munge must not lie below a folder that others may write to.
        super().__init__(folder, "n0", SETUP.format(spool=spool, folder=folder))

    @property
    def environment(self):
        return {"SLURM_CONF": str(self.folder / "slurm.conf")}

    def jobs(self):
        """Ids of the jobs that run."""
        done = subprocess.run(
            self.command("squeue", "--noheader", "--states=R", "--format=%A"),
            env=self._variables,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout.split()

    def cancel(self, job):
        """Cancel a job."""
        self.run("scancel", job, env=self._variables)

    def clear(self):
        """Have no jobs, and both nodes free."""
        self.run("scancel", "--user=root", env=self._variables)
        self.wait_until(lambda: not self.run("squeue", "--noheader", env=self._variables).strip(), 240)
        state = ("sinfo", "--noheader", "--format=%t%D")
        self.wait_until(lambda: self.run(*state, env=self._variables).strip() == "idle2", 240)

    def kill_daemons(self):
        """The nodes' daemons go, with those that watch over jobs, and come back."""
        self.run("pkill", "-9", "slurmd", env=self._variables)
        self.run("pkill", "-9", "slurmstepd", env=self._variables)
        time.sleep(2)
        for node in ("n1", "n2"):
            self.run("slurmd", "-N", node, env=self._variables)

    @property
    def _variables(self):
        return {**self.environment, "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}
