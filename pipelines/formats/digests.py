"""The digest that a JSON record carries as its last key: SHA-256 of its text without that key and without white space.

It tells a record that was altered or damaged from one that was written so. It is no signature: who writes a record anew
can write its digest, too.
"""

import hashlib
import re

import msgspec

DIGEST_KEY = "record_sha256"

_LAST_KEY = re.compile(rf',"{DIGEST_KEY}":"([0-9a-f]{{64}})"\}}\Z'.encode())


def with_digest(content: bytes) -> bytes:
    """Return a JSON object as the content of a file: indented, with its digest as the last key."""
    text = msgspec.json.format(content, indent=-1)
    return msgspec.json.format(text[:-1] + f',"{DIGEST_KEY}":"{_digest(text)}"}}'.encode()) + b"\n"


def digest_holds(content: bytes) -> bool | None:
    """Return whether a JSON object agrees with the digest that it carries, None if it carries none.

    Raises
    ------
    msgspec.MsgspecError, RecursionError
        It is not JSON.
    """
    if DIGEST_KEY.encode() not in content:
        return None
    text = msgspec.json.format(content, indent=-1)
    last = _LAST_KEY.search(text)
    return last is not None and _digest(text[: last.start()] + b"}") == last[1].decode()


def _digest(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()
