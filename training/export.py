"""Write trained weights as an ONNX file, and check OpenCV's answers against the trained network's."""

import argparse
import hashlib
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from training.train import WIDTHS, PlanePrior

_OPSET, _TOLERANCE = 13, 1e-4
_SIZES = ((8, 8), (64, 48), (200, 304), (352, 352))


class _Graph:
    """An ONNX graph that grows node by node; methods return the name of what they add."""

    def __init__(self, weights: dict[str, torch.Tensor]) -> None:
        self._weights = weights
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def add(self, kind: str, *inputs: str, **attributes: object) -> str:
        """Add a node of one output."""
        name = f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], name, **attributes))
        return name

    def constant(self, name: str, value: NDArray[np.float32]) -> str:
        """Add a constant."""
        self.constants.append(numpy_helper.from_array(value, name))
        return name

    def convolution(self, x: str, layer: str) -> str:
        """Add a convolution of three by three with the weights of a layer."""
        named = [
            self.constant(f"{layer}.{part}", self._weights[f"{layer}.{part}"].numpy()) for part in ("weight", "bias")
        ]
        return self.add("Conv", x, *named, kernel_shape=[3, 3], pads=[1, 1, 1, 1])

    def stage(self, x: str, layer: str) -> str:
        """Add two convolutions, each with a rectifier."""
        for part in ("first", "second"):
            x = self.add("Relu", self.convolution(x, f"{layer}.{part}"))
        return x


def onnx_model(weights: dict[str, torch.Tensor]) -> onnx.ModelProto:
    """Return the network as an ONNX model of any size of picture."""
    graph = _Graph(weights)
    scales = graph.constant("twice", np.array([1, 1, 2, 2], np.float32))
    x, seen = "input", []
    for level in range(len(WIDTHS)):
        x = graph.add("MaxPool", x, kernel_shape=[2, 2], strides=[2, 2]) if level else x
        x = graph.stage(x, f"down.{level}")
        seen.append(x)
    seen.pop()
    for level in range(len(WIDTHS) - 1):
        x = graph.add(
            "Resize", x, "", scales, mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor"
        )
        x = graph.stage(graph.add("Concat", x, seen.pop(), axis=1), f"up.{level}")
    last = graph.convolution(x, "last")
    ends = [
        helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, channels, "rows", "columns"])
        for name, channels in (("input", 4), (last, 1))
    ]
    made = helper.make_graph(graph.nodes, "plane_prior", ends[:1], ends[1:], graph.constants)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model


def largest_difference(path: Path, network: PlanePrior) -> float:
    """Return the largest difference of OpenCV's answers from the network's over several sizes."""
    random, found = np.random.default_rng(0), 0.0
    read = cv2.dnn.readNetFromONNX(np.frombuffer(path.read_bytes(), np.uint8))
    for size in _SIZES:
        given = random.normal(size=(1, 4, *size)).astype(np.float32)
        read.setInput(given)
        with torch.no_grad():
            wanted = network(torch.from_numpy(given)).numpy()
        found = max(found, float(np.abs(read.forward() - wanted).max()))
    return found


def main() -> None:
    """Export weights, check the file, and print its SHA-256."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("weights", type=Path)
    parser.add_argument("file", type=Path)
    options = parser.parse_args()
    network = PlanePrior()
    network.load_state_dict(torch.load(options.weights))
    options.file.parent.mkdir(parents=True, exist_ok=True)
    options.file.write_bytes(onnx_model(network.state_dict()).SerializeToString())
    difference = largest_difference(options.file, network)
    if difference > _TOLERANCE:
        raise SystemExit(f"OpenCV's answers differ by {difference:g}: at most {_TOLERANCE:g}; change the layers")
    digest = hashlib.sha256(options.file.read_bytes()).hexdigest()
    print(f"{options.file} {options.file.stat().st_size} bytes, OpenCV differs by {difference:.1g}, SHA-256 {digest}")


if __name__ == "__main__":
    main()
