"""The variants of the corpus: what each is, and whether its set is as rendered, or refused by which name."""

from collections.abc import Callable
from itertools import product

import numpy as np

from tests.calib.light_fields import Views
from tests.end_to_end.light_field_files import (
    COLUMNS,
    FILES,
    HCI,
    ROWS,
    Names,
    Variant,
    lettered,
    other_scene,
    positions_only,
    running,
    stanford,
)

# Aligned by so many px, the farthest, a middle, and the nearest thing stand nearly still.
FAR_PX, MIDDLE_PX, NEAR_PX = 1, 2, 4

_BACK = "names run back and forth"
IN_ONE_FILE = ("multi-page TIFF", "mosaic in one file")
SIZES = ("--rows", str(ROWS), "--columns", str(COLUMNS))


def _without(*nodes: tuple[int, int]) -> Callable[[Views], Views]:
    return lambda views: {node: view for node, view in views.items() if node not in nodes}


def _exposed(views: Views) -> Views:
    generator = np.random.default_rng(8)
    return {node: view * np.float32(generator.uniform(0.8, 1.2)) for node, view in views.items()}


def _every_second_column(views: Views) -> Views:
    return {(row, column // 2): view for (row, column), view in views.items() if column % 2 == 0}


def _at_first_and_last_row(row: int, column: int) -> bool:
    return row in (0, 4) or (row, column) == (2, 2)


def _first_and_last_row(views: Views) -> Views:
    return {node: view for node, view in views.items() if _at_first_and_last_row(*node)}


def _noise(views: Views) -> Views:
    generator = np.random.default_rng(4)
    return {node: generator.random(view.shape, np.float32) for node, view in views.items()}


def _shuffled(views: Views) -> Views:
    order = np.random.default_rng(6).permutation(len(views))
    pictures = list(views.values())
    return {node: pictures[index] for node, index in zip(views, order, strict=True)}


def _serpentine(line: int, place: int) -> str:
    return f"{line * COLUMNS + (place if line % 2 == 0 else COLUMNS - 1 - place):04}"


TURNS = {
    " ".join(words): Names(transpose="transposed" in words, flip_rows="rows" in words, flip_columns="columns" in words)
    for flags in product((False, True), repeat=3)
    if (words := [word for word, flag in zip(("transposed", "rows", "columns"), flags, strict=True) if flag])
}

_HCI_NAMES = running(COLUMNS, 0, "input_Cam{:03}")
_TAKE_NAMES = Names(lambda r, c: f"take3-{c:02}{r:02}-final")

CORPUS: dict[str, Variant] = {
    "as documented": Variant(),
    **{
        f"aligned by {aligned_px} px, numbers turned: {name}": Variant(names, aligned_px=aligned_px)
        for aligned_px in (0, FAR_PX, MIDDLE_PX, NEAR_PX)
        for name, names in TURNS.items()
    },
    "x and y": Variant(Names(lambda r, c: f"x{c}_y{r}")),
    "running numbers of a square, by column": Variant(Names(running(7), transpose=True), square=True),
    "running numbers by column": Variant(Names(running(ROWS), transpose=True), options=SIZES, aligned_px=MIDDLE_PX),
    "Stanford, columns reversed": Variant(Names(stanford, flip_columns=True), aligned_px=MIDDLE_PX),
    "Stanford, rows reversed": Variant(Names(stanford, flip_rows=True), aligned_px=NEAR_PX),
    "positions only": Variant(Names(positions_only), aligned_px=MIDDLE_PX),
    **{
        f"HCI, both reversed: {both}": Variant(
            Names(_HCI_NAMES, flip_rows=both, flip_columns=both), aligned_px=MIDDLE_PX, sidecars={"parameters.cfg": HCI}
        )
        for both in (False, True)
    },
    "a pattern, fields exchanged": Variant(
        _TAKE_NAMES, options=("--pattern", "{name}-{row:2}{column:2}-final.png"), aligned_px=MIDDLE_PX
    ),
    "three views missing": Variant(
        Names(flip_columns=True),
        change=_without((0, 0), (1, 5), (4, 2)),
        kept=lambda r, c: (r, c) not in ((0, 0), (1, 5), (4, 2)),
        aligned_px=MIDDLE_PX,
        words="missing",
    ),
    "exposures that differ": Variant(Names(flip_rows=True), aligned_px=MIDDLE_PX, change=_exposed),
    "every second column": Variant(change=_every_second_column, kept=lambda r, c: c % 2 == 0, ratio=2.0),
    "a view of another scene": Variant(
        aligned_px=MIDDLE_PX,
        change=lambda views: {**views, (2, 2): other_scene(70)},
        kept=lambda r, c: (r, c) != (2, 2),
        words="fit none of their neighbours, and are left out: view_r2_c2.png",
    ),
    **{
        f"back and forth {where}": Variant(names, square=square, options=options, aligned_px=MIDDLE_PX, words=_BACK)
        for where, names, square, options in (
            ("by row", Names(_serpentine, flip_columns=True), False, SIZES),
            ("by column", Names(_serpentine, transpose=True), True, ()),
            ("in rows and columns", Names(lambda r, c: lettered(r, 6 - c if r % 2 else c)), False, ()),
        )
    },
    "sizes exchanged": Variant(
        Names(running(COLUMNS)), options=("--rows", "7", "--columns", "5"), aligned_px=MIDDLE_PX
    ),
    "first and last row": Variant(change=_first_and_last_row, kept=_at_first_and_last_row, words="missing", ratio=0.5),
    **{
        f"files: {kind}": Variant(write=write, aligned_px=MIDDLE_PX, options=SIZES if kind in IN_ONE_FILE else ())
        for kind, write in FILES.items()
    },
}

# What no set can be made of, or none that is sure, with the name of the failure.
REFUSED: dict[str, tuple[str, Variant]] = {
    "noise": ("NotOneScene", Variant(change=_noise)),
    "two scenes": (
        "NotOneScene",
        Variant(
            aligned_px=MIDDLE_PX,
            change=lambda views: views | {node: _noise(views)[node] for node in views if node[1] > 3},
        ),
    ),
    "shuffled": ("ShuffledPictures", Variant(change=_shuffled, aligned_px=MIDDLE_PX)),
    "running numbers, no square": ("BadValue", Variant(Names(running(COLUMNS)))),
    "running numbers with a gap": ("BadValue", Variant(Names(running(7)), square=True, change=_without((3, 3)))),
}
