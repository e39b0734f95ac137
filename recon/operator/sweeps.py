"""Sweeps over the detector pixels of all views: the one place where H meets a processor.

`recon.operator.scene_operator.SceneOperator` computes all that it returns by sweeps. Another processor, such as a GPU,
takes part by one class that satisfies `Sweeps`; `faintfield.testing.sweeps_contract` tells whether it does.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator import kernels
from faintfield.recon.operator.kernels import Hiding
from faintfield.recon.operator.placement import make_workspace
from faintfield.recon.threads import run_in_threads


class Sweeps(Protocol):
    """Sweeps over the pixels of views of one geometry.

    An implementation may copy the geometry and the hiding to memory of its own when it is made. It must not keep
    samples or images between calls: callers change them. Of the geometry it writes `reach` alone, in `kernels.REACH`.
    Without threads it ignores the number of workers.
    """

    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None: ...

    def run(
        self,
        operation: int,
        views: NDArray[np.intp],
        image_of_view: NDArray[np.intp],
        *,
        samples: Image | None = None,
        images: Image | None = None,
        seen: Image | None = None,
        pixels: kernels.PixelModel | None = None,
    ) -> tuple[float, Image]:
        """Do one of the operations that `kernels.sweep` explains.

        Parameters
        ----------
        views, image_of_view : int array (chosen view,), int array (view,)
            The views that are processed, each once; index of each view's image in `images` and `seen`.
        samples : float array (sample,) or of any shape with as many elements, optional
            The light of all planes; every operation but `ADJOINT` and `REACH` needs it.
        images, seen : float array (image, row, column), optional
            Images that `ADJOINT` and the operations that compare with data read; zeros, into which `FORWARD` writes
            H `samples`.
        pixels : PixelModel, optional
            Statistics of the pixels, for operations that compare with data or take a precision.

        Returns
        -------
        value, sums : float, float array (sample,)
            The negative log-likelihood, of `VALUE` and `VALUE_AND_RATIO` alone; what the operation adds to the samples,
            of size 1 for those that add nothing.
        """


class CompiledSweeps:
    """Sweeps by compiled threads: each takes some rows of all detectors and adds into samples of its own."""

    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None:
        self._geometry, self._hiding, self._workers = geometry, hiding, workers
        self._dtype = geometry.maps.dtype

    def run(
        self,
        operation: int,
        views: NDArray[np.intp],
        image_of_view: NDArray[np.intp],
        *,
        samples: Image | None = None,
        images: Image | None = None,
        seen: Image | None = None,
        pixels: kernels.PixelModel | None = None,
    ) -> tuple[float, Image]:
        """Run the kernel in all threads; return the sums of their values and of their samples."""
        nothing = _read_only(np.zeros(1, self._dtype))
        planes, data = (nothing if array is None else _read_only(array) for array in (samples, images))
        background, variance = (nothing, nothing) if pixels is None else map(_read_only, pixels[1:3])
        model = kernels.PixelModel(pixels.model if pixels else 0, background, variance, pixels.level if pixels else 0.0)
        size = kernels.size_of(self._geometry) if operation in kernels.SCATTERING else 1
        sums = [np.zeros(size, self._dtype) for _ in range(self._workers)]

        def work(worker: int) -> float:
            written = np.zeros(1, self._dtype) if seen is None else seen.reshape(-1)
            arrays = (planes, written, sums[worker], data, _read_only(image_of_view))
            space = make_workspace(len(self._geometry.layout), self._dtype)
            share = (_read_only(views), worker, self._workers)
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
