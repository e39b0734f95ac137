"""Noise of groups of pixels against single pixels."""

from typing import Literal

import numpy as np
import pytest

from faintfield.calib.noise import Conditions, measure_series
from faintfield.calib.noise.likelihood.moments import group_noise


@pytest.mark.parametrize("kind", ["dark", "flat"])
@pytest.mark.parametrize("blocks", [(3, 7), (3, 40)])
def test_groups_are_sums_over_their_pixels(kind: Literal["dark", "flat"], blocks: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    level = np.add.outer(np.linspace(100, 900, 41), np.linspace(0, 100, 30))
    frames = [(str(k), np.rint(rng.normal(level, 5)).astype(np.uint16)) for k in range(4)]
    series, used = measure_series(frames, Conditions(kind, 1.0)), rng.random((41, 30)) < 0.8
    noise = group_noise(series, used, 150.0, blocks)
    # Darks share one noise; that of a flat is straight between the nodes, and no pixel counts as darker than the floor
    variances = 25.0 if kind == "dark" else 3.0 + 0.1 * noise.nodes_dn
    expected = np.full((41, 30), 25.0) if kind == "dark" else 3.0 + 0.1 * np.maximum(series.mean_dn, 150.0)
    share = (used.sum() - sum(used.shape) + 1) / used.sum()
    for groups, shape in ((noise.blocks, blocks), (noise.rows, (41, 1)), (noise.columns, (1, 30))):
        ratio, freedom = noise.scatter(groups, variances)
        of_row, of_column = (np.arange(size) * count // size for size, count in zip(used.shape, shape, strict=True))
        expected_noise = []
        for row, column in np.ndindex(shape):
            inside = used & np.outer(of_row == row, of_column == column)
            if inside.sum() > 1:
                squares = series.within_dn2[inside].sum() / expected[inside].sum() / 3 / share
                expected_noise.append((squares, 3 * inside.sum() * share))
        np.testing.assert_allclose(np.stack([ratio, freedom], axis=1), expected_noise, rtol=1e-5)
