"""What :mod:`pemviz.stl.lanes` says in the words of numba's compiler: eight doubles in a register.

Importing this teaches them to numba, and fails without it.
"""

# ruff: noqa: ARG001, PLR0917 (numba asks with these arguments)

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import binding, ir
from numba import extending
from numba.core import cgutils, types
from numba.extending import models, overload, register_model

from pemviz.stl import lanes

REGISTER = ir.VectorType(ir.DoubleType(), lanes.LANES)
FLAGS = ir.VectorType(ir.IntType(1), lanes.LANES)
NUMBER = ir.IntType(32)
PLACE = ir.IntType(64)

PACKS = binding.llvm_version_info[0] >= 19
"""Whether LLVM can pack lanes by itself."""

intrinsic: Any = extending.intrinsic
"""Of what is decorated, compiled code has what ``emit`` emits."""


class Lanes(types.Type):
    """The type of eight doubles."""


LANES = Lanes(name="Lanes")


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):
    """How they are held."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, REGISTER)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, first: Any) -> Any:
    """To where lanes begin in an array in one piece."""
    start = cgutils.create_struct_proxy(kind)(context, builder, array).data
    return builder.gep(start, [first])


def _write(builder: Any, register: Any, pointer: Any) -> None:
    builder.store(register, builder.bitcast(pointer, REGISTER.as_pointer())).align = 8


@intrinsic
def _filled(typing: Any, value: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        nothing = ir.Constant(REGISTER, ir.Undefined)
        first = builder.insert_element(nothing, given[0], NUMBER(0))
        places = ir.Constant(ir.VectorType(NUMBER, lanes.LANES), [0] * lanes.LANES)
        return builder.shuffle_vector(first, nothing, places)

    return LANES(types.float64), emit


@intrinsic
def _loaded(typing: Any, values: Any, first: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        pointer = _pointer(context, builder, values, *given)
        register = builder.load(builder.bitcast(pointer, REGISTER.as_pointer()))
        register.align = 8
        return register

    return LANES(values, types.int64), emit


@intrinsic
def _store(typing: Any, eight: Any, values: Any, first: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        _write(builder, given[0], _pointer(context, builder, values, *given[1:]))
        return context.get_dummy_value()

    return types.void(LANES, values, types.int64), emit


@intrinsic
def _smaller(typing: Any, left: Any, right: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        left, right = given
        return builder.select(builder.fcmp_ordered("<", right, left), right, left)

    return LANES(LANES, LANES), emit


def packing(by_itself: bool) -> Any:
    """The intrinsic of `lanes.pack`; ``by_itself``: whether LLVM packs."""

    @intrinsic
    def pack(typing: Any, eight: Any, keys: Any, edge: Any, values: Any, first: Any) -> Any:
        def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            register, key, limit, array, place = given
            kept = builder.fcmp_ordered("<=", key, limit)
            pointer = _pointer(context, builder, values, array, place)
            if not by_itself:
                return builder.add(place, _write_each(builder, register, kept, pointer))
            _write(builder, _compressed(builder, register, kept), pointer)
            return builder.add(place, _count(builder, kept))

        return types.int64(LANES, LANES, LANES, values, types.int64), emit

    return pack


_pack = packing(PACKS)


def _compressed(builder: Any, register: Any, kept: Any) -> Any:
    kind = ir.FunctionType(REGISTER, [REGISTER, FLAGS, REGISTER])
    name = f"llvm.experimental.vector.compress.v{lanes.LANES}f64"
    compress = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(compress, [register, kept, ir.Constant(REGISTER, ir.Undefined)])


def _count(builder: Any, kept: Any) -> Any:
    flags = builder.bitcast(kept, ir.IntType(lanes.LANES))
    return builder.zext(builder.ctpop(flags), PLACE)


def _write_each(builder: Any, register: Any, kept: Any, pointer: Any) -> Any:
    """One by one, each where the next one goes too if it is not kept; how many are kept."""
    count = PLACE(0)
    for lane in range(lanes.LANES):
        value = builder.extract_element(register, NUMBER(lane))
        builder.store(value, builder.gep(pointer, [count]))
        flag = builder.extract_element(kept, NUMBER(lane))
        count = builder.add(count, builder.zext(flag, PLACE))
    return count


# Words of the language above, and what stands where compiled code has them. The names and types of
# arguments must be the same outside and inside, for numba compares them.


@overload(lanes.filled)
def _found_filled(value: Any) -> Any:
    def call(value: Any) -> Any:
        return _filled(value)

    return call


@overload(lanes.loaded)
def _found_loaded(values: Any, first: Any) -> Any:
    def call(values: Any, first: Any) -> Any:
        return _loaded(values, first)

    return call


@overload(lanes.store)
def _found_store(eight: Any, values: Any, first: Any) -> Any:
    def call(eight: Any, values: Any, first: Any) -> Any:
        return _store(eight, values, first)

    return call


@overload(lanes.smaller)
def _found_smaller(left: Any, right: Any) -> Any:
    def call(left: Any, right: Any) -> Any:
        return _smaller(left, right)

    return call


@overload(lanes.pack)
def _found_pack(eight: Any, keys: Any, edge: Any, values: Any, first: Any) -> Any:
    def call(eight: Any, keys: Any, edge: Any, values: Any, first: Any) -> Any:
        return _pack(eight, keys, edge, values, first)

    return call


def _teach(operation: Callable[..., Any], instruction: str) -> None:
    """That ``operation`` on lanes is LLVM's ``instruction``."""

    @intrinsic
    def apply(typing: Any, left: Any, right: Any) -> Any:
        def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            return getattr(builder, instruction)(*given)

        return LANES(LANES, LANES), emit

    def found(left: Any, right: Any) -> Any:
        def call(left: Any, right: Any) -> Any:
            return apply(left, right)

        return call if left is LANES and right is LANES else None

    overload(operation)(found)


_teach(operator.add, "fadd")
_teach(operator.sub, "fsub")
_teach(operator.mul, "fmul")
_teach(operator.truediv, "fdiv")
