"""Errors of an operator: parts that do not fit together, missing views, arrays of the wrong shape."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator

GOOD: dict[str, Any] = {
    "plane_from_ray": np.stack([np.eye(3)] * 2),
    "rays": np.zeros((2, 3, 4, 2)),
    "grid": PlaneGrid((5, 5), 1.0, (-2.0, -2.0)),
    "lattice_of_view": np.array([0, 1]),
}


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"plane_from_ray": np.eye(3)}, "do not fit"),
        ({"rays": np.zeros((2, 3, 4, 3))}, "do not fit"),
        ({"flat": np.ones((3, 3, 4))}, "flat"),
        ({"valid": np.zeros((1, 3, 4), bool)}, "valid"),
        ({"lattice_of_view": np.array([0, 2])}, "lattice_of_view"),
        ({"plane_from_ray": np.full((2, 3, 3), np.nan)}, "not a finite number"),
        ({"grid": PlaneGrid((5, 5), 1.0, (50.0, 0.0))}, "no pixel of any of the 2 views"),
    ],
)
def test_parts_that_do_not_fit_are_refused(bad: dict[str, Any], words: str) -> None:
    assert PlaneOperator(**GOOD).sensitivity().sum() == 24
    with pytest.raises(GeometryMismatch, match=words):
        PlaneOperator(**{**GOOD, **bad})


@pytest.mark.parametrize("views", [[-1], [0, 0], [True, False]])
def test_missing_and_repeated_views_are_refused(views: Any) -> None:
    operator = PlaneOperator(**GOOD)
    uses: list[Callable[[], Image]] = [
        lambda: operator.forward(np.ones((5, 5)), views),
        lambda: operator.adjoint(np.ones((2, 3, 4)), views),
        lambda: operator.sensitivity(views),
        lambda: operator.adjoint_of_ratio(np.ones((5, 5)), ElementalImages(np.ones((2, 3, 4))), views),
    ]
    for use in uses:
        with pytest.raises(ValueError, match="views must"):
            use()


def test_planes_images_and_maps_of_another_shape_are_refused() -> None:
    operator = PlaneOperator(**GOOD)
    plane, images = np.ones((5, 5)), np.ones((2, 3, 4))
    uses: list[Callable[[], Image]] = [
        lambda: operator.forward(images[0]),
        lambda: operator.adjoint(images[:1]),
        lambda: operator.adjoint_of_map(plane),
        lambda: operator.adjoint_of_ratio(images[0], ElementalImages(images)),
        lambda: operator.adjoint_of_ratio(plane, ElementalImages(images[:1])),
        lambda: operator.adjoint_of_ratio(plane, ElementalImages(images, background_e=plane)),
    ]
    for use in uses:
        with pytest.raises(GeometryMismatch, match="shape"):
            use()
