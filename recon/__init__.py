"""Mathematics only: the operator, likelihoods, solvers, depth and metrics. No files, no cameras, no printing."""


def compile_kernels(*dtypes: str) -> None:
    """Compile the kernels of planes and surfaces, unless numba's cache beside the code holds them.

    Done once per installation, it saves the first reconstruction some seconds and 60 MB.

    Parameters
    ----------
    *dtypes : {"float32", "float64"}
        Types of the samples; float32, which all commands use, by default.
    """
    import numpy as np  # here, because importing the package should cost nothing

    from faintfield.recon.operator.grid import PlaneGrid
    from faintfield.recon.operator.single_plane import PlaneOperator
    from faintfield.recon.operator.surface_operator import SurfaceOperator
    from faintfield.recon.prior.collaborative import collaborative_wiener
    from faintfield.recon.prior.evidence import Noise
    from faintfield.recon.solver.penalties import Penalty
    from faintfield.recon.solver.proximal import DualField
    from faintfield.recon.solver.proximal_kernels import squared_distance
    from faintfield.recon.surface.edges import moved_edges
    from faintfield.recon.surface.estimate import estimate_surface
    from faintfield.recon.surface.pinhole_views import PinholeViews

    small, grid, ray_from_surface = np.zeros((2, 2, 2)), PlaneGrid((2, 2), 1.0, (0.0, 0.0)), np.eye(3, 4)[np.newaxis]
    for name in dtypes or ("float32",):
        dtype = np.dtype(name).type
        ones = np.ones((2, 2), dtype)
        PlaneOperator(np.eye(3)[np.newaxis], small, grid, dtype=dtype)
        SurfaceOperator(ray_from_surface, small, grid, np.ones((2, 2)), dtype=dtype)
        DualField.zero([(2, 2)], ones.dtype).prox(ones, ones, 1.0, Penalty(), lambda _: 0.0, 1)
        squared_distance(ones.ravel(), ones.ravel(), ones.ravel())
    patch = np.ones((12, 12), np.float32)
    collaborative_wiener(patch, patch, Noise(patch, np.ones((3, 3))))
    light, frame = np.ones((9, 12, 12), np.float32), PlaneGrid((12, 12), 1.0, (-6.0, -6.0))
    nodes = np.argwhere(np.ones((3, 3)))
    views = PinholeViews(light, 1.0, np.repeat(ray_from_surface, 9, axis=0), (1.0, 1.0), (6.0, 6.0), frame, nodes)
    estimate_surface(views, np.linspace(1.0, 2.0, 8))
    moved_edges(5 * np.tri(12, dtype=np.float32), np.ones((12, 12, 8), np.float32), patch)
