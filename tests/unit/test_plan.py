from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coslidar.flows.plan import batch_windows
from coslidar.pipeline.parameters import BatchParameters

RATE = 100.0


def times(frames: int, dropped: tuple[int, ...] = (), jitter: int = 0) -> np.ndarray:
    time = 1_000_000_000_000 + np.arange(frames, dtype=np.int64) * 10_000_000
    if jitter:
        time = time + np.random.default_rng(0).integers(-jitter, jitter, frames)
    return np.delete(time, dropped)


def windows(time: np.ndarray, duration: str = "2 s", minimum: float = 0.5) -> list[tuple[int, int]]:
    found = batch_windows(time, RATE, BatchParameters(duration=duration, minimum=minimum))  # type: ignore[arg-type]
    assert [window.index for window in found] == list(range(len(found)))
    return [(window.start, window.stop) for window in found]


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        (400, [(0, 200), (200, 400)]),
        (500, [(0, 200), (200, 400), (400, 500)]),  # half a batch is one of its own
        (499, [(0, 200), (200, 400)]),  # less is left out
        (50, [(0, 50)]),  # unless it is all there is
        (200, [(0, 200)]),
        (201, [(0, 200)]),
    ],
)
def test_cuts(frames: int, expected: list[tuple[int, int]]) -> None:
    assert windows(times(frames)) == expected


def test_jitter_of_time_stamps_moves_no_frame_to_another_batch() -> None:
    assert windows(times(400, jitter=4_000_000)) == [(0, 200), (200, 400)]


def test_dropped_frames_do_not_shift_batches() -> None:
    assert windows(times(400, dropped=tuple(range(50, 80)))) == [(0, 170), (170, 370)]


def test_a_long_gap_leaves_batches_out() -> None:
    """Nothing was recorded in the second batch."""
    assert windows(times(600, dropped=tuple(range(200, 400)))) == [(0, 200), (200, 400)]


def test_bounds_in_time() -> None:
    (first, second) = batch_windows(times(400), RATE, BatchParameters(duration="2 s"))  # type: ignore[arg-type]
    assert first.start_time == 1_000_000_000_000
    assert first.stop_time == second.start_time == 1_002_000_000_000


@given(
    st.integers(2, 2000),
    st.sets(st.integers(1, 1999), max_size=300),
    st.floats(0.05, 30),
    st.floats(0, 1),
)
def test_batches_are_disjoint_and_in_order(frames: int, dropped: set[int], seconds: float, minimum: float) -> None:
    time = times(frames, tuple(frame for frame in dropped if frame < frames - 1))
    found = windows(time, f"{seconds} s", minimum)
    assert found
    assert found[0][0] == 0
    for (start, stop), (following, _) in zip(found, [*found[1:], (len(time), 0)], strict=True):
        assert start < stop <= following
