"""Train the network on pairs: a U-Net of three levels that predicts what the patch estimate still lacks."""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from faintfield.pipelines.reconstruction.planes.learned_prior import network_input

# Channels of the levels, each at half the resolution of the one before.
WIDTHS = (16, 32, 64, 64)

_CROP, _BATCH, _RATE, _DECAY, _AVERAGE = 96, 8, 2.5e-3, 1e-4, 0.995

# Added to a picture's mean square error when its loss is divided by that error, in units of the noise: what is nearly
# perfect weighs little.
_FLOOR = 0.01

# Weight of samples that show no light, beside one of those that do, and the light that counts, relative to the most.
_DARK_WEIGHT, _LIT = 0.25, 0.08

# Steps after which pairs that were added are read.
_READ_AGAIN = 1000

# Part of the training in half precision, which is faster.
_HALF_PRECISION = 0.8


class Stage(nn.Module):
    """Two convolutions, each with a rectifier."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the stage's channels."""
        return torch.relu(self.second(torch.relu(self.first(x))))


class PlanePrior(nn.Module):
    """The network: (batch, 4, row, column) to (batch, 1, row, column); rows and columns are multiples of eight."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.ModuleList(Stage(a, b) for a, b in zip((4, *WIDTHS), WIDTHS, strict=False))
        self.up = nn.ModuleList(Stage(a + b, b) for a, b in zip(WIDTHS[:0:-1], WIDTHS[-2::-1], strict=True))
        self.last = nn.Conv2d(WIDTHS[0], 1, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return the change of the patch estimate in units of the noise."""
        seen = []
        for level, stage in enumerate(self.down):
            x = stage(nn.functional.max_pool2d(x, 2) if level else x)
            seen.append(x)
        seen.pop()
        for stage in self.up:
            x = stage(torch.cat([nn.functional.interpolate(x, scale_factor=2, mode="nearest"), seen.pop()], 1))
        return self.last(x)


@dataclass(frozen=True)
class Pairs:
    """Planes in units of the noise.

    Attributes
    ----------
    inputs : float32 array (plane, 4, row, column)
        What the network sees.
    wanted : float32 array (plane, row, column)
        What it should say.
    weights : float32 array (plane, row, column)
        How much each sample counts, one on average.
    errors : float32 array (plane,)
        Weighted mean of the square of `wanted`, which the patch estimate leaves.
    kinds : list of str
        What was drawn.
    """

    inputs: NDArray[np.float32]
    wanted: NDArray[np.float32]
    weights: NDArray[np.float32]
    errors: NDArray[np.float32]
    kinds: list[str]

    @classmethod
    def read(cls, folder: Path) -> "Pairs":
        """Read all pairs of a folder."""
        inputs, wanted, weights, kinds = [], [], [], []
        for file in sorted(folder.glob("*.npz")):
            with np.load(file) as stored:
                y, u, p, deviation, truth = stored["channels"]
                kinds.append(str(stored["kind"]))
            given, filled = network_input(y, u, p, np.square(deviation))
            inputs.append(given)
            seen = np.isfinite(deviation)
            wanted.append(np.where(seen, (truth - p) / filled, 0))
            lit = cv2.dilate((truth > _LIT * truth.max()).astype(np.float32), np.ones((7, 7)))
            weight = seen * (_DARK_WEIGHT + (1 - _DARK_WEIGHT) * lit)
            weights.append(weight / weight.mean())
        residuals, shares = np.stack(wanted).astype(np.float32), np.stack(weights).astype(np.float32)
        errors = np.mean(shares * np.square(residuals), axis=(1, 2))
        return cls(np.stack(inputs).astype(np.float32), residuals, shares, errors, kinds)


def batch(pairs: Pairs, random: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return crops of pairs, turned and mirrored at random: inputs, wanted, weights, and the errors of their planes."""
    crops = []
    chosen = random.integers(len(pairs.errors), size=_BATCH)
    for index in chosen:
        top, left = (random.integers(0, length - _CROP + 1) for length in pairs.wanted.shape[1:])
        at = (index, slice(top, top + _CROP), slice(left, left + _CROP))
        crop = np.concatenate(
            [pairs.inputs[index][:, *at[1:]], pairs.wanted[at][np.newaxis], pairs.weights[at][np.newaxis]]
        )
        crop = np.rot90(crop, random.integers(4), (1, 2))
        crops.append(crop[:, :, ::-1] if random.random() < 0.5 else crop)
    stacked = torch.from_numpy(np.stack(crops))
    return stacked[:, :4], stacked[:, 4:5], stacked[:, 5:], torch.from_numpy(pairs.errors[chosen])


def ratios(network: nn.Module, pairs: Pairs) -> NDArray[np.float64]:
    """Return the network's mean square error of each plane, relative to that of the patch estimate."""
    found = []
    with torch.no_grad():
        for index, error in enumerate(pairs.errors):
            said = network(torch.from_numpy(pairs.inputs[index : index + 1]))[0, 0].numpy()
            found.append(np.mean(pairs.weights[index] * np.square(said - pairs.wanted[index])) / error)
    return np.array(found)


def train(folder: Path, checked: Pairs, minutes: float, steps: int, seed: int, start: Path | None, path: Path) -> None:
    """Train for a number of steps, but no longer than some minutes, and save the weights' running average."""
    torch.manual_seed(seed)
    random = np.random.default_rng(seed)
    network = PlanePrior()
    if start is not None:
        network.load_state_dict(torch.load(start))
    network = network.to(memory_format=torch.channels_last)
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(_AVERAGE)
    )
    optimiser = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=_DECAY)
    began, losses = time.monotonic(), []
    for step in range(steps):
        done = max(step / steps, (time.monotonic() - began) / (60 * minutes))
        if done >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = _RATE * min(1, (step + 1) / 100) * (0.5 + 0.5 * np.cos(np.pi * done))
        if step % _READ_AGAIN == 0:
            pairs = Pairs.read(folder)
        given, wanted, weights, errors = batch(pairs, random)
        with torch.autocast("cpu", torch.bfloat16, enabled=done < _HALF_PRECISION):
            said = network(given.to(memory_format=torch.channels_last)).float()
        squares = (weights * (said - wanted).square()).mean((1, 2, 3))
        loss = (squares / (errors + _FLOOR)).mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        average.update_parameters(network)
        losses.append(loss.item())
        if step % 250 == 249:
            found = ratios(average.module, checked)
            print(
                step + 1,
                f"{len(pairs.errors)} pairs {done:.2f} loss {np.mean(losses[-250:]):.3f} checked {found.mean():.3f}",
                flush=True,
            )
            torch.save(average.module.state_dict(), path)
    torch.save(average.module.state_dict(), path)
    found = ratios(average.module, checked)
    for kind in sorted(set(checked.kinds)):
        print(kind, np.round(found[[k == kind for k in checked.kinds]], 2).tolist())
    print("all", found.mean(), flush=True)


def main() -> None:
    """Train on the pairs of one folder, tell the errors on those of another, and write the weights."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("pairs", type=Path)
    parser.add_argument("checked", type=Path)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--minutes", type=float, default=600.0)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", type=Path, help="weights to start from")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(sum(w.numel() for w in PlanePrior().parameters()), "weights", flush=True)
    train(
        options.pairs,
        Pairs.read(options.checked),
        options.minutes,
        options.steps,
        options.seed,
        options.start,
        options.weights,
    )


if __name__ == "__main__":
    main()
