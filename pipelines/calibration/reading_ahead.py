"""Items read in threads, a few ahead of their turn, so that memory holds few of them."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor


def read_ahead[Item, Content](
    items: Iterable[Item], read: Callable[[Item], Content], workers: int = 2
) -> Iterator[tuple[Item, Content]]:
    """Yield each item with what `read` makes of it, in order; at most `workers` wait to be taken."""
    waiting: list[tuple[Item, Future[Content]]] = []
    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                if len(waiting) == workers:
                    first, content = waiting.pop(0)
                    yield first, content.result()
                waiting.append((item, pool.submit(read, item)))
            while waiting:
                first, content = waiting.pop(0)
                yield first, content.result()
        finally:
            for _, content in waiting:
                content.cancel()
