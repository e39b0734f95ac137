"""Threads, and those of BLAS meanwhile."""

from threadpoolctl import threadpool_info

from faintfield.recon.threads import map_in_threads


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_takes_one_thread_while_threads_work_and_as_many_as_before_afterwards() -> None:
    before = blas_threads()
    assert map_in_threads(lambda _: blas_threads(), range(4)) == [{1}] * 4
    assert blas_threads() == before
