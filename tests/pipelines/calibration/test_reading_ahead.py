"""Items read ahead: in order, and few at a time."""

import threading

import pytest

from faintfield.pipelines.calibration.reading_ahead import read_ahead


def test_items_come_in_order_and_few_wait() -> None:
    begun, consumed, lock, most = 0, 0, threading.Lock(), 0

    def read(item: int) -> int:
        nonlocal begun, most
        with lock:
            begun += 1
            most = max(most, begun - consumed)
        return item**2

    items = []
    for item, content in read_ahead(range(50), read, workers=3):
        with lock:
            consumed += 1
        items.append((item, content))
    assert items == [(item, item**2) for item in range(50)]
    assert most <= 4


def test_a_failure_comes_in_its_turn() -> None:
    def read(item: int) -> float:
        return 1 / (item - 3)

    items = read_ahead(range(9), read)
    assert [next(items)[0] for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ZeroDivisionError):
        next(items)
