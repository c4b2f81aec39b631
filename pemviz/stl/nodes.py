"""Nodes of a syntax tree: what formulas and numeric expressions share.

Also the limits on their depth and number, so that no text can exhaust stack or memory.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field

from pemviz.stl.errors import FormulaError

MAX_DEPTH = 100
"""Most levels of nesting a formula may have, so that no walk over it runs out of stack."""

MAX_NODES = 10_000
"""Most parts (operators, signals, numbers) a formula may have."""


@dataclass(frozen=True)
class Node(ABC):
    """What formulas and expressions share: parts, and limits on how many."""

    _depth: int = field(init=False, repr=False, compare=False)
    _nodes: int = field(init=False, repr=False, compare=False)

    @abstractmethod
    def __str__(self) -> str:
        """The text form."""

    def children(self) -> tuple[Node, ...]:
        """The direct parts, left to right."""
        return ()

    def __post_init__(self) -> None:
        parts = self.children()
        depth = 1 + max((part._depth for part in parts), default=0)
        nodes = 1 + sum(part._nodes for part in parts)
        if depth > MAX_DEPTH:
            raise FormulaError(f"formula is nested too deeply; at most {MAX_DEPTH} levels")
        if nodes > MAX_NODES:
            raise FormulaError(f"formula is too long; at most {MAX_NODES} parts")
        object.__setattr__(self, "_depth", depth)
        object.__setattr__(self, "_nodes", nodes)

    def walk(self) -> Iterator[Node]:
        """This node and everything below it, parents first, left to right."""
        pending: list[Node] = [self]
        while pending:
            node = pending.pop()
            yield node
            pending.extend(reversed(node.children()))

    def signals(self) -> frozenset[str]:
        """Names of all signals used."""
        return frozenset[str]().union(*(node.own_signals() for node in self.walk()))

    def own_signals(self) -> frozenset[str]:
        """Names of the signals that this node itself stands for."""
        return frozenset()
