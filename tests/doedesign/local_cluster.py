"""A Dask scheduler with workers on this machine, for tests: on loopback only, and ended by themselves after a while."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).parent
# A test that fails must not leave processes behind: they end by themselves after this many seconds.
LIFETIME_S = 120


class Cluster:
    """A scheduler with as many workers as were asked for."""

    def __init__(self, folder: Path, allowed_failures: int = 3) -> None:
        self.folder, self.allowed_failures = folder, allowed_failures
        self.workers: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        self.scheduler = self._start(
            "scheduler", "--port", "0", "--scheduler-file", str(file), "--idle-timeout", f"{LIFETIME_S} s"
        )
        self._wait(lambda: file.exists() and file.stat().st_size > 0)
        self.address = json.loads(file.read_text())["address"]

    def _start(self, kind: str, *arguments: str) -> subprocess.Popen[bytes]:
        allowed = str(self.allowed_failures)
        paths = os.pathsep.join([str(HERE), str(HERE.parents[1])])  # the fakes, and the packages under test
        settings = {"PYTHONPATH": paths, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": allowed}
        command = [sys.executable, "-m", "dask", kind, "--host", "127.0.0.1", "--no-dashboard", *arguments]
        with open(self.folder / f"{kind}{len(self.workers)}.log", "wb") as log:
            return subprocess.Popen(command, env={**os.environ, **settings}, stdout=log, stderr=log, cwd=self.folder)

    def _wait(self, ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 30
        while not ready():
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def hire(self) -> subprocess.Popen[bytes]:
        options = ("--nthreads", "1", "--no-nanny", "--memory-limit", "0", "--lifetime", f"{LIFETIME_S} s")
        self.workers.append(self._start("worker", self.address, *options, "--death-timeout", "30"))
        return self.workers[-1]

    def staff(self, count: int) -> list[subprocess.Popen[bytes]]:
        """So many workers that live."""
        self.workers = [worker for worker in self.workers if worker.poll() is None]
        while len(self.workers) < count:
            self.hire()
        return self.workers[:count]

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()
