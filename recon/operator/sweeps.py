"""Sweeps over the detector pixels of all views: the one place where H meets a processor.

`recon.operator.scene_operator.SceneOperator` computes all that it returns by sweeps. Another processor, such as a GPU,
takes part by one class that satisfies `Sweeps`; `faintfield.testing.sweeps_contract` tells whether it does.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator import kernels
from faintfield.recon.operator.kernels import Hiding
from faintfield.recon.operator.placement import make_workspace
from faintfield.recon.threads import run_in_threads


class Sweep(NamedTuple):
    """One of the operations that `kernels.sweep` explains, on some views.

    Attributes
    ----------
    operation, views, image_of_view : int, int array (chosen view,), int array (view,)
        The operation; the views that are processed, each once; index of each view's image in `images` and
        `expected_images`.
    samples : float array (sample,) or of any shape with as many elements, optional
        The light of all planes; every operation but `ADJOINT` and `REACH` needs it.
    images, expected_images : float array (image, row, column), optional
        Images that `ADJOINT` and the operations that compare with data read; zeros, into which `FORWARD` writes
        H `samples`.
    pixels : PixelModel, optional
        Statistics of the pixels, for all operations that know of noise.
    seed : int
        Number of the draw of `NOISE`.
    """

    operation: int
    views: NDArray[np.intp]
    image_of_view: NDArray[np.intp]
    samples: Image | None = None
    images: Image | None = None
    expected_images: Image | None = None
    pixels: kernels.PixelModel | None = None
    seed: int = 0


class Sweeps(Protocol):
    """Sweeps over the pixels of views of one geometry.

    An implementation may copy the geometry and the hiding to memory of its own when it is made. It must not keep
    samples or images between calls: callers change them. Of the geometry it writes `reach` alone, in `kernels.REACH`.
    Without threads it ignores the number of workers.
    """

    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None: ...

    def run(self, sweep: Sweep) -> tuple[float, Image]:
        """Return the negative log-likelihood, of `VALUE` and `VALUE_AND_RATIO` alone, and what is added to the samples.

        The latter are (sample,), or of size 1 for operations that add nothing.
        """


class CompiledSweeps:
    """Sweeps by compiled threads: each takes some rows of all detectors and adds into samples of its own."""

    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None:
        self._geometry, self._hiding, self._workers = geometry, hiding, workers
        self._dtype = geometry.maps.dtype

    def run(self, sweep: Sweep) -> tuple[float, Image]:
        """Run the kernel in all threads; return the sums of their values and of their samples."""
        operation, views, image_of_view, samples, images, expected_images, pixels, seed = sweep
        nothing = _read_only(np.zeros(1, self._dtype))
        planes, data = (nothing if array is None else _read_only(array) for array in (samples, images))
        background, variance = (nothing, nothing) if pixels is None else map(_read_only, pixels[1:3])
        model = kernels.PixelModel(pixels.model if pixels else 0, background, variance, pixels.level if pixels else 0.0)
        size = 1 if operation in kernels.ONLY_READING else kernels.size_of(self._geometry)
        sums = [np.zeros(size, self._dtype) for _ in range(self._workers)]

        def work(worker: int) -> float:
            written = np.zeros(1, self._dtype) if expected_images is None else expected_images.reshape(-1)
            arrays = (planes, written, sums[worker], data, _read_only(image_of_view))
            space = make_workspace(len(self._geometry.layout), self._dtype)
            share = (_read_only(views), seed, worker, self._workers)
            return float(kernels.sweep(operation, *arrays, model, self._geometry, self._hiding, space, *share))

        values = run_in_threads(work, range(self._workers))
        for other in sums[1:]:
            sums[0] += other
        return sum(values), sums[0]


def _read_only[Number: np.generic](array: NDArray[Number]) -> NDArray[Number]:
    # To the compiler, arrays that can and cannot be written to are different types, and a memory map may be of either
    flat = array.reshape(-1)
    flat.flags.writeable = False
    return flat
