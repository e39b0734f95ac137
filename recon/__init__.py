"""Mathematics only: the operator, likelihoods, solvers, depth and metrics. No files, no cameras, no printing."""


def compile_kernels() -> None:
    """Compile what float32 reconstructions need, unless numba's cache beside the code holds it.

    Done once per installation, it saves the first reconstruction some seconds and 60 MB.
    """
    import numpy as np  # here, because importing the package should cost nothing

    from faintfield.recon.operator.grid import PlaneGrid
    from faintfield.recon.operator.plane_operator import PlaneOperator
    from faintfield.recon.prior.collaborative import collaborative_wiener
    from faintfield.recon.prior.evidence import Noise
    from faintfield.recon.solver.penalties import Penalty
    from faintfield.recon.solver.proximal import DualField

    ones = np.ones((2, 2), np.float32)
    PlaneOperator(np.eye(3)[np.newaxis], np.zeros((2, 2, 2)), PlaneGrid((2, 2), 1.0, (0.0, 0.0)))
    DualField.zero([(2, 2)], ones.dtype).prox(ones, ones, 1.0, Penalty(), lambda _: 0.0, 1)
    patch = np.ones((12, 12), np.float32)
    collaborative_wiener(patch, patch, Noise(patch, np.ones((3, 3))))
