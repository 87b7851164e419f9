"""A solve whose experiments run on workers of a Dask cluster."""

from __future__ import annotations

import os
import pickle
import platform
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kit.problem_files import run_command, write_problem
from kit.problems import (
    GUESS,
    bar_with_nuisance,
    cube_with_gaps,
    cube_with_nuisance,
    hung_cube,
    measured,
    noisy,
)

import collocation_sysid as cs
from collocation_sysid.common import cluster
from collocation_sysid.errors import InputError
from collocation_sysid.methods import experiment_executors
from collocation_sysid.methods.experiment_executors import DaskExecutor, connect_executor
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.methods.starts.initial_trajectories import simulate_trajectories
from collocation_sysid.program.collocation import Collocation

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")


@pytest.fixture
def there() -> Iterator[Any]:
    """Two workers with one thread each, in this process."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=":0"
    ) as found:
        yield found


def lose(there: Any, number: int) -> None:
    """Let a worker vanish without a word."""
    there.sync(there.workers[number].close, reason="lost", executor_wait=False, nanny=False)


def several(steps: int = 8) -> list[cs.Experiment]:
    """Recordings of two bodies, of one of them three."""
    cube = replace(noisy(hung_cube(steps), 1e-4), name="first")
    again = replace(noisy(hung_cube(steps + 3), 1e-4, seed=1), name="again", body=cube.body)
    nuisance = replace(noisy(cube_with_nuisance(steps), 1e-4), name="with nuisance")
    return [cube, again, replace(measured(cube_with_gaps(steps + 4)), name="gaps"), nuisance]


def assert_alike(clustered: cs.Solution, threads: cs.Solution) -> None:
    assert clustered.status is threads.status
    assert len(clustered.history) == len(threads.history)
    np.testing.assert_allclose(clustered.z, threads.z, rtol=1e-12, atol=1e-12)
    losses = [[line.loss for line in s.history] for s in (clustered, threads)]
    np.testing.assert_allclose(*losses, rtol=1e-10)
    assert clustered.notes == threads.notes


@pytest.mark.long
def test_a_run_on_workers_is_that_on_threads(there):
    problem = cs.Problem(several()[:3], GUESS, method=ReducedSpace())
    found, known = (
        cs.run(problem, scheduler=address, seek_causes=False)
        for address in (there.scheduler_address, None)
    )
    assert_alike(found.solution, known.solution)
    assert found.solution.timing.linear_algebra > 0
    errors = {
        n: e.statistical_std_error
        for n, e in known.estimates.items()
        if e.statistical_std_error is not None
    }
    assert errors.keys() >= {"lambda_pa", "mu_pa", "gamma_r_s"}
    for name, error in errors.items():
        assert found.estimates[name].statistical_std_error == pytest.approx(error, rel=1e-9)


@pytest.mark.long
def test_markers_without_places_are_read_in_the_same_elements(there):
    experiment = noisy(bar_with_nuisance())
    markers = replace(experiment.markers, located=np.zeros(len(experiment.markers.names), bool))
    collocation = Collocation([replace(experiment, markers=markers)], GUESS)
    with connect_executor(there.scheduler_address) as found:
        assert_alike(ReducedSpace()(collocation, workers=found), ReducedSpace()(collocation))


@pytest.mark.long
def test_the_size_of_a_returned_result_is_independent_of_the_recording(there, monkeypatch):
    sizes: list[int] = []

    def weighed(self: DaskExecutor, kept: Any) -> list[Any]:
        found = fetch(self, kept)
        sizes.append(len(pickle.dumps(found)))
        return found

    fetch = DaskExecutor.fetch
    monkeypatch.setattr(DaskExecutor, "fetch", weighed)
    most = []
    for steps in (12, 36):
        collocation = Collocation([noisy(hung_cube(steps))], GUESS)
        with connect_executor(there.scheduler_address) as found:
            ReducedSpace()(collocation, workers=found)
        *on_the_way, trajectories = sizes
        assert trajectories > collocation.variable_count * 8
        most.append(max(on_the_way))
        sizes.clear()
    assert most[1] < 1.02 * most[0] < 2000


@pytest.mark.long
def test_work_of_a_lost_worker_is_repeated(there):
    collocation = Collocation(several(), GUESS)

    def watch(line: Iteration) -> None:
        if line.number == 3:
            lose(there, 0)

    with connect_executor(there.scheduler_address) as found:
        solution = ReducedSpace()(collocation, watch, workers=found)
    assert len(there.scheduler.workers) == 1
    *notes, said = solution.notes
    assert said == (
        "1 of 2 workers were lost during the solve: their recordings were computed "
        "again by other workers"
    )
    assert_alike(replace(solution, notes=tuple(notes)), ReducedSpace()(collocation))


def assert_best_is_kept(solution: cs.Solution, why: str) -> None:
    """The answer is the last line of the history, simulated here."""
    assert solution.status is Status.CLUSTER_DISCONNECTED
    assert solution.message == f"{Status.CLUSTER_DISCONNECTED.sentence} {why}"
    assert solution.parameters == solution.history[-1].parameters
    collocation, z = solution.collocation, solution.z
    alike, failure = simulate_trajectories(collocation, collocation.unpack(z)[0])
    assert failure is None
    for part, x in zip(collocation.iterates(z), alike, strict=True):
        np.testing.assert_allclose(part.x, x, atol=1e-9)


@pytest.mark.long
def test_without_workers_left_the_best_is_kept(there, monkeypatch):
    monkeypatch.setattr(experiment_executors, "LOOK_EVERY_S", 0.2)

    def watch(line: Iteration) -> None:
        if line.number == 3:
            for number in (0, 1):
                lose(there, number)

    with connect_executor(there.scheduler_address) as found:
        solution = ReducedSpace()(Collocation(several(), GUESS), watch, workers=found)
    assert_best_is_kept(solution, "No worker is left.")


@pytest.mark.long
def test_without_a_scheduler_left_the_best_is_kept(there, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_WITHIN_S", 0.5)

    def watch(line: Iteration) -> None:
        if line.number == 3:
            there.sync(there.scheduler.close)

    with connect_executor(there.scheduler_address) as found:
        solution = ReducedSpace()(Collocation(several(), GUESS), watch, workers=found)
    with dask.config.set({"distributed.comm.timeouts.connect": "0.5s"}):
        there.close()  # which looks for the scheduler
    assert_best_is_kept(solution, "The scheduler no longer responds.")


FAULTS = """
import resource, threading
import numpy as np
from collocation_sysid.methods import experiment_executors

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        np.ones(2**17)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def compared():
    print(faults(), experiment_executors._run_alone(lambda: faults() and faults()))

thread = threading.Thread(target=compared)
thread.start()
thread.join()
"""


@pytest.mark.long
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_workers_keep_the_memory_of_arrays_that_come_and_go():
    """A nanny's processes give it back: each array of 1 MB then is 256 pages to be had anew."""
    environment = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
    said = subprocess.check_output([sys.executable, "-c", FAULTS], env=environment, text=True)
    before, after = map(int, said.split())
    assert before > 100 * 250
    assert after < 100


@pytest.mark.long
def test_an_interrupted_solve_keeps_its_best(there):
    lines: list[Iteration] = []

    def watch(line: Iteration) -> None:
        lines.append(line)
        if len(lines) == 3:
            raise KeyboardInterrupt

    with connect_executor(there.scheduler_address) as found:
        solution = ReducedSpace()(Collocation(several(), GUESS), watch, workers=found)
    assert solution.status is Status.INTERRUPTED
    assert solution.parameters == lines[-1].parameters
    assert np.isfinite(solution.z).all()


@pytest.fixture
def apart(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """The address of a scheduler, and its process before those of its two workers."""
    file, command = tmp_path / "scheduler.json", [sys.executable, "-m"]
    options = ["--scheduler-file", str(file), "--no-dashboard"]
    one = ["--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path)]
    commands = [
        [*command, "distributed.cli.dask_scheduler", "--port", "0", *options],
        *[[*command, "distributed.cli.dask_worker", *one, *options]] * 2,
    ]
    processes = [subprocess.Popen(each, stderr=subprocess.DEVNULL) for each in commands]
    try:
        with distributed.Client(scheduler_file=str(file), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            address = client.scheduler.address
        yield address, processes
    finally:
        for each in processes:
            each.kill()
            each.wait()


@pytest.mark.long
@pytest.mark.parametrize(
    ("ended", "status", "said"),
    [
        (slice(1, 2), Status.CONVERGED, "1 of 2 workers were lost during the solve"),
        (slice(1, 3), Status.CLUSTER_DISCONNECTED, "No worker is left."),
        (slice(0, 1), Status.CLUSTER_DISCONNECTED, "The scheduler no longer responds."),
    ],
    ids=["a worker", "all workers", "the scheduler"],
)
def test_killed_processes_cost_no_answer(apart, monkeypatch, ended, status, said):
    monkeypatch.setattr(experiment_executors, "LOOK_EVERY_S", 0.5)
    monkeypatch.setattr(cluster, "CONNECT_WITHIN_S", 2.0)
    address, processes = apart

    def watch(line: Iteration) -> None:
        if line.number == 3:
            for each in processes[ended]:
                each.kill()

    problem = cs.Problem(several()[:3], GUESS, method=ReducedSpace())
    run = cs.run(problem, watch=watch, scheduler=address, seek_causes=False)
    assert run.solution.status is status
    assert said in " ".join([run.solution.message, *run.solution.notes])
    known = cs.run(problem, seek_causes=False).solution
    line = known.history[len(run.solution.history) - 1]
    for name, value in run.solution.parameters.items():
        assert value == pytest.approx(line.parameters[name], rel=1e-8)


def test_workers_of_another_version_are_refused():
    answers = {"tcp://a:1": experiment_executors.package_version(), "tcp://b:1": "0.0.1"}
    client = SimpleNamespace(run=lambda *_, **__: answers)
    with pytest.raises(
        InputError, match=r"found collocation-sysid 0\.0\.1 on the worker tcp://b:1; expected"
    ):
        DaskExecutor(client)
    answers.clear()
    with pytest.raises(InputError, match="the scheduler has no workers"):
        DaskExecutor(client)


@pytest.mark.parametrize("error", [OSError, distributed.client.CancelledError])
def test_a_scheduler_lost_while_versions_are_asked_for_is_reported(monkeypatch, error):
    def lost(*_: object, **__: object) -> None:
        raise error("gone")

    client = SimpleNamespace(run=lost, close=lost)
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: client)
    with (
        pytest.raises(InputError, match="--scheduler: the scheduler stopped answering"),
        connect_executor("tcp://a:1"),
    ):
        pytest.fail("the work was started")


def test_costly_experiments_are_shared_out_first():
    threads = {"a": 1, "b": 1}
    assert experiment_executors._assign_workers([1, 5, 2, 3], threads) == ["a", "a", "b", "b"]
    assert experiment_executors._assign_workers([1, 1, 1], {"a": 2, "b": 1}) == ["a", "b", "a"]


# The command line


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("interior-point", "interior-point cannot distribute its experiments"),
        ("reduced-space", "found 'tcp://127.0.0.1:1', where no scheduler answers"),
    ],
)
def test_a_scheduler_that_is_of_no_use_ends_the_command(tmp_path, monkeypatch, method, said):
    monkeypatch.setattr(cluster, "CONNECT_WITHIN_S", 0.5)
    file = write_problem(tmp_path, {"swing": 8})
    options = ("--method", method, "--scheduler", "tcp://127.0.0.1:1", "--out", tmp_path / "run")
    outcome = run_command("solve", file, *options)
    assert outcome.code == 2
    assert said in " ".join(outcome.err.split())
    assert not (tmp_path / "run").exists()
