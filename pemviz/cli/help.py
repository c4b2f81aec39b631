"""Help of a command: a page by purpose, then topics and single options, or everything."""

import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from pemviz.config.ranges import did_you_mean, field_docs, optional_value
from pemviz.config.topics import topic_of
from pemviz.errors import InputError

HELP = ("-h", "--help")
HELP_ALL = "--help-all"
MORE = "more"
"""The topic of options that no other has."""
WIDEST = 100
INDENT = 6
SWITCHED_OFF = "Switches off what is done by default: "


@dataclass(frozen=True)
class HelpPage:
    """What ``--help`` of a command says.

    Attributes:
        text: The page, at most 25 lines of at most 80 characters.
        topics: Options by topic, as in the configuration (``pem``); a name that ends with a dot
            stands for a table of them.
        notes: What stands above a topic's options.
    """

    text: str
    topics: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: MappingProxyType({}))
    notes: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def topic_of(self, name: str) -> str:
        """The topic that explains an option."""
        return topic_of(name, self.topics) or MORE


@dataclass(frozen=True)
class Option:
    """An option as help shows it.

    Attributes:
        name: Without dashes, as in a configuration: ``scenario.dt_s``.
        words: As it is typed, with what follows it.
        text: What it does.
        default: What holds where it is left out, unless the text says so; ``None`` if it must be
            given.
    """

    name: str
    words: str
    text: str
    default: str | None


def asked_help(words: Sequence[str]) -> str | None:
    """The topic whose help is asked for: empty for the page, ``--help-all`` for everything."""
    for index, word in enumerate(words):
        name, _, topic = word.partition("=")
        if name == HELP_ALL:
            return HELP_ALL
        if name in HELP:
            after = "".join(words[index + 1 : index + 2])
            return topic or ("" if after.startswith("-") else after)
    return None


def help_text(page: HelpPage, topic: str, kind: type, *, default: object | None) -> str:
    """What ``--help TOPIC`` prints.

    Args:
        page: The command's.
        topic: As :func:`asked_help` gives it; an option's name is one, too.
        kind: The dataclass of the command's arguments.
        default: Values of options that are left out; without it, the fields' own.

    Raises:
        InputError: There is no such topic and no such option.
    """
    if not topic:
        return page.text.strip("\n")
    by_topic: dict[str, list[Option]] = {name: [] for name in (*page.topics, MORE)}
    for option in options_of(kind, default):
        by_topic[page.topic_of(option.name)].append(option)
    by_topic = {name: options for name, options in by_topic.items() if options}
    if topic == HELP_ALL:
        return "\n\n".join(_topic_text(page, name, options) for name, options in by_topic.items())
    if topic in by_topic:
        return _topic_text(page, topic, by_topic[topic])
    named = {option.name: option for options in by_topic.values() for option in options}
    wanted = topic.replace("-", "_")
    wanted = wanted.removeprefix("no_") if wanted not in named else wanted
    if wanted in named:
        return _option_text(named[wanted])
    allowed = f"{', '.join(by_topic)}, or an option's name"
    guess = did_you_mean(wanted, [*by_topic, *named]).replace("_", "-")
    raise InputError(f"help {topic!r}: must be one of {allowed}{guess}")


def options_of(kind: type, default: object | None = None, *, table: str = "") -> Iterator[Option]:
    """The options that a dataclass of arguments declares, nested ones included.

    Args:
        kind: The dataclass.
        default: Values of options that are left out; without it, the fields' own.
        table: What its options' names begin with.
    """
    hints, docs = get_type_hints(kind, include_extras=True), field_docs(kind)
    for one in fields(kind):
        annotation = hints[one.name]
        base, marks = _unwrapped(annotation)
        if tyro.conf.Suppress in marks or _is_records(base):
            continue
        value = one.default if one.default_factory is MISSING else one.default_factory()
        value = getattr(default, one.name) if default is not None else value
        if is_dataclass(base) and isinstance(base, type):
            is_flat = any(getattr(mark, "name", None) == "" for mark in marks)
            inner = table if is_flat else f"{table}{one.name}."
            yield from options_of(base, None if value is MISSING else value, table=inner)
            continue
        positional = tyro.conf.Positional in marks
        name = f"{table}{one.name}"
        is_on = base is bool and value is True  # and the option switches it off
        off, text = "no-" * is_on, docs.get(one.name, "")
        typed = one.name.upper() if positional else f"--{off}{name.replace('_', '-')}"
        repeated = tyro.conf.UseAppendAction in marks
        yield Option(
            name,
            f"{typed} {'' if positional else _values(base)}{' ...' * repeated}".rstrip(),
            f"{SWITCHED_OFF}{text[:1].lower()}{text[1:]}" if is_on else text,
            "" if is_on else _default_text(value),
        )


def _unwrapped(annotation: Any) -> tuple[Any, tuple[object, ...]]:
    """The type itself, and all that it is annotated with."""
    marks: tuple[object, ...] = ()
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        marks += tuple(more)
    return annotation, marks


def _is_records(kind: Any) -> bool:
    """Whether it is a tuple of records, which files alone spell out."""
    return get_origin(kind) is tuple and is_dataclass(get_args(kind)[0])


def _values(kind: Any) -> str:
    """What follows an option: the choices, or a word for what is allowed."""
    base, _ = _unwrapped(optional_value(kind))
    if get_origin(base) is tuple:
        one, *rest = get_args(base)
        return f"{_values(one)}{' ...' if rest == [...] else ''}"
    if get_origin(base) in (Union, UnionType):
        return "|".join(_values(arm) for arm in get_args(base))
    if get_origin(base) is Literal:
        return "|".join(dict.fromkeys(str(choice) for choice in _choices(base)))
    return {bool: "", int: "N", float: "X", Path: "PATH"}.get(base, "TEXT")


def _choices(literal: Any) -> Iterator[object]:
    for one in get_args(literal):
        yield from _choices(one) if get_origin(one) is Literal else (one,)


def _default_text(value: object) -> str | None:
    """What holds where the option is left out, unless its text says so; ``None``: it may not be."""
    if value is MISSING:
        return None
    if value is None or value is False or value in ((), ""):
        return ""
    if isinstance(value, tuple):
        value = " ".join(str(each) for each in value)
    return f"{value:g}" if isinstance(value, float) else f"{value}"


def _topic_text(page: HelpPage, topic: str, options: Sequence[Option]) -> str:
    notes = [page.notes[topic]] if topic in page.notes else []
    shown = (_option_text(option) for option in options)
    return "\n".join([topic, "-" * len(topic), *notes, *shown])


def _option_text(option: Option) -> str:
    width = min(WIDEST, shutil.get_terminal_size().columns)
    margin = " " * INDENT
    given = f" [{option.default}]" if option.default else ""
    after = " Required." if option.default is None else given
    text = textwrap.fill(
        f"{option.text}{after}",
        width,
        initial_indent=margin,
        subsequent_indent=margin,
        break_on_hyphens=False,
        break_long_words=False,
    )
    return f"  {option.words}\n{text}"
