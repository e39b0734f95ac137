"""Raw Bayer frames of any size, the whole way: `python -m benchmarks.speed.full_frame --mpx 1 6 24 --prior tv auto`.

Frames of a picture on one plane are made by OpenCV's warp, without the operator that is measured; then `faintfield`
reconstructs them as a user would. Printed for each size and number of views, as a JSON object a line: seconds, CPU
seconds and peak memory of each command, and the time of its stages; that of its passes over that of reading the images
as often; then exponents of growth, with pixels and with views.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import pairwise, product
from operator import attrgetter
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from benchmarks.speed.passes import reading
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile, Noise, View, write_set
from faintfield.rig.plan import grid_nodes, nominal_poses_rt_cam_ref

_DEPTH_MM, _PITCH_MM = 3000.0, 50.0
_DISTORTION = (-0.08, 0.02)
_READ_NOISE_E, _GAIN_DN_PER_E, _OFFSET_DN = 3.0, 4.0, 512
_MOSAIC = ("RG", "GB")
_ASPECT = 1.5  # width over height

# The picture's light in electrons for each colour: about SNR 0.2.
_LIGHT_E = (0.6, 1.0, 0.5)


@dataclass(frozen=True)
class Cost:
    """Cost of a command.

    Attributes
    ----------
    mpx, views, name : float, int, str
        Megapixels of a frame, number of views, and the command.
    seconds, cpu_seconds : float
        Elapsed, and of all threads.
    peak_mb : float
        Largest resident memory, memory maps included.
    passes_over_reading : float
        Time of the passes over the data after the choice of the weight, over that in which all threads would read the
        images as often.
    stages : dict of str to list of float
        Seconds and CPU seconds of each stage.
    """

    mpx: float
    views: int
    name: str
    seconds: float
    cpu_seconds: float
    peak_mb: float
    passes_over_reading: float
    stages: dict[str, list[float]]


def make_set(folder: Path, mpx: float, views: int = 49, seed: int = 1) -> float:
    """Write frames and `elemental.toml`; return the bytes of the frames."""
    height = 16 * round((mpx * 1e6 / _ASPECT) ** 0.5 / 16)
    width = int(_ASPECT * height)
    focal_px, nodes = 1.25 * width, grid_nodes(7, 7)[:views]
    generator = np.random.default_rng(seed)
    poses = nominal_poses_rt_cam_ref(7, 7, _PITCH_MM)
    reference = views // 2
    errors = generator.normal(size=poses.shape) * np.repeat([0.002, 0.3], 3)
    errors[24] = 0
    poses = (poses + errors)[:views] - (poses + errors)[reference] * (views < 49)
    reference = 24 if views == 49 else reference
    picture, rays = _picture(height, width, generator), _rays(height, width, focal_px)
    (folder / "views").mkdir(parents=True)

    def write(view: int) -> None:
        frame = _frame(picture, rays, poses[view], focal_px, np.random.default_rng([seed, view]))
        tifffile.imwrite(folder / f"views/{view:02}.tiff", frame)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write, range(views)))
    camera = Camera(
        size_px=(width, height), fx_px=focal_px, fy_px=focal_px, cx_px=width / 2, cy_px=height / 2,
        distortion=_DISTORTION, mosaic=_MOSAIC,
    )  # fmt: skip
    listed = [
        View(image=f"views/{view:02}.tiff", rt_cam_ref=tuple(poses[view].tolist()), node=nodes[view])
        for view in range(views)
    ]
    noise = Noise(gain_dn_per_e=_GAIN_DN_PER_E, read_noise_e=_READ_NOISE_E, offset_dn=_OFFSET_DN, saturation_dn=16383)
    write_set(folder, ElementalSetFile(
        format=1, exposure_s=0.1, reference_view=reference, camera=camera, noise=noise, view=listed
    ))  # fmt: skip
    return float(2 * views * width * height)


def _picture(height: int, width: int, generator: np.random.Generator) -> NDArray[np.float32]:
    """Return discs and boxes of all sizes and colours, some shaded, from 0 to 1 (row, column, colour)."""
    picture = np.full((height, width, 3), 0.4, np.float32)
    for _ in range(500):
        size = height * 0.35 * generator.random() ** 3 + height / 300
        y, x = generator.random(2) * [height, width]
        colour, slope = generator.random(3), generator.normal(size=2) * 0.2 / size
        rows = slice(max(int(y - size), 0), min(int(y + size) + 1, height))
        columns = slice(max(int(x - size), 0), min(int(x + size) + 1, width))
        down, right = np.ogrid[rows, columns]
        inside = (down - y) ** 2 + (right - x) ** 2 < size**2 if generator.random() < 0.5 else np.ones((1, 1), bool)
        shade = np.clip(slope[0] * (down - y) + slope[1] * (right - x), -0.3, 0.3)[..., np.newaxis]
        part = picture[rows, columns]
        part[:] = np.where(inside[..., np.newaxis], np.clip(colour + shade, 0, 1), part)
    return picture * np.array(_LIGHT_E, np.float32)


def _rays(height: int, width: int, focal_px: float) -> NDArray[np.float32]:
    """Return the ray of each pixel (2, row, column) at unit depth: the radial distortion inverted in a table."""
    row, column = np.mgrid[:height, :width].astype(np.float32)
    x, y = (
        (column - np.float32(width / 2)) / np.float32(focal_px),
        (row - np.float32(height / 2)) / np.float32(focal_px),
    )
    undistorted = np.linspace(0, 0.8, 4001)
    distorted = undistorted * (1 + _DISTORTION[0] * undistorted**2 + _DISTORTION[1] * undistorted**4)
    radius = np.hypot(x, y)
    factor = np.interp(radius, distorted[1:], undistorted[1:] / distorted[1:]).astype(np.float32)
    return np.stack([x * factor, y * factor])


def _frame(
    picture: NDArray[np.float32],
    rays: NDArray[np.float32],
    pose: NDArray[np.float64],
    focal_px: float,
    generator: np.random.Generator,
) -> NDArray[np.uint16]:
    """Return one exposure of the plane, whose samples overlay the pixels of a reference view without distortion."""
    rotation, shift = cv2.Rodrigues(pose[:3])[0], pose[3:]
    to_plane = rotation.T @ np.eye(3)
    centre = -rotation.T @ shift
    # x = centre + t R' ray with z = depth
    x, y, z = (sum(to_plane[i, k] * (rays[k] if k < 2 else 1.0) for k in range(3)) for i in range(3))
    reach = (_DEPTH_MM - centre[2]) / z
    height, width = picture.shape[:2]
    scale = focal_px / _DEPTH_MM
    columns = ((centre[0] + reach * x) * scale + width / 2).astype(np.float32)
    rows = ((centre[1] + reach * y) * scale + height / 2).astype(np.float32)
    seen = cv2.remap(picture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    light = np.empty((height, width), np.float32)
    for row, letters in enumerate(_MOSAIC):
        for column, letter in enumerate(letters):
            light[row::2, column::2] = seen[row::2, column::2, "RGB".index(letter)]
    electrons = generator.poisson(light) + _READ_NOISE_E * generator.standard_normal(light.shape, np.float32)
    return np.clip(np.rint(electrons * _GAIN_DN_PER_E + _OFFSET_DN), 0, 16383).astype(np.uint16)


def run_command(arguments: list[str], stages: Path) -> tuple[float, float]:
    """Run a command of faintfield, write its stages, and return seconds and CPU seconds."""
    started = time.perf_counter()
    command = [sys.executable, "-m", "benchmarks.speed.stages", str(stages), *arguments]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise subprocess.CalledProcessError(process.returncode, arguments)
    return seconds, usage.ru_utime + usage.ru_stime


def bandwidth() -> float:
    """Return the bytes per second that all threads read together: the most in five readings of half a gigabyte."""
    images = np.ones(2**27, np.float32)
    read, times = reading(images), []
    for _ in range(6):
        started = time.perf_counter()
        read()
        times.append(time.perf_counter() - started)
    return images.nbytes / min(times[1:])


def costs(mpx: float, views: int, arguments: argparse.Namespace) -> Iterator[Cost]:
    """Make a set, reconstruct it, and yield what each command took."""
    speed = bandwidth()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        made, file = Path(folder) / "set", Path(folder) / "stages.json"
        frame_bytes = make_set(made, mpx, views)
        wanted = [str(_DEPTH_MM + 20.0 * n) for n in range(arguments.depths)]
        depths = [part for depth in wanted for part in ("--depth-mm", depth)]
        commands = {"back-projection": ["--depth-mm", wanted[0], "--method", "backprojection"]}
        commands |= {prior: [*depths, "--prior", prior] for prior in arguments.prior}
        for name, options in commands.items():
            out = Path(folder) / name
            measured = run_command(["reconstruct", str(made), *options, "--out", str(out)], file)
            inside = json.loads(file.read_text(encoding="utf-8"))
            found = {stage["name"]: stage for stage in inside["stages"]}
            stages = {stage: [round(s["seconds"], 2), round(s["cpu_seconds"], 2)] for stage, s in found.items()}
            # A pass reads one colour, on average a third of the frames, as float32 instead of their 16 bits
            read_s = found.get("passes", {}).get("calls", 0) * 2 * frame_bytes / 3 / speed
            yield Cost(
                mpx, views, name, *measured, inside["peak_mb"], stages["passes"][0] / read_s if read_s else 0.0, stages
            )


def exponents(costs: Sequence[Cost]) -> Iterator[dict[str, float | str]]:
    """Yield how CPU seconds grow from one size to the next, and from one number of views to the next."""
    for axis, fixed in (("mpx", "views"), ("views", "mpx")):
        alike: dict[tuple[str, float], list[Cost]] = {}
        for cost in sorted(costs, key=attrgetter(axis)):
            alike.setdefault((cost.name, getattr(cost, fixed)), []).append(cost)
        for (name, value), line in alike.items():
            for small, large in pairwise(line):
                least, most = getattr(small, axis), getattr(large, axis)
                exponent = math.log(large.cpu_seconds / small.cpu_seconds) / math.log(most / least)
                yield {"name": name, fixed: value, f"from_{axis}": least, f"to_{axis}": most, "exponent": exponent}


def main() -> None:
    """Print a line for each command, then exponents of growth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mpx", type=float, nargs="+", default=[1.0, 6.0, 24.0], help="megapixels of the detector")
    parser.add_argument("--views", type=int, nargs="+", default=[49], help="elemental images, at most 49")
    parser.add_argument("--depths", type=int, default=1, help="number of planes, 20 mm apart")
    parser.add_argument("--prior", nargs="+", default=["tv", "auto"], help="priors of PMLEM")
    parser.add_argument("--folder", type=Path, help="where frames are made, for the time of the run")
    arguments = parser.parse_args()
    done: list[Cost] = []
    for mpx, views in product(arguments.mpx, arguments.views):
        for cost in costs(mpx, views, arguments):
            print(json.dumps(asdict(cost)), flush=True)
            done.append(cost)
    for exponent in exponents(done):
        print(json.dumps(exponent))


if __name__ == "__main__":
    main()
