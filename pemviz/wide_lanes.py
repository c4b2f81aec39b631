"""What :mod:`pemviz.lanes` says in the words of numba's compiler: eight doubles in a register.

Importing this teaches them to numba, and fails without it.
"""

# ruff: noqa: ARG001, PLR0917 (numba asks with these arguments)

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import binding, ir
from numba import extending
from numba.core import cgutils, types
from numba.core.registry import cpu_target
from numba.extending import models, overload, register_model

from pemviz import lanes

REGISTER = ir.VectorType(ir.DoubleType(), lanes.LANES)
FLAGS = ir.VectorType(ir.IntType(1), lanes.LANES)
FLAGS_TOGETHER = ir.IntType(lanes.LANES)
NUMBER = ir.IntType(32)
PLACE = ir.IntType(64)
MEMORY = types.CPointer(types.float64)

TARGET: Any = cpu_target.target_context
KNOWS_PACKING = binding.llvm_version_info[0] >= 19
"""Whether LLVM has a word for packing lanes."""
PACKS = KNOWS_PACKING and "+avx512f" in TARGET.codegen().magic_tuple()[2]
"""Whether the processor that is compiled for has one; otherwise whole eights are skipped sooner."""

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


def _read(builder: Any, pointer: Any) -> Any:
    register = builder.load(builder.bitcast(pointer, REGISTER.as_pointer()))
    register.align = 8
    return register


def _write(builder: Any, register: Any, pointer: Any) -> None:
    builder.store(register, builder.bitcast(pointer, REGISTER.as_pointer())).align = 8


@intrinsic
def _memory(typing: Any, values: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return cgutils.create_struct_proxy(values)(context, builder, given[0]).data

    return MEMORY(values), emit


@intrinsic
def _filled(typing: Any, value: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        nothing = ir.Constant(REGISTER, ir.Undefined)
        first = builder.insert_element(nothing, given[0], NUMBER(0))
        places = ir.Constant(_numbers(lanes.LANES), [0] * lanes.LANES)
        return builder.shuffle_vector(first, nothing, places)

    return LANES(types.float64), emit


@intrinsic
def _loaded(typing: Any, source: Any, first: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        start, place = given
        if source is not MEMORY:
            start = cgutils.create_struct_proxy(source)(context, builder, start).data
        return _read(builder, builder.gep(start, [place]))

    return LANES(source, types.int64), emit


@intrinsic
def _store(typing: Any, eight: Any, target: Any, first: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        register, start, place = given
        _write(builder, register, builder.gep(start, [place]))
        return context.get_dummy_value()

    return types.void(LANES, MEMORY, types.int64), emit


def _ordered(builder: Any, left: Any, right: Any, sign: str) -> Any:
    """The right one where it is smaller, or larger, than the left one."""
    return builder.select(builder.fcmp_ordered(sign, right, left), right, left)


@intrinsic
def _smaller(typing: Any, left: Any, right: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        left, right = given
        return _ordered(builder, left, right, "<")

    return LANES(LANES, LANES), emit


@intrinsic
def _larger(typing: Any, left: Any, right: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        left, right = given
        return _ordered(builder, left, right, ">")

    return LANES(LANES, LANES), emit


def _halved(builder: Any, register: Any, join: Callable[[Any, Any], Any]) -> Any:
    """One double of eight, half upon half."""
    for half in (4, 2, 1):
        halves = [
            builder.shuffle_vector(register, register, ir.Constant(_numbers(half), list(places)))
            for places in (range(half), range(half, 2 * half))
        ]
        register = join(*halves)
    return builder.extract_element(register, NUMBER(0))


def _numbers(count: int) -> Any:
    return ir.VectorType(NUMBER, count)


@intrinsic
def _least_of(typing: Any, eight: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _halved(builder, given[0], lambda left, right: _ordered(builder, left, right, "<"))

    return types.float64(LANES), emit


@intrinsic
def _most_of(typing: Any, eight: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _halved(builder, given[0], lambda left, right: _ordered(builder, left, right, ">"))

    return types.float64(LANES), emit


@intrinsic
def _sum_of(typing: Any, eight: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _halved(builder, given[0], builder.fadd)

    return types.float64(LANES), emit


def packing(by_itself: bool) -> Any:
    """The intrinsic of `lanes.pack`; ``by_itself``: whether LLVM packs."""

    @intrinsic
    def pack(typing: Any, eight: Any, keys: Any, edge: Any, target: Any, first: Any) -> Any:
        def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            register, key, limit, start, place = given
            kept = builder.fcmp_ordered("<=", key, limit)
            pointer = builder.gep(start, [place])
            if not by_itself:
                return builder.add(place, _write_each(builder, register, kept, pointer))
            _write(builder, _compressed(builder, register, kept), pointer)
            return builder.add(place, _count(builder, kept))

        return types.int64(LANES, LANES, LANES, MEMORY, types.int64), emit

    return pack


_pack = packing(PACKS)


def _compressed(builder: Any, register: Any, kept: Any) -> Any:
    kind = ir.FunctionType(REGISTER, [REGISTER, FLAGS, REGISTER])
    name = f"llvm.experimental.vector.compress.v{lanes.LANES}f64"
    compress = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(compress, [register, kept, ir.Constant(REGISTER, ir.Undefined)])


@intrinsic
def _turn(
    typing: Any, source: Any, first: Any, apart: Any, target: Any, place: Any, width: Any
) -> Any:
    def emit(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        source, first, apart, target, place, width = given
        rows = [
            _read(builder, builder.gep(source, [builder.add(first, builder.mul(apart, PLACE(i)))]))
            for i in range(lanes.LANES)
        ]
        for j, column in enumerate(_columns(builder, rows)):
            step = builder.mul(width, PLACE(j))
            _write(builder, column, builder.gep(target, [builder.add(place, step)]))
        return context.get_dummy_value()

    numbers = (types.int64, types.int64)
    return types.void(MEMORY, *numbers, MEMORY, *numbers), emit


def _columns(builder: Any, rows: list[Any]) -> list[Any]:
    """Of a square: its quarters change places, then those of its quarters, and so on."""
    for half in (1, 2, 4):
        own = [place for place in range(lanes.LANES) if not place & half]
        first, second = ([0] * lanes.LANES for _ in range(2))
        for place in own:
            first[place], first[place + half] = place, lanes.LANES + place
            second[place], second[place + half] = place + half, lanes.LANES + place + half
        for i in own:
            pair = rows[i], rows[i + half]
            for row, places in ((i, first), (i + half, second)):
                chosen = ir.Constant(_numbers(lanes.LANES), places)
                rows[row] = builder.shuffle_vector(*pair, chosen)
    return rows


def _count(builder: Any, kept: Any) -> Any:
    flags = builder.bitcast(kept, FLAGS_TOGETHER)
    return builder.zext(builder.ctpop(flags), PLACE)


def _write_each(builder: Any, register: Any, kept: Any, pointer: Any) -> Any:
    """One by one, each where the next one goes too if it is not kept; how many are kept."""
    before, count = builder.block, PLACE(0)
    some = builder.icmp_unsigned("!=", builder.bitcast(kept, FLAGS_TOGETHER), FLAGS_TOGETHER(0))
    with builder.if_then(some):
        for lane in range(lanes.LANES):
            value = builder.extract_element(register, NUMBER(lane))
            builder.store(value, builder.gep(pointer, [count]))
            flag = builder.extract_element(kept, NUMBER(lane))
            count = builder.add(count, builder.zext(flag, PLACE))
        within = builder.block
    result = builder.phi(PLACE)
    result.add_incoming(PLACE(0), before)
    result.add_incoming(count, within)
    return result


# Words of the language above, and what stands where compiled code has them. The names and types of
# arguments must be the same outside and inside, for numba compares them.


@overload(lanes.memory)
def _found_memory(values: Any) -> Any:
    def call(values: Any) -> Any:
        return _memory(values)

    return call


@overload(lanes.filled)
def _found_filled(value: Any) -> Any:
    def call(value: Any) -> Any:
        return _filled(value)

    return call


@overload(lanes.loaded)
def _found_loaded(source: Any, first: Any) -> Any:
    def call(source: Any, first: Any) -> Any:
        return _loaded(source, first)

    return call


@overload(lanes.store)
def _found_store(eight: Any, target: Any, first: Any) -> Any:
    def call(eight: Any, target: Any, first: Any) -> Any:
        return _store(eight, target, first)

    return call


@overload(lanes.smaller)
def _found_smaller(left: Any, right: Any) -> Any:
    def call(left: Any, right: Any) -> Any:
        return _smaller(left, right)

    return call


@overload(lanes.larger)
def _found_larger(left: Any, right: Any) -> Any:
    def call(left: Any, right: Any) -> Any:
        return _larger(left, right)

    return call


@overload(lanes.least_of)
def _found_least_of(eight: Any) -> Any:
    def call(eight: Any) -> Any:
        return _least_of(eight)

    return call


@overload(lanes.most_of)
def _found_most_of(eight: Any) -> Any:
    def call(eight: Any) -> Any:
        return _most_of(eight)

    return call


@overload(lanes.sum_of)
def _found_sum_of(eight: Any) -> Any:
    def call(eight: Any) -> Any:
        return _sum_of(eight)

    return call


@overload(lanes.pack)
def _found_pack(eight: Any, keys: Any, edge: Any, target: Any, first: Any) -> Any:
    def call(eight: Any, keys: Any, edge: Any, target: Any, first: Any) -> Any:
        return _pack(eight, keys, edge, target, first)

    return call


@overload(lanes.turn)
def _found_turn(source: Any, first: Any, apart: Any, target: Any, place: Any, width: Any) -> Any:
    def call(source: Any, first: Any, apart: Any, target: Any, place: Any, width: Any) -> Any:
        return _turn(source, first, apart, target, place, width)

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
