"""Work side by side: in order, in the caller's context, at the same time, and what fails is raised."""

import threading
import time
from contextvars import ContextVar

import pytest

from jaxsid import parallel
from jaxsid.parallel import cores, side_by_side

WHERE: ContextVar[str] = ContextVar("where", default="nowhere")


@pytest.fixture(params=[1, 3])
def workers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(parallel, "cores", lambda: request.param)
    return request.param


def test_results_come_in_the_order_of_the_items(workers: int):
    assert side_by_side(lambda x: x**2, range(20)) == [x**2 for x in range(20)]
    assert side_by_side(lambda x: x, []) == []


def test_the_context_of_the_caller_is_seen_and_left_alone(workers: int):
    def seen(name: str) -> str:
        before = WHERE.get()
        WHERE.set(name)
        return before

    token = WHERE.set("here")
    try:
        assert side_by_side(seen, ["a", "b", "c"]) == ["here"] * 3
        assert WHERE.get() == "here"
    finally:
        WHERE.reset(token)


def test_as_many_at_a_time_as_there_are_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(parallel, "cores", lambda: 3)
    together = threading.Barrier(3)  # breaks unless three are there at once
    assert side_by_side(lambda x: together.wait(timeout=30) >= 0 and x, [1, 2, 3]) == [1, 2, 3]


@pytest.mark.parametrize(("pieces", "within"), [(1, 4), (2, 2), (3, 1), (4, 1)])
def test_work_within_work_has_the_cores_that_are_left(pieces, within, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(parallel, "cores", lambda: 4)
    most: list[int] = []

    def work(_: int) -> None:
        at_once, now, lock = [0], 0, threading.Lock()

        def part(_: int) -> None:
            nonlocal now
            with lock:
                now += 1
                at_once.append(now)
            time.sleep(0.05)
            with lock:
                now -= 1

        side_by_side(part, range(8))
        most.append(max(at_once))

    side_by_side(work, range(pieces))
    assert most == [within] * pieces


def test_what_fails_is_raised_and_what_has_not_begun_is_left(workers: int):
    begun: list[int] = []

    def fails(x: int) -> None:
        begun.append(x)
        raise ValueError(f"no {x}")

    with pytest.raises(ValueError, match="no 0"):
        side_by_side(fails, range(1000))
    assert len(begun) < 1000


def test_a_process_has_a_core():
    assert cores() >= 1
