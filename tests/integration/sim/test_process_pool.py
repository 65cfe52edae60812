"""Pools of processes and their failures."""

import os
import subprocess
import sys

import psutil
import pytest

from embomatrix.sim.process_pool import process_pool, shared_work

SLEEPER = """
import os, time
from embomatrix.sim.process_pool import process_pool

if __name__ == "__main__":
    with process_pool(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        time.sleep(600)
"""


def test_pool_processes_die_with_their_killed_parent(tmp_path):
    program = tmp_path / "sleeper.py"
    program.write_text(SLEEPER)
    with subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, text=True) as parent:
        child = psutil.Process(int(parent.stdout.readline()))
        assert child.is_running()
        parent.kill()
    _, alive = psutil.wait_procs([child], timeout=30)
    assert alive == []


def test_work_runs_in_initialised_pool_processes(tmp_path):
    with process_pool(1, os.chdir, tmp_path) as pool:
        assert pool.submit(os.getcwd).result() == str(tmp_path)
        assert pool.submit(os.getpid).result() != os.getpid()


class Adder:
    """Pool job that adds a number and returns the sum with its process id."""

    def __init__(self, number):
        self.number = number

    def add(self, item):
        return self.number + item, os.getpid()

    def close(self):
        self.number = None


@pytest.mark.parametrize("jobs", [1, 2])
def test_shared_work_keeps_the_order_of_items(jobs):
    with shared_work(jobs, Adder, Adder.add, 10, died=RuntimeError()) as add:
        done = list(add(range(8)))
    assert [value for value, _ in done] == list(range(10, 18))
    assert (os.getpid() in {process for _, process in done}) is (jobs == 1)


class Mortal(Adder):
    def die(self, item):
        os._exit(item)


def test_death_of_a_pool_process_raises_the_callers_error():
    with (
        shared_work(2, Mortal, Mortal.die, 0, died=RuntimeError("fewer jobs")) as work,
        pytest.raises(RuntimeError, match="fewer jobs"),
    ):
        list(work(range(1, 5)))
