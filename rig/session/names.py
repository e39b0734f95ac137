"""Decide which names found in a file may be joined to a folder."""

# Leaves room for what is appended to a name: file systems allow 255 bytes.
MAX_NAME_LENGTH = 200


def is_plain_name(name: str) -> bool:
    """Return whether `name` is that of a file in the very folder it is joined to.

    It has no separator, is not `.` or `..`, not empty, not longer than `MAX_NAME_LENGTH`, and contains printable ASCII
    characters only, as all names that faintfield makes do.
    """
    return (
        0 < len(name) <= MAX_NAME_LENGTH
        and name.isascii()
        and name.isprintable()
        and not {"/", "\\"} & set(name)
        and name.strip(".") != ""
    )
