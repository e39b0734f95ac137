"""Threads, and those of BLAS meanwhile."""

import numpy as np
from threadpoolctl import threadpool_info

from faintfield.recon.threads import elementwise, map_in_threads, run_in_threads, strips, summed


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_takes_one_thread_while_threads_work_and_as_many_as_before_afterwards() -> None:
    before = blas_threads()
    assert map_in_threads(lambda _: blas_threads(), range(4)) == [{1}] * 4
    assert blas_threads() == before


def test_parts_make_up_the_whole_in_their_order() -> None:
    values = np.arange(300_000.0).reshape(100, 3000)
    np.testing.assert_array_equal(elementwise(lambda x, y: x - 2 * y, values, values[::-1]), values - 2 * values[::-1])
    assert elementwise(np.add, values[:0], values[:0]).shape == (0, 3000)
    kept = values.copy()
    assert elementwise(np.negative, values, out=values) is values
    np.testing.assert_array_equal(values, -kept)
    assert summed(lambda x: x.sum(), kept) == kept.sum()
    assert [stop - first for first, stop in strips(kept)] == [100 // len(strips(kept))] * len(strips(kept))


def test_work_of_threads_may_call_threads() -> None:
    values = np.ones(300_000)

    def work(number: int) -> float:
        return float(sum(run_in_threads(lambda part: number + part, range(3))) + summed(np.sum, values))

    assert map_in_threads(work, range(8)) == [3 * number + 3 + 300_000 for number in range(8)]
    assert run_in_threads(work, range(3)) == [300_003, 300_006, 300_009]
