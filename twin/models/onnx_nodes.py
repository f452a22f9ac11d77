"""A few lines over onnx.helper: name each node's result and collect the nodes of one graph."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper


class Nodes:
    """The nodes of one graph in order. Every method that adds a node returns the name of its result, or names."""

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
        """A constant tensor, float64 by default."""
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype=dtype), self._scope + name))
        return self._scope + name

    def add(self, operator: str, inputs: list[str], name: str, **attributes: Any) -> str:
        """One node with one result."""
        output = self._scope + name
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def rows(self, columns: str, names: list[str], name: str) -> list[str]:
        """Each column of (fans, len(names)) as a row (1, fans)."""
        turned = self.add("Transpose", [columns], name, perm=[1, 0])
        outputs = [self._scope + row for row in names]
        self.nodes.append(helper.make_node("Split", [turned], outputs, name=f"{turned}_rows", axis=0))
        return outputs

    def slice(self, source: str, axis: int, start: int, stop: int, name: str) -> str:
        """source[start:stop] along one axis."""
        bounds = [
            self.constant(f"{name}_{part}", [value], np.int64)
            for part, value in (("start", start), ("stop", stop), ("axis", axis))
        ]
        return self.add("Slice", [source, *bounds], name)

    def scan(
        self, body: onnx.GraphProto, states: list[str], sequences: list[str], finals: list[str], output: str
    ) -> None:
        """Run body along the first axis of the sequences.

        Its inputs are the states, then one entry of each sequence. Its outputs are the states after it, whose last
        ones are the finals, and one entry of the output.
        """
        self.nodes.append(
            helper.make_node(
                "Scan",
                [*states, *sequences],
                [*finals, output],
                name="free_run",
                body=body,
                num_scan_inputs=len(sequences),
            )
        )


def double(name: str, shape: list[str | int]) -> onnx.ValueInfoProto:
    """A float64 input or output; a name in the shape is a dynamic axis."""
    return helper.make_tensor_value_info(name, TensorProto.DOUBLE, shape)
