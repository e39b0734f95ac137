"""Pictures of a plane from groups of alike patches: candidates for what is proposed in place of the penalty's plane."""

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.collaborative import Patches, collaborative_wiener, wiener_and_thresholded
from faintfield.recon.prior.evidence import Evidence, evidence_of_planes

# Large patches average most of the noise away, small ones keep what is seen once. Chosen on photographs.
_LARGE = Patches(size=8, step=6, radius=16, members=64)
_SMALL = Patches(size=4, step=3, radius=8, members=32)


def patch_candidates(evidence: Evidence) -> dict[str, Image]:
    """Return pictures (row, column) of a plane by name, all as blurred as the evidence, in electrons.

    "tv" is the pilot, the plane that the penalty gave; "wiener" the collaborative Wiener filter with this pilot;
    "twice" the filter again, its pilot the mean of the first result and of the groups that keep what stands out of the
    noise, which shows what the penalty lost; "fine" the same with small patches, whose pilot is "twice" and the small
    groups that keep. A plane smaller than a patch has its pilot only. Patches are alike if they are so in the sum of
    the pilot and of what other colours show.
    """
    picture, pilot, noise, _, other_colours = evidence

    def guide(pilot: Image) -> Image:
        return pilot if other_colours is None else pilot + other_colours

    found = {"tv": pilot}
    if min(pilot.shape) >= _LARGE.size:
        wiener, thresholded = wiener_and_thresholded(picture, pilot, noise, _LARGE, guide=guide(pilot))
        found["wiener"] = wiener
        better = (wiener + thresholded) / 2
        found["twice"] = collaborative_wiener(picture, better, noise, _LARGE, guide=guide(better))
        _, thresholded = wiener_and_thresholded(picture, pilot, noise, _SMALL, guide=guide(pilot))
        better = (found["twice"] + thresholded) / 2
        found["fine"] = collaborative_wiener(picture, better, noise, _SMALL, guide=guide(better))
    return found


def refined(operator: SceneOperator, images: ElementalImages, plane: Image) -> Image:
    """Return a picture with the detail that its penalty removed: `( f + w − u )₊`.

    u is the back-projection of H f, as blurred as that of the data, y; and w is y filtered with u as its pilot.

    Parameters
    ----------
    operator : SceneOperator
        H of one plane or surface.
    images : ElementalImages
        The data.
    plane : float array (row, column)
        f ≥ 0, in electrons.
    """
    (evidence,) = evidence_of_planes(operator, images, plane)
    w = collaborative_wiener(evidence.picture, evidence.pilot, evidence.noise)
    return np.maximum(plane + (w - evidence.pilot).astype(plane.dtype), 0)
