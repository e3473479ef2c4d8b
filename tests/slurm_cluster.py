"""A disposable SLURM of several virtual nodes on this machine, for tests.

It needs the Debian packages slurm-wlm and munge, no system service and no file outside its folder.
"""

import contextlib
import ctypes
import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

PROGRAMS = ("munged", "munge", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel", "scontrol")
CLIENTS = ("sbatch", "srun", "squeue", "scancel", "scontrol", "sinfo")
SYSTEM_PATH = f"{os.environ['PATH']}:/usr/sbin:/sbin"

CONFIGURATION = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
SlurmctldPort={port}
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
MailProg=/bin/true
MpiDefault=none
SwitchType=switch/none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SlurmdParameters=config_overrides
PropagateResourceLimits=NONE
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
DefMemPerCPU=500
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=2,bf_interval=2,batch_sched_delay=0
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
ReturnToService=2
SlurmctldTimeout=20
SlurmdTimeout=10
KillWait=2
MinJobAge=3600
{nodes}
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
PartitionName=main Nodes=n[1-{count}] Default=YES MaxTime=INFINITE State=UP
PartitionName=short Nodes=n[1-{count}] MaxTime=1 State=UP
PartitionName=urgent Nodes=n[1-{count}] PriorityTier=2 State=UP
"""


def missing_programs() -> list[str]:
    """The programs that are needed and not installed."""
    return [name for name in PROGRAMS if shutil.which(name, path=SYSTEM_PATH) is None]


def wait_for(condition: Callable[[], object], what: str, seconds: float = 60) -> None:
    """Wait until a condition holds."""
    limit = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < limit, f"{what}: not within {seconds:.0f} s"
        time.sleep(0.1)


def _end_with_parent() -> None:
    """In a child before exec: be terminated when the test process is gone, however it ended."""
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGTERM)


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for item in sockets:
        item.bind(("127.0.0.1", 0))
    ports = [item.getsockname()[1] for item in sockets]
    for item in sockets:
        item.close()
    return ports


class Cluster:
    """One controller and some node daemons, all on this machine.

    Parameters
    ----------
    folder : where everything is written; its path must be short enough for a socket.
    nodes, cpus, memory_mb : number of nodes, and what each claims to have.
    """

    def __init__(self, folder: Path, nodes: int = 3, cpus: int = 2, memory_mb: int = 6000) -> None:
        self.folder = folder
        self.names = [f"n{k + 1}" for k in range(nodes)]
        self.daemons: dict[str, subprocess.Popen[bytes]] = {}
        self.configuration = folder / "slurm.conf"
        self._write_configuration(cpus, memory_mb)
        self._write_clients()

    def _write_configuration(self, cpus: int, memory_mb: int) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.folder.chmod(0o755)
        for name in ("state", *(f"spool-{node}" for node in self.names)):
            (self.folder / name).mkdir(exist_ok=True)
        controller, *ports = _free_ports(1 + len(self.names))
        host = socket.gethostname().split(".")[0]
        nodes = "\n".join(
            f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} "
            f"CPUs={cpus} RealMemory={memory_mb} State=UNKNOWN"
            for name, port in zip(self.names, ports, strict=True)
        )
        user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
        text = CONFIGURATION.format(
            host=host, user=user, port=controller, folder=self.folder, nodes=nodes, count=len(self.names)
        )
        self.configuration.write_text(text)
        # only so that no daemon looks for another
        (self.folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
        key = self.folder / "munge.key"
        key.write_bytes(secrets.token_bytes(1024))
        key.chmod(0o400)

    def _write_clients(self) -> None:
        """Commands that know the configuration: the jobstep plugin removes SLURM_CONF from srun's environment."""
        (self.folder / "bin").mkdir(exist_ok=True)
        for name in CLIENTS:
            script = self.folder / "bin" / name
            real = shutil.which(name, path=SYSTEM_PATH)
            script.write_text(f'#!/bin/sh\nSLURM_CONF={self.configuration} exec {real} "$@"\n')
            script.chmod(0o755)

    @property
    def environment(self) -> dict[str, str]:
        """The environment in which commands talk to this cluster, and to no other around it."""
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("SLURM_", "SBATCH_", "SRUN_"))}
        return {
            **kept,
            "SLURM_CONF": str(self.configuration),
            "PATH": f"{self.folder / 'bin'}:{SYSTEM_PATH}",
        }

    def start(self) -> None:
        """Start all daemons and wait until every node is idle."""
        munged = ["munged", "--foreground", "--force", f"--key-file={self.folder / 'munge.key'}"]
        munged += [f"--socket={self.folder / 'munge.socket'}", f"--pid-file={self.folder / 'munged.pid'}"]
        munged += [f"--log-file={self.folder / 'munged.log'}", f"--seed-file={self.folder / 'munge.seed'}"]
        self._spawn("munged", munged)
        wait_for((self.folder / "munge.socket").exists, "munged")
        self.start_controller()
        for name in self.names:
            self.start_node(name)
        self.wait_for_nodes("idle")

    def start_controller(self) -> None:
        """Start slurmctld, which goes on with what it had saved."""
        self._spawn("slurmctld", ["slurmctld", "-D", "-f", str(self.configuration)])
        wait_for(lambda: "UP" in self.call("scontrol", "ping"), "slurmctld")

    def forget_jobs(self) -> None:
        """Lose what a controller that does not run has saved of its jobs, as a crash may lose the newest."""
        for saved in (self.folder / "state").glob("job_state*"):
            saved.unlink()

    def start_node(self, name: str) -> None:
        """Start one slurmd."""
        self._spawn(name, ["slurmd", "-D", "-N", name, "-f", str(self.configuration)])

    def wait_for_nodes(self, state: str) -> None:
        """Wait until all nodes are in a state."""
        expected = [state] * len(self.names)
        wait_for(lambda: self.call("sinfo", "-hN", "-p", "main", "-o", "%T").split() == expected, state)

    def _spawn(self, name: str, command: list[str]) -> None:
        with (self.folder / f"{name}.out").open("ab") as out:
            self.daemons[name] = subprocess.Popen(
                command,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
                preexec_fn=_end_with_parent,
            )

    def kill(self, name: str, number: int = signal.SIGKILL) -> None:
        """Kill one daemon: a node's name, or slurmctld."""
        daemon = self.daemons.pop(name)
        daemon.send_signal(number)
        daemon.wait(30)

    def kill_processes(self, number: str) -> None:
        """Kill all processes of a job, as a node does that loses its power."""
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                environment = (process / "environ").read_bytes().split(b"\0")
                title = (process / "cmdline").read_bytes()
                if title.startswith(f"slurmstepd: [{number}.".encode()) or (
                    f"SLURM_JOB_ID={number}".encode() in environment
                    and f"SLURM_CONF={self.configuration}".encode() in environment
                ):
                    os.kill(int(process.name), signal.SIGKILL)

    def call(self, *command: str) -> str:
        """The output of a SLURM command; empty where it fails."""
        done = subprocess.run(
            command, env=self.environment, capture_output=True, text=True, timeout=60, check=False
        )
        return done.stdout

    def jobs(self, *states: str) -> list[str]:
        """Ids of the jobs in these states, such as RUNNING; of all that are not finished without any."""
        chosen = ",".join(states) or "PENDING,RUNNING,COMPLETING,SUSPENDED"
        return self.call("squeue", "-h", "-o", "%i", "--states", chosen).split()

    def job(self, number: str) -> dict[str, str]:
        """What SLURM says about a job: JobState, TimeLimit, MinMemoryNode, NodeList and more."""
        words = self.call("scontrol", "show", "job", "-o", number).split()
        return dict(word.split("=", 1) for word in words if "=" in word)

    def stop(self) -> None:
        """Cancel all jobs and end all daemons and what jobs left running."""
        if "slurmctld" in self.daemons:
            self.call("scancel", "--user", str(os.getuid()))
            limit = time.monotonic() + 15
            while self.jobs() and time.monotonic() < limit:
                time.sleep(0.2)
        for name in [*self.names, "slurmctld", "munged"]:
            if name in self.daemons:
                self.kill(name, signal.SIGTERM)
        for pid in self._left_over():
            # it may have ended since
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _left_over(self) -> list[int]:
        """Processes that were started through this cluster and live on: a killed slurmd leaves its steps."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            try:
                environment = (process / "environ").read_bytes().split(b"\0")
            except OSError:
                continue
            if (
                f"SLURM_CONF={self.configuration}".encode() in environment
                and int(process.name) != os.getpid()
            ):
                found.append(int(process.name))
        return found
