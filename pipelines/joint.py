"""All planes of a scene together, in one channel: g = Σ_z H_z f_z + b."""

from collections.abc import Mapping

from pipelines.channels import OperatorFactory
from pipelines.planes import Settings, Solution, certified
from recon.images import ElementalImages
from recon.plane import PlaneGrid
from recon.posed import PosedScene


def solve_joint(
    factory: OperatorFactory, images: ElementalImages, grids: Mapping[float, PlaneGrid], settings: Settings
) -> dict[float, Solution]:
    """Reconstruct all planes of one channel together, so that none has to explain the light of the others.

    Parameters
    ----------
    grids : mapping of float to PlaneGrid
        The samples at each depth in mm.

    Returns
    -------
    mapping of float to Solution
        By depth. All records tell of the one iteration: its penalty weight, passes, objective and certificate.
    """
    solutions = certified(PosedScene(factory.of_scene(grids), images), settings)
    return dict(zip(grids, solutions, strict=True))
