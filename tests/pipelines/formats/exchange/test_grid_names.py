"""Names of pictures: archives, patterns, running numbers; places that no name states are asked for."""

import re
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faintfield.calib.arrangement.views import Node
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.exchange.grid_names import by_number, places_by_habit, places_by_pattern
from faintfield.pipelines.formats.exchange.image_grid import measured_steps, nodes_of

NODES = [(row, column) for row in range(3) for column in range(4)]


def read(names: Sequence[str], pattern: str | None = None) -> list[Node]:
    """Return the nodes that names say."""
    return nodes_of(places_by_habit(names) if pattern is None else places_by_pattern(pattern, names))[0]


@pytest.mark.parametrize(
    "template",
    [
        "out_{r:02}_{c:02}_{y:.3f}_{x:.6f}_.png",
        "0123-row{r}-col{c}-v2.png",
        "x{c}_y{r}.bmp",
        "2024_05_01_{r}-{c}.png",
        "1.5mm_{r}_{c}_0.25s.png",
        "{n:04}_{r}_{c}.png",
    ],
)
def test_row_and_column_are_found_wherever_they_stand(template: str) -> None:
    names = [template.format(n=5 * c - r + 90, r=r, c=c, y=10.5 - 60 * r, x=-20.25 + 61 * c) for r, c in NODES]
    assert read(names) == NODES


def test_positions_alone_give_rows_and_columns() -> None:
    generator = np.random.default_rng(20261122)
    names = [
        f"IMG_{7000 + n}_{60 * r + y:.3f}_{-61 * c + x:.3f}.png"
        for n, ((r, c), (x, y)) in enumerate(zip(NODES, generator.uniform(-8, 8, (12, 2)), strict=True))
    ]
    assert read(names) == [(r, 3 - c) for r, c in NODES]


@given(
    first=st.integers(0, 10**6),
    side=st.integers(2, 12),
    width=st.integers(1, 8),
    text=st.sampled_from(["", "IMG_", "a-", "scene2024_"]),
)
def test_running_number_is_never_split_into_digits(first: int, side: int, width: int, text: str) -> None:
    names = [f"{text}{first + number:0{width}}.png" for number in range(side**2)]
    nodes, words = nodes_of(places_by_habit(names))
    assert nodes == [divmod(number, side) for number in range(side**2)]
    assert f"{side**2} pictures by one number; they are taken as {side} x {side}, row by row" in words


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([f"{n:04}.png" for n in range(1, 25)], "from 1 to 24, which is no square grid"),
        ([f"cam_0_{n}.png" for n in range(9)], "fits a grid of 1 x 9 as well as one of 3 x 3"),
        (["a.png", "b.png"], "a.png: its name has no row and column; give --rows and --columns"),
    ],
)
def test_missing_places_are_asked_for(names: list[str], words: str) -> None:
    with pytest.raises(BadValue, match=re.escape(words)):
        read(names)
    assert read([f"cam_0_{n}.png" for n in range(7)]) == [(0, n) for n in range(7)]
    assert read([f"cam_{n}_3.png" for n in range(7)]) == [(n, 3) for n in range(7)]


@pytest.mark.parametrize(
    ("pattern", "names", "nodes"),
    [
        ("{name}_{row}_{column}_{y}_{x}.png", ["s_7_3_4_-1.5_2e1.png", "_0_1_0_+7.png"], [(3, 4), (0, 1)]),
        ("{column}{name}x{row}", ["12abx3.png", "4x05.jpg"], [(3, 12), (5, 4)]),
        ("v{row:2}{column:2}*.png", ["v0112.png", "v1203_b.png"], [(1, 12), (12, 3)]),
        ("{index}_*", ["0_a.png", "1_b.png", "3_d.png", "2_c.png"], [(0, 0), (0, 1), (1, 1), (1, 0)]),
        ("p{x},{y}.png", ["p0,1.png", "p0,0.png", "p1.2,0.1.png", "p1,1.png"], [(1, 0), (0, 0), (0, 1), (1, 1)]),
    ],
)
def test_pattern_reads_names(pattern: str, names: list[str], nodes: list[Node]) -> None:
    assert read(names, pattern) == nodes


def test_positions_are_those_of_their_fields() -> None:
    places = places_by_pattern("{name}_{row}_{column}_{y}_{x}.png", ["s_7_3_4_-1.5_2e1.png"])
    assert places == {"row": [3], "column": [4], "y": [-1.5], "x": [20]}
    stanford = places_by_habit(["out_00_01_-381.909_1124.376_.png", "out_16_02_-777.25_1000.5.png"])
    assert stanford == {"row": [0, 16], "column": [1, 2], "y": [-381.909, -777.25], "x": [1124.376, 1000.5]}


def test_unfit_pattern_is_refused() -> None:
    for pattern, words in (
        ("{row}_{column}.tif", "1_2.png does not match it, 0 of 2 pictures do; correct the pattern"),
        ("{row}_*.png", "says neither {row} and {column}, nor {x} and {y}, nor {index}"),
        ("{row}_{row}.png", "{row} is no field, or is there twice; use each of {name}, {row}"),
    ):
        with pytest.raises(BadValue, match=re.escape(words)):
            read(["1_2.png", "1_34_5.png"], pattern)


PARTS = st.text(st.characters(exclude_categories=["N"], exclude_characters="{}"), min_size=1, max_size=3)


@settings(max_examples=25)
@given(st.text(max_size=12), PARTS)
def test_any_names_give_nodes_or_named_failure(text: str, parted: str) -> None:
    names = [f"{text}{row}{parted}{column}.png" for row, column in NODES]
    for pattern in (None, text, f"*{{row}}{parted}{{column}}.png"):
        try:
            assert len(read(names, pattern)) == len(names)
        except BadValue as failure:
            message = str(failure)
        else:
            continue
        assert text or pattern == ""
        assert re.search(r"give|correct|name them|use each|say which|leave", message)


def test_names_are_sorted_by_number() -> None:
    names = ["b1.png", "a10.png", "a9.png", "a09.png", "a.png", "10.png", "²3.png"]
    assert sorted(names, key=by_number) == ["10.png", "a09.png", "a9.png", "a10.png", "a.png", "b1.png", "²3.png"]


@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1)])
def test_measured_steps_are_true_in_any_directions(signs: tuple[int, int]) -> None:
    generator = np.random.default_rng(4)
    true = {(r, c): np.array([c, 1.5 * r]) + generator.uniform(-0.1, 0.1, 2) for r in range(5) for c in range(6)}
    stated = {node: tuple(np.array([1000.0, -3.0]) + 61.5 * place * signs) for node, place in true.items()}
    steps = measured_steps(stated)
    # The mean distance of columns is 1 by least squares, which the errors of the true ones change a little
    scale = np.polyfit([c for _, c in true], [place[0] for place in true.values()], 1)[0]
    for node, place in true.items():
        np.testing.assert_allclose(steps[node], (place - true[0, 0]) / scale, atol=1e-9)
    steps = measured_steps({(0, c): (10.0 * c, 0.3 * c % 0.7) for c in range(5)})
    np.testing.assert_allclose([steps[0, c] for c in range(5)], [(c, 0) for c in range(5)], atol=1e-12)


def test_positions_without_grid_are_refused() -> None:
    exchanged = {(r, c): (float(r), float(c)) for r in range(3) for c in range(3)}
    scattered = {(r, c): (float((5 * c + r) % 7), float((3 * r + c) % 5)) for r in range(3) for c in range(3)}
    for positions in (exchanged, scattered):
        with pytest.raises(BadValue, match=r"exchange \{x\} and \{y\} in --pattern, or put \* in their place"):
            measured_steps(positions)
