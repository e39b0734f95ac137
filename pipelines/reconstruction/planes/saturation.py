"""Samples of a plane or surface that mostly saturated pixels see, and the uncertainty of the others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.results.records import PlaneRecord
from faintfield.pipelines.formats.results.surface import SurfaceChannel
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.likelihood.saturation import bias_of_selection, unknown_samples
from faintfield.recon.operator.scene_operator import SceneOperator

# Parts of a solution that tell nothing where no pixel that counts sees a sample.
_UNKNOWN_PARTS = ("plane", "sigma", "proposal", "moved")


@dataclass(frozen=True)
class PixelSelection:
    """Sensitivity (row, column) of a plane to the pixels that count, and to these and the saturated ones.

    `saturated_share` is the share of saturated pixels in all views of the colour.
    """

    counted: Image
    whole: Image
    saturated_share: float

    @classmethod
    def of(cls, operator: SceneOperator, whole: SceneOperator, images: ElementalImages) -> "PixelSelection":
        """Compare the operator of the pixels that count with the `whole` one."""
        assert images.valid is not None, "without saturated pixels there is no selection"
        return cls(operator.sensitivity(), whole.sensitivity(), 1 - float(images.valid.mean()))

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Samples whose pixels are mostly saturated."""
        return unknown_samples(self.counted, self.whole)

    def applied(self, arrays: Mapping[str, Image], known_e2: float) -> dict[str, Image]:
        """Return the parts of a solution, NaN where nothing is known of a sample.

        `known_e2` is the mean variance of a pixel without that of light. σ grows where some pixels are saturated:
        those that count are the darker ones.
        """
        found, unknown = dict(arrays), self.unknown
        if "sigma" in found:
            variance_e2 = np.maximum(found["plane"], 0) + known_e2
            bias_e = bias_of_selection(self.counted, self.whole) * np.sqrt(variance_e2)
            found["sigma"] = np.hypot(found["sigma"], bias_e)
        for name in _UNKNOWN_PARTS:
            if name in found:
                found[name] = np.where(unknown, np.float32(np.nan), found[name])
        return found

    @property
    def unknown_share(self) -> float:
        """Share of the samples that are unknown."""
        return float(self.unknown.mean())


def saturation_text(records: Sequence[PlaneRecord | SurfaceChannel]) -> str | None:
    """Return a message on saturated pixels, with the remedy; None without any."""
    saturated = max((record.saturated_share or 0.0 for record in records), default=0.0)
    if not saturated:
        return None
    unknown = max(record.unknown_share or 0.0 for record in records)
    seen = "are seen mostly by such pixels: NaN, hatched magenta in the pictures"
    samples = f"; up to {_percent(unknown)} of the samples {seen}" if unknown else ""
    return (
        f"{_percent(saturated)} of the pixels are saturated and do not count{samples}; "
        "use a shorter exposure, or several"
    )


def has_unknown(records: Sequence[PlaneRecord | SurfaceChannel]) -> bool:
    """Tell if some samples are seen mostly by saturated pixels, in any colour."""
    return any(record.unknown_share for record in records)


def _percent(share: float) -> str:
    """Return a share to two digits; that of one pixel is not zero."""
    return f"{100 * share:.2g}%"
