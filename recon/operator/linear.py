"""H as a linear operator of scipy, on flat arrays, for the solvers of other packages."""

from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator

from faintfield.recon.operator.scene_operator import SceneOperator, ViewSelection


class FlatOperator(LinearOperator):
    """H of some views on flat arrays, whose elements are in C order; made by `linear_operator`.

    Attributes
    ----------
    dims, dimsd : tuple of int
        Shape of the samples and of the images, by the names that pylops reads.
    """

    def __init__(self, operator: SceneOperator, views: ViewSelection = None) -> None:
        self._operator, self._views = operator, None if views is None else operator.all_views[np.asarray(views)]
        if self._views is not None and len(np.unique(self._views)) < len(self._views):
            raise ValueError(f"views {self._views.tolist()}: each must be there once")
        count = operator.images_shape[0] if self._views is None else len(self._views)
        self.dims, self.dimsd = operator.samples_shape, (count, *operator.images_shape[1:])
        initialize: Any = super().__init__  # scipy's stubs do not declare the constructor for subclasses
        initialize(operator.dtype, (prod(self.dimsd), prod(self.dims)))

    def _matvec(self, x: NDArray[Any]) -> NDArray[Any]:
        return self._operator.forward(x.reshape(self.dims), self._views).ravel()

    def _rmatvec(self, y: NDArray[Any]) -> NDArray[Any]:
        images = y.reshape(self.dimsd)
        if self._views is not None:  # the adjoint takes all images, and reads those of the views
            images = np.zeros(self._operator.images_shape, self.dtype)
            images[self._views] = y.reshape(self.dimsd)
        return self._operator.adjoint(images, self._views).ravel()


def linear_operator(operator: SceneOperator, views: ViewSelection = None) -> FlatOperator:
    """Return H as a `scipy.sparse.linalg.LinearOperator`, which solvers of scipy and of other packages take.

    Its columns are the samples and its rows the pixels, both in C order: row, column, and view, row, column. Rows of
    pixels that do not count, or that see nothing, are zero. pylops takes it as it is, with the shapes of both sides.

    Parameters
    ----------
    operator : PlaneOperator, SceneOperator or SurfaceOperator
        H.
    views : sequence of int, optional
        The views whose pixels are the rows, in this order; all by default.

    Returns
    -------
    FlatOperator
        A linear operator of the dtype of `operator`, to which it converts what it is given. Its attributes `dims` and
        `dimsd` are the shapes of samples and images.

    Examples
    --------
    >>> import numpy as np
    >>> from faintfield import PlaneGrid, PlaneOperator, linear_operator
    >>> rays = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1)  # one pixel for each sample
    >>> H = linear_operator(PlaneOperator(np.eye(3)[np.newaxis], rays, PlaneGrid((3, 4), 1.0, (0.0, 0.0))))
    >>> H.shape, H.dims, H.dimsd
    ((12, 12), (3, 4), (1, 3, 4))
    >>> np.allclose(H @ np.eye(12), np.eye(12))
    True
    """
    return FlatOperator(operator, views)
