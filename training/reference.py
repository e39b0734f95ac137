"""The network in plain numpy: reference numbers for the test of the learned prior."""

import argparse
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from training.train import WIDTHS


def given_input(rows: int = 24, columns: int = 16) -> NDArray[np.float64]:
    """Return an input in closed form (4, row, column): waves of four lengths."""
    phase = np.arange(rows)[:, np.newaxis] * 0.7 + np.arange(columns) * 0.4
    return np.stack([np.sin(phase * (k + 1)) + 0.1 * k for k in range(4)])


def _convolved(x: NDArray[np.float64], weight: NDArray[np.float64], bias: NDArray[np.float64]) -> NDArray[np.float64]:
    rows, columns = x.shape[1:]
    around = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    total = np.zeros((len(weight), rows, columns)) + bias[:, np.newaxis, np.newaxis]
    for i in range(3):
        for j in range(3):
            total += np.einsum("oc,crs->ors", weight[:, :, i, j], around[:, i : i + rows, j : j + columns])
    return total


def network_output(weights: dict[str, NDArray[np.float64]], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the network's output (row, column), by sums over the nine places of each convolution."""

    def convolution(x: NDArray[np.float64], layer: str) -> NDArray[np.float64]:
        return _convolved(x, weights[f"{layer}.weight"], weights[f"{layer}.bias"])

    def stage(x: NDArray[np.float64], layer: str) -> NDArray[np.float64]:
        for part in ("first", "second"):
            x = np.maximum(convolution(x, f"{layer}.{part}"), 0)
        return x

    seen = []
    for level in range(len(WIDTHS)):
        if level:
            channels, rows, columns = x.shape
            x = x.reshape(channels, rows // 2, 2, columns // 2, 2).max(axis=(2, 4))
        x = stage(x, f"down.{level}")
        seen.append(x)
    for level in range(len(WIDTHS) - 1):
        x = stage(np.concatenate([x.repeat(2, axis=1).repeat(2, axis=2), seen[-2 - level]]), f"up.{level}")
    output = convolution(x, "last")
    return np.asarray(output[0])


def main() -> None:
    """Print the output at a few places for the input in closed form, and its mean."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("file", type=Path)
    constants = onnx.load(parser.parse_args().file).graph.initializer
    weights = {constant.name: numpy_helper.to_array(constant).astype(np.float64) for constant in constants}
    output = network_output(weights, given_input())
    for at in ((0, 0), (3, 5), (11, 15), (23, 8)):
        print(f"    {at}: {output[at]:.6f},")
    print(f"root mean square {np.sqrt(np.mean(output**2)):.6f}")


if __name__ == "__main__":
    main()
