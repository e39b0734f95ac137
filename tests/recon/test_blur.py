"""The blur of pictures."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from faintfield.recon.blur import blurred


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 14), max_size=3))
def test_blur_is_scipys_convolution_with_repeated_edges(seed: int, spacings: list[int]) -> None:
    image = np.random.default_rng(seed).normal(size=(9, 12))
    expected = image
    for spacing in spacings:
        kernel = np.zeros(2 * spacing + 1)
        kernel[[0, spacing, -1]] = 0.25, 0.5, 0.25
        for axis in (0, 1):
            expected = ndimage.convolve1d(expected, kernel, axis=axis, mode="nearest")
    np.testing.assert_allclose(blurred(image, spacings), expected, atol=1e-14)
