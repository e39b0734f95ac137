"""All planes of a scene together, in one channel: g = Σ_z H_z f_z + b."""

from collections.abc import Mapping

from pipelines.channels import OperatorFactory
from pipelines.planes import Settings, Solution, certified, mean_e
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
    operator = factory.of_scene(grids)
    iterate, record = certified(PosedScene(operator, images), settings)
    planes = operator.planes_of(iterate.plane)
    return {
        depth: Solution(plane, record | {"mean_e": mean_e(plane)}) for depth, plane in zip(grids, planes, strict=True)
    }
