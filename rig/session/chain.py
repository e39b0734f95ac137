"""Chain the rows of a journal by hashes, so that an edited, removed or reordered row is found.

Each link covers some rows of a table, in the order in which they were written over all tables:

    h = SHA-256(h of the link before, table, first row, last row, the rows)

with everything but h before encoded as MessagePack. There is no key: whoever can write the file can compute the chain
anew, or cut off its newest links with their rows.
"""

import hashlib
import sqlite3
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import msgspec

from faintfield.rig.errors import SessionCorrupt

# Hash before the first link.
START = bytes(32)

_CHAINED = ("event", "intent", "commit", "void", "traffic")


def add_rows(db: sqlite3.Connection, table: str, rows: Sequence[tuple[object, ...]]) -> int:
    """Insert rows with consecutive numbers into a table and a link over them; return the last number.

    Parameters
    ----------
    db : Connection
        Open database, within a transaction.
    table : str
        Name of the table.
    rows : sequence of tuple
        Values of all columns.
    """
    first, last = insert_rows(db, table, rows)
    # Read and not remembered: an interrupt may have come before the last commit was known to be done
    newest = db.execute("SELECT sha256 FROM chain ORDER BY id DESC LIMIT 1").fetchone()
    digest = _digest(db, newest[0] if newest else START, table, first, last)[0]
    db.execute("INSERT INTO chain VALUES (NULL, ?, ?, ?, ?)", (table, first, last, digest))
    return last


def insert_rows(db: sqlite3.Connection, table: str, rows: Sequence[tuple[object, ...]]) -> tuple[int, int]:
    """Insert rows into a table, and return the numbers of the first and the last."""
    insert = f'INSERT INTO "{table}" VALUES ({", ".join("?" * len(rows[0]))})'
    numbers = [db.execute(insert, row).lastrowid or 0 for row in rows]
    return numbers[0], numbers[-1]


def check_chain(db: sqlite3.Connection, path: Path) -> None:
    """Compute all links again.

    Raises
    ------
    SessionCorrupt
        A row, or a link, is not what was written.
    """
    head = START
    held = {table: db.execute(f'SELECT count(*) FROM "{table}"').fetchone()[0] for table in _CHAINED}
    covered: Counter[str] = Counter()
    links = db.execute('SELECT id, "table", first, last, sha256 FROM chain ORDER BY id')
    for expected, (number, table, first, last, stated) in enumerate(links, start=1):
        if number != expected or table not in _CHAINED:
            raise SessionCorrupt(f"{path}: link {expected} of its chain is missing; restore the journal from a copy")
        head, count = _digest(db, head, table, first, last)
        if head != stated:
            raise SessionCorrupt(
                f"{path}: row {first} of {table}, or one of those up to {last}, was changed, removed or added; restore "
                "the journal from a copy"
            )
        covered[table] += count
        if covered[table] > held[table]:  # at once: links that cover the same rows again and again would take for ever
            break
    for table in _CHAINED:
        if held[table] != covered[table]:
            raise SessionCorrupt(
                f"{path}: {table} has {held[table]} rows, its chain {covered[table]}; restore the journal from a copy"
            )


def _digest(db: sqlite3.Connection, previous: bytes, table: str, first: int, last: int) -> tuple[bytes, int]:
    """Return the hash of a link over the rows of a table as they are stored, and their number."""
    digest = hashlib.sha256(previous + msgspec.msgpack.encode((table, first, last)))
    count = 0
    for row in db.execute(f'SELECT * FROM "{table}" WHERE rowid BETWEEN ? AND ? ORDER BY rowid', (first, last)):
        digest.update(msgspec.msgpack.encode(row))
        count += 1
    return digest.digest(), count
