"""A few lines over onnx.helper: name each node's result and collect the nodes of one graph."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper


class Nodes:
    """The nodes of one graph in order. Every method that adds a node returns the name of its result."""

    def __init__(self, prefix: str = "") -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._scope = prefix

    @contextmanager
    def scope(self, name: str) -> Iterator[None]:
        """Results named within carry this prefix, so that one formula can be written out several times."""
        outer, self._scope = self._scope, f"{self._scope}{name}/"
        yield
        self._scope = outer

    def constant(self, name: str, value: ArrayLike, dtype: type[np.generic] = np.float64) -> str:
        """A constant tensor, float64 unless told."""
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype=dtype), self._scope + name))
        return self._scope + name

    def add(self, operator: str, inputs: list[str], name: str) -> str:
        """One node with one result."""
        output = self._scope + name
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output))
        return output

    def concat(self, inputs: list[str], name: str) -> str:
        """The inputs (fans, ...) side by side."""
        output = self._scope + name
        self.nodes.append(helper.make_node("Concat", inputs, [output], name=output, axis=1))
        return output

    def slice(self, source: str, axis: int, start: int, stop: int, name: str) -> str:
        """source[start:stop] along one axis."""
        bounds = [
            self.constant(f"{name}_{part}", [value], np.int64)
            for part, value in (("start", start), ("stop", stop), ("axis", axis))
        ]
        return self.add("Slice", [source, *bounds], name)


def double(name: str, shape: list[str | int]) -> onnx.ValueInfoProto:
    """A float64 input or output; a name in the shape is a dynamic axis."""
    return helper.make_tensor_value_info(name, TensorProto.DOUBLE, shape)
