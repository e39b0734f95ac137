"""Simulated EMVA 1288 data sets, with the descriptor that the standard's own reference data come with."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray


@dataclass(frozen=True)
class EmvaCamera:
    """A camera as EMVA 1288 measures it: the exposure varies under one light, up to saturation.

    A charge of Q electrons makes the signal K Q (1 + bend Q / full_e); the offset drifts by a random walk.
    """

    gain_dn_per_e: float = 0.1
    read_noise_e: float = 30.0
    offset_dn: float = 60.0
    full_e: float = 40_000.0
    bend: float = -0.02
    bits: int = 12
    quantum_efficiency: float = 0.5
    dark_current_e_per_s: float = 1000.0
    dsnu_e: float = 5.0
    prnu: float = 0.005
    drift_dn: float = 0.0
    shape: tuple[int, int] = (128, 128)


def write_emva_set(
    folder: Path,
    camera: EmvaCamera,
    rng: np.random.Generator,
    levels: int = 50,
    many: int = 100,
    off: int | None = None,
) -> Path:
    """Write pairs of flats and darks at each exposure, `many` of each at half of saturation; return the descriptor.

    The series of index `off` has twice the noise that it should have.
    """
    (folder / "images").mkdir(parents=True)
    offset_dn = camera.offset_dn + camera.gain_dn_per_e * camera.dsnu_e * rng.standard_normal(camera.shape)
    response = 1 + camera.prnu * rng.standard_normal(camera.shape)
    walk_dn, lines, count = 0.0, ["# simulated", "v 4.0", f"n {camera.bits} {camera.shape[1]} {camera.shape[0]}"], 0

    def expose(charge_e: float, noisier: float) -> NDArray[np.uint16]:
        nonlocal walk_dn
        walk_dn += camera.drift_dn * rng.standard_normal()
        mean = charge_e * response
        charge = mean + noisier * (rng.poisson(mean) - mean + rng.normal(0, camera.read_noise_e, camera.shape))
        dn = camera.gain_dn_per_e * charge * (1 + camera.bend * charge / camera.full_e) + offset_dn + walk_dn
        return np.asarray(np.clip(np.rint(dn), 0, 2**camera.bits - 1), np.uint16)

    for index, share in enumerate(np.linspace(0.02, 1.1, levels)):
        exposure_ns, light_e = 2e7 * share, camera.full_e * share
        dark_e = camera.dark_current_e_per_s * exposure_ns * 1e-9
        frames = many if index == levels // 2 else 2
        photons = light_e / camera.quantum_efficiency
        for line, charge_e in (
            (f"b {exposure_ns:.1f} {photons:.3f}", light_e + dark_e),
            (f"d {exposure_ns:.1f}", dark_e),
        ):
            lines.append(line)
            for _ in range(frames):
                name = f"images/{count:05d}.tif"
                tifffile.imwrite(folder / name, expose(charge_e, 2.0 if index == off and line[0] == "b" else 1.0))
                lines.append("i " + name.replace("/", "\\"))
                count += 1
    path = folder / "descriptor.txt"
    path.write_text("\n".join(lines) + "\n")
    return path
