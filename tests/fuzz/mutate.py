"""Damage to bytes, text and trees of plain values; everything is drawn from one generator."""

import copy
import json
import math
import random
from typing import Any

NUMBERS = (
    0, -0.0, 1, -1, 2, 3, 255, 256, -(2**31), 2**31, 2**32, 2**53 + 1, 2**62, 2**63 - 1, 2**63,
    2**64, -(2**63) - 1, 10**30, 10**308, 10**309, 10**400, 0.5, -0.5, 1e-320, 5e-324, 1e-30,
    1e19, 1e30, 1e154, 1e300, 1.7976931348623157e308, -1.7976931348623157e308,
    math.nan, math.inf, -math.inf,
)  # fmt: skip
WORDS = (
    "", " ", "a", "nan", "-inf", "1e999", "²", "٣", "１２", "é", "\u202e", "\u2028", "\x00",
    "\x1b[31m", "a\nb", "🚗", "../../x", "/dev/zero", "x" * 300, "x" * 5000, "None", "__class__",
    "os:system", "true", "%s%n", "{0}", "gap", "1_0", "0x10", "-", "+5", "--help",
)  # fmt: skip
TOKENS = (
    "nan", "-nan", "inf", "-inf", "1e308", "-1e308", "1e309", "-1e999", "1e-400", "0", "-0", "-1",
    "1", "2", "3", "4", "255", "99999999999999999999", "9" * 400, "9" * 5000, "1.5", "1e3", "1e19",
    "0x10", "1_0", "²", "٣", "", "x", "é", "\x00", "\u2028", "[" * 50, "{" * 50, "[" * 5000,
    '"', "'", "\\", "#", "=", ",", "\t", "\n", "a.b.c", "a." * 2000 + "a", "Car", "DontCare",
    "Misc", "Person_sitting", "true", "null",
)  # fmt: skip
DEPTHS = (3, 30, 200, 900, 990)
FAULTS = (
    "replace", "replace", "replace", "same type", "same type", "drop", "rename", "add", "nest",
    "exchange",
)  # fmt: skip

Tree = Any


def number(rng: random.Random) -> int | float:
    """A number, most of them extreme."""
    if rng.random() < 0.3:
        return rng.choice((rng.randrange(-5, 200), rng.uniform(-50.0, 50.0)))
    return rng.choice(NUMBERS)


def scalar(rng: random.Random) -> Tree:
    """A value of any type that JSON has."""
    kind = rng.randrange(6)
    if kind < 3:
        return number(rng)
    return (rng.choice(WORDS), rng.choice((True, False, None)), rng.choice(([], {}, [1], [[]])))[
        kind - 3
    ]


def damage_bytes(rng: random.Random, content: bytes, others: list[bytes]) -> bytes:
    """One to four faults in some bytes; a splice takes the rest from another valid file."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        place = rng.randrange(len(data) + 1) if rng.random() < 0.6 else rng.randrange(
            min(len(data), 200) + 1
        )  # fmt: skip
        end = min(len(data), place + rng.choice((1, 1, 2, 4, 8, 64, 1000)))
        kind = rng.randrange(8)
        if kind == 0 and place < len(data):
            data[place] ^= 1 << rng.randrange(8)
        elif kind == 1 and place < len(data):
            data[place] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        elif kind == 2:
            del data[place:]
        elif kind == 3:
            del data[place:end]
        elif kind == 4:
            data[end:end] = data[place:end]
        elif kind == 5:
            data[place:place] = rng.randbytes(rng.choice((1, 2, 8, 100)))
        elif kind == 6:
            data[place:end] = rng.choice((b"\0", b"\xff")) * (end - place)
        else:
            other = rng.choice(others)
            cut = rng.choice((place, rng.randrange(len(other) + 1)))
            data[place:] = other[cut:]
    return bytes(data)


def damage_text(rng: random.Random, text: str, others: list[str]) -> str:
    """Faults in the words and lines of a text."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        kind = rng.randrange(8)
        if kind < 4:
            separator = rng.choice((" ", ",", "="))
            cells = lines[at].split(separator)
            cell = rng.randrange(len(cells))
            token = rng.choice(TOKENS)
            if kind < 2:
                cells[cell] = token
            elif kind == 2:
                cells.insert(cell, token)
            else:
                del cells[cell]
            lines[at] = separator.join(cells)
        elif kind == 4:
            del lines[at]
        elif kind == 5:
            lines.insert(at, rng.choice(lines))
        elif kind == 6:
            lines[at:at] = rng.choice(others).split("\n")
        else:
            place = rng.randrange(len(lines[at]) + 1)
            lines[at] = lines[at][:place] + rng.choice(TOKENS) + lines[at][place:]
        text = "\n".join(lines)
    return text


def text_bytes(rng: random.Random, text: str, others: list[str]) -> bytes:
    """A text damaged as text or as bytes."""
    if rng.random() < 0.7:
        return damage_text(rng, text, others).encode("utf-8", errors="surrogatepass")
    return damage_bytes(rng, text.encode(), [other.encode() for other in others])


def as_json(tree: Tree) -> str:
    """A tree as JSON; what cannot be written becomes deep nesting."""
    try:
        return json.dumps(tree)
    except RecursionError:
        return "[" * 990 + "]" * 990


def damage_tree(rng: random.Random, tree: Tree) -> Tree:
    """A copy of a tree of dicts and lists with one to four faults."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 2, 4))):
        places = list(_places(tree))
        if not places:
            return scalar(rng)
        holder, key = rng.choice(places)
        match FAULTS[rng.randrange(len(FAULTS))]:
            case "replace":
                holder[key] = scalar(rng)
            case "same type":
                holder[key] = _same_type(rng, holder[key])
            case "drop":
                del holder[key]
            case "rename" if isinstance(holder, dict):
                holder[rng.choice((*WORDS, f"{key}x", str(key)[:-1]))] = holder.pop(key)
            case "add" if isinstance(holder, dict):
                holder[rng.choice(WORDS)] = scalar(rng)
            case "add":
                holder.insert(key, scalar(rng))
            case "nest":
                as_list = rng.random() < 0.5
                for _ in range(rng.choice(DEPTHS)):
                    holder[key] = [holder[key]] if as_list else {"a": holder[key]}
            case "exchange":
                keys = list(holder) if isinstance(holder, dict) else range(len(holder))
                other = rng.choice(keys)
                holder[key], holder[other] = holder[other], holder[key]
    return tree


def _places(tree: Tree, depth: int = 0) -> Any:
    """Every (holder, key) below a tree."""
    if isinstance(tree, dict | list) and depth < 40:
        for key in tree if isinstance(tree, dict) else range(len(tree)):
            yield tree, key
            yield from _places(tree[key], depth + 1)


def _same_type(rng: random.Random, value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return rng.choice((value + 1, value - 1, -value, value * 1000, int(1e18)))
    if isinstance(value, float):
        return rng.choice((value * 1.5, -value, value * 1e10, value * 1e300, number(rng)))
    if isinstance(value, str):
        place = rng.randrange(len(value) + 1)
        return value[:place] + rng.choice(WORDS) + value[place + rng.randrange(3) :]
    if isinstance(value, list):
        return rng.choice((value[:-1], value * 2, value[::-1], [*value, scalar(rng)]))
    return value
