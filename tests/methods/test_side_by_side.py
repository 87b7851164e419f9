"""Experiments on several threads give the same numbers for any number of threads."""

import threading
import time

import numpy as np
import pytest
from kit.memories import guesses, recorded, truth

from collocation_sysid import Collocation, ReducedSpace
from collocation_sysid.fem.kernels import concurrent_count, map_experiments, run_in_slices


def test_results_are_in_the_order_of_the_items():
    assert map_experiments(lambda k: k**2, range(7), threads=2) == [k**2 for k in range(7)]


def test_items_wait_for_each_other_only_with_enough_threads():
    both = threading.Barrier(2)
    map_experiments(lambda _: both.wait(timeout=10), range(2), threads=2)
    alone = map_experiments(lambda _: threading.current_thread(), range(2), threads=1)
    assert alone == [threading.current_thread()] * 2


def test_a_failure_of_one_is_raised():
    def fail(k: int) -> None:
        if k == 1:
            raise ValueError("the second")

    with pytest.raises(ValueError, match="the second"):
        map_experiments(fail, range(3), threads=2)


def test_an_item_shares_nothing_of_its_own_with_other_threads():
    def slices(_: int) -> tuple[list[tuple[int, int]], int]:
        seen: list[tuple[int, int]] = []
        run_in_slices(lambda a, b: seen.append((a, b)), 8, threads=4)
        return seen, concurrent_count(3, threads=4)

    assert map_experiments(slices, range(2), threads=2) == [([(0, 8)], 1)] * 2
    assert len(slices(0)[0]) == 4


def test_experiments_are_fitted_alike_on_any_number_of_threads(monkeypatch):
    recordings = [recorded(name, 8) for name in ("hung-cube", "cube-with-gaps", "hung-cube")]
    answers = []
    for threads in (1, 2):
        for recording in recordings:
            monkeypatch.setattr(recording.body, "threads", threads)
        collocation = Collocation(recordings, guesses(truth(1), 1.2))
        assert collocation.threads == threads
        answers.append(ReducedSpace(max_iterations=6)(collocation).z)
    assert np.array_equal(*answers)


def test_an_interrupt_ends_the_others_within_their_next_row():
    begun, rows = threading.Event(), []

    def run(k: int) -> None:
        if k == 0:
            begun.wait(timeout=10)
            raise KeyboardInterrupt
        for _ in range(1000):
            begun.set()
            run_in_slices(lambda *_, **__: rows.append(0), 1, 1)
            time.sleep(0.005)

    with pytest.raises(KeyboardInterrupt):
        map_experiments(run, range(2), threads=2)
    assert len(rows) < 900
    run_in_slices(lambda *_, **__: rows.append(-1), 1, 1)
    assert rows[-1] == -1
