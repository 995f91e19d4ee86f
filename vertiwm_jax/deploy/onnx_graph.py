"""Records NumPy code as an ONNX graph, by running it once on arrays that note each operation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, checker, helper, numpy_helper

OPSET, IR_VERSION = 17, 8
"""Can be read by onnxruntime 1.13, which older robots have."""

_END = np.iinfo(np.int64).max
_OPERATORS = {
    np.add: "Add",
    np.subtract: "Sub",
    np.multiply: "Mul",
    np.divide: "Div",
    np.matmul: "MatMul",
    np.maximum: "Max",
    np.less: "Less",
    np.negative: "Neg",
    np.absolute: "Abs",
    np.tanh: "Tanh",
    np.exp: "Exp",
}


def record(function: Callable[[Any], Any], inputs: int, outputs: int) -> bytes:
    """Records a function of a float32 array as an ONNX model.

    Args:
        function: `[B, inputs]` to `[B, outputs]`, for any B. It may use only the NumPy functions
            that `Recorded` knows; others raise `TypeError`.
        inputs, outputs: numbers of columns.

    Returns:
        The serialized model, with the input `observation` and the output `action`.
    """
    graph = _Graph()
    result = graph.add("Identity", function(Recorded(graph, "observation")), output="action")

    def batch_of(name: str, size: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])

    ends = [batch_of("observation", inputs)], [batch_of(result.name, outputs)]
    made = helper.make_graph(graph.nodes, "policy", *ends, graph.constants)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(made, opset_imports=opset, ir_version=IR_VERSION)
    checker.check_model(model, full_check=True)
    return model.SerializeToString()


@dataclass
class _Graph:
    """Nodes in the order in which they are computed, and the constants that they read."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: list[onnx.TensorProto] = field(default_factory=list)

    def add(self, operator: str, *inputs: Any, output: str = "", **attributes: Any) -> "Recorded":
        """Adds a node and returns its result; inputs that are not `Recorded` become constants."""
        output = output or f"{operator.lower()}_{len(self.nodes)}"
        names = [self._name(x) for x in inputs]
        self.nodes.append(helper.make_node(operator, names, [output], **attributes))
        return Recorded(self, output)

    def _name(self, x: Any) -> str:
        if isinstance(x, Recorded):
            return x.name
        # Integers of NumPy are axes and places; all else is computed with.
        kind = np.int64 if getattr(x, "dtype", None) == np.int64 else np.float32
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(x, kind), name))
        return name


@dataclass(frozen=True, eq=False)
class Recorded(np.lib.mixins.NDArrayOperatorsMixin):
    """A float32 array whose values are not known yet; it has a name in the graph."""

    graph: _Graph
    name: str

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any) -> "Recorded":
        """Records an element-wise function."""
        floats = [_as_float(x) for x in inputs]
        if method != "__call__":
            return NotImplemented
        if ufunc in _OPERATORS:
            return self.graph.add(_OPERATORS[ufunc], *floats)
        if ufunc is np.square:
            return floats[0] * floats[0]
        if ufunc is np.arctan2:
            return self._arctan2(*floats)
        return NotImplemented

    def __array_function__(
        self, function: Callable, types: Any, args: Sequence[Any], kwargs: dict[str, Any]
    ) -> "Recorded":
        """Records a function of whole arrays."""
        return _FUNCTIONS[function](*args, **kwargs) if function in _FUNCTIONS else NotImplemented

    def __getitem__(self, key: tuple[slice | int | None, ...]) -> "Recorded":
        """Slices, numbers and new axes, from the first axis on."""
        x, axis = self, 0
        for part in key:
            if isinstance(part, int):
                x = self.graph.add("Gather", x, np.int64(part), axis=axis)
                continue
            if part is None:
                x = self.graph.add("Unsqueeze", x, np.array([axis]))
            elif part != slice(None):
                stop = _END if part.stop is None else part.stop
                bounds = [[part.start or 0], [stop], [axis], [part.step or 1]]
                x = self.graph.add("Slice", x, *(np.array(bound) for bound in bounds))
            axis += 1
        return x

    def _arctan2(self, y: "Recorded", x: "Recorded") -> "Recorded":
        """As `np.arctan2`, but for the sign of zero: where y is 0 and x negative, it is pi."""
        add = self.graph.add
        # ONNX has no arctan2. Where x is negative, the arctangent lacks half a turn.
        safe = add("Where", add("Equal", x, 0.0), 1e-30, x)
        half_turn = add("Where", add("Less", y, 0.0), -np.pi, np.pi)
        return add("Atan", y / safe) + add("Where", add("Less", x, 0.0), half_turn, 0.0)


def _as_float(x: Any) -> Any:
    return x if isinstance(x, Recorded) else np.asarray(x, np.float32)


def _max(x: Recorded, axis: int, keepdims: bool = False) -> Recorded:
    return x.graph.add("ReduceMax", x, axes=[axis], keepdims=int(keepdims))


def _sum(x: Recorded, axis: int, keepdims: bool = False) -> Recorded:
    return x.graph.add("ReduceSum", x, np.array([axis]), keepdims=int(keepdims))


_FUNCTIONS: dict[Callable, Callable[..., Recorded]] = {
    np.clip: lambda x, low, high: x.graph.add("Clip", x, low, high),
    np.concatenate: lambda arrays, axis: arrays[0].graph.add("Concat", *arrays, axis=axis),
    np.max: _max,
    np.reshape: lambda x, shape: x.graph.add("Reshape", x, np.array(shape)),
    np.sum: _sum,
    np.where: lambda condition, x, y: condition.graph.add("Where", condition, x, y),
}
