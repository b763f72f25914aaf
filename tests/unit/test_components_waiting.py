"""Looking before sleeping: when it is done, and that it gives way where it is in vain."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest

from exlinn_fmi.components import waiting
from exlinn_fmi.components.waiting import LONGEST_PAUSE, Waiter


class Looks:
    """A waiter on a pipe of its own, on a machine with some processors; counts looks by the clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, processors: int) -> None:
        monkeypatch.setattr(waiting, "_processors", lambda: processors)
        self.read, self.write = os.pipe()
        self.others, self.count, self.now = np.ones(1), 0, 0.0
        monkeypatch.setattr(waiting.time, "perf_counter", self.clock)
        self.waiter = Waiter(self.read, self.others)

    def clock(self) -> float:
        """A clock on which the time for looking is over after ten looks."""
        self.count += 1
        self.now += waiting.LOOKING / 10
        return self.now

    def looked(self) -> bool:
        """Whether the next wait, which is in vain, looks."""
        self.count = 0
        assert not self.waiter.wait(0.0)
        return self.count > 0


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Iterator[Looks]:
    made = Looks(monkeypatch, 2)
    yield made
    os.close(made.read)
    os.close(made.write)


def test_what_is_there_is_found_at_once(looks: Looks) -> None:
    os.write(looks.write, b"x")
    assert looks.waiter.look()
    assert looks.waiter.wait(1.0)


def test_a_pipe_that_is_closed_ends_the_wait(looks: Looks) -> None:
    os.close(looks.write)
    assert looks.waiter.look()
    looks.write = os.dup(looks.read)


def test_looking_ends_with_its_time(looks: Looks) -> None:
    assert not looks.waiter.look()
    assert 10 <= looks.count <= 13


def test_looking_in_vain_is_tried_ever_less_often(looks: Looks) -> None:
    tries = [k for k in range(2000) if looks.looked()]
    gaps = np.diff(tries)
    assert gaps[:7].tolist() == [2, 4, 8, 16, 32, 64, 128]
    assert set(gaps[8:]) == {LONGEST_PAUSE + 1}


def test_looking_that_pays_once_is_done_again(looks: Looks) -> None:
    while not looks.looked() or looks.waiter._pause < 60:
        pass
    os.write(looks.write, b"x")
    while not looks.waiter.look():  # the pause has to pass first
        pass
    os.read(looks.read, 1)
    assert looks.looked()


@pytest.mark.parametrize(
    ("processors", "others", "expected"), [(1, 1, False), (2, 1, True), (2, 2, False), (4, 3, True)]
)
def test_nobody_looks_where_a_processor_is_needed_for_work(
    monkeypatch: pytest.MonkeyPatch, processors: int, others: int, expected: bool
) -> None:
    looks = Looks(monkeypatch, processors)
    looks.others[0] = others
    assert looks.looked() == expected
    os.close(looks.read)
    os.close(looks.write)
