"""Items read ahead: in order, and few at a time."""

import pytest

from faintfield.pipelines.formats.frames import read_ahead


def test_items_come_in_order_and_few_wait() -> None:
    begun: list[int] = []
    waiting: list[int] = []
    items: list[tuple[int, int]] = []

    def read(item: int) -> int:
        begun.append(item)
        waiting.append(len(begun) - len(items))
        return item**2

    for item, content in read_ahead(range(50), read, workers=3):
        items.append((item, content))
    assert items == [(item, item**2) for item in range(50)]
    assert max(waiting) <= 4


def test_a_failure_comes_in_its_turn() -> None:
    def read(item: int) -> float:
        return 1 / (item - 3)

    items = read_ahead(range(9), read)
    assert [next(items)[0] for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ZeroDivisionError):
        next(items)
