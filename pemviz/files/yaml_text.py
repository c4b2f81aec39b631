"""YAML from files that may come from anywhere, and for other programs."""

import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

import yaml

DEEPEST = 30


class _Loader(yaml.SafeLoader):
    """YAML without anchors, deep nesting or a key that is there twice.

    A few bytes of aliases can stand for more values than any memory holds.
    """

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"an alias in line {self.peek_event().start_mark.line + 1}")
        self.depth += 1
        if self.depth > DEEPEST:
            raise yaml.YAMLError(f"nested more than {DEEPEST} levels deep")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        twice = sorted(key for key, count in Counter(keys).items() if count > 1)
        if twice:
            line = node.start_mark.line + 1
            raise yaml.YAMLError(f"{twice[0]!r} is there twice in what begins in line {line}")
        return super().construct_mapping(node, deep=deep)


# ROS's reader takes 1e-3 for a number; YAML 1.1 asks for a point and a sign
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def parse_yaml(text: str) -> Any:
    """The value that a YAML text spells out.

    Raises:
        ValueError: It is no such YAML; one line says what.
    """
    try:
        return yaml.load(text, Loader=_Loader)  # noqa: S506  a safe loader, with less in it
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = "" if mark is None else f"line {mark.line + 1}: "
        raise ValueError(f"no YAML: {where}{error.problem or error.context}") from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"no YAML: {error}") from None


def yaml_text(
    document: Mapping[str, Any], *, width: float = float("inf"), innermost_in_line: bool = False
) -> str:
    """A document of plain values, its keys in their order.

    ``innermost_in_line``: Lists and tables that hold no others stand in one line each.
    """
    return yaml.safe_dump(
        dict(document),
        sort_keys=False,
        default_flow_style=None if innermost_in_line else False,
        width=width,
        allow_unicode=True,
    )
