"""The fields of the form for a new run, as the configuration declares them, and what is typed.

A field is named as the configuration names it, ``scenario.dt_s``; :data:`RULE` alone stands for
two: the specification, or rules by name.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from pemviz.config import BLACK_BOXES, SHIPPED_SIMULATORS, ExperimentConfig, StartChoice
from pemviz.config.ranges import NamedPart, allows_none, field_docs, optional_value
from pemviz.config.rule_words import read_rules, read_starts, rules_text
from pemviz.config.settings import RULE_NAME
from pemviz.config.topics import topic_of
from pemviz.config.typed_text import read_typed, typed_text
from pemviz.errors import ConfigError
from pemviz.pem import shipped_pems, shipped_position_errors
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.registry import by_name, ignored_settings
from pemviz.simulators.registry import SIMULATORS

Kind = Literal["choice", "number", "text", "lines", "switch"]

RULE, START, TRACKER = "rule", "start", "scenario.tracker"
MAIN = (
    "simulator", RULE, "pem", "memory_s", "frailty", "method", "metric", "alpha", "sigma",
    "precision", "max_rollouts", "stages", "rollouts", "final_rollouts", "target", "seed",
)  # fmt: skip
"""Fields that are always in sight, in this order, where the method looks at them."""
BUDGET = ("stages", "rollouts", "final_rollouts")
"""What a method that goes on until its answer is precise only begins with."""
LABELS = {
    "pem": "Error model",
    "memory_s": "Memory of misses",
    "memory_law": "Law of misses",
    "varying_frailty_s": "Frailty varies over",
    "alpha": "alpha",
    "sigma": "sigma",
    "max_rollouts": "Rollouts at most",
    "max_minutes": "Minutes at most",
    "plan": "What to measure next",
    "reference": "Exact reference",
    "keep": "Rollouts kept",
    "carla": "CARLA's server",
    "dt_s": "Time step",
    "sumo.config": "Traffic of SUMO's",
    "sumo.ego": "Ego's id",
    "sumo.model": "Others drive by",
    "encounter.farthest_m": "Farthest in view",
    "encounter.side": "Side of the other car",
    RULE: "Rule",
    START: "Start values",
}
"""By key, or what it ends with, where the setting's own name is not what a person would say."""
UNITS_IN_NAMES = re.compile(r"_(kmh|mps2|mps|per_s2|per_s|per_m|deg|m|s)$")
UNIT = re.compile(r"\[([^\]]+)\]")
LONGEST = 20_000
"""Characters of what is typed into a field."""
RULE_HELP = "Or several rules, a line NAME = FORMULA each: each is answered, and any of them."
START_HELP = (
    "Start values with other distributions than the scenario's own, a line NAME = DISTRIBUTION "
    "each: a number, which fixes it, normal(mean, sd), lognormal(median, spread), "
    "uniform(low, high), and 'in [low, high]' behind one to cut it."
)


@dataclass(frozen=True)
class FormField:
    """A field of the form.

    Attributes:
        key: As the configuration names it.
        label: For people.
        unit: Of the number; empty without one.
        group: What it belongs to, see :mod:`pemviz.config.topics`.
        main: Whether it is in sight before anything advanced is asked for.
        choices: Values of which it has one; empty of what is typed.
        open: Whether it may have another value than these: a file.
        help: What it means, with unit and range.
        may_be_empty: Whether it may be left out.
    """

    key: str
    label: str
    unit: str
    group: str
    main: bool
    kind: Kind
    choices: tuple[str, ...]
    open: bool
    help: str
    may_be_empty: bool


def form_fields() -> tuple[FormField, ...]:
    """All fields: the main ones first, then the others as the configuration has them."""
    found = {key: _field(key, annotation, words) for key, annotation, words in _declared()}
    return (*(found[key] for key in MAIN), *(f for f in found.values() if not f.main))


@cache
def labels() -> Mapping[str, str]:
    """What the fields are called, by key, in their order."""
    return {field.key: field.label for field in form_fields()}


def typed_values(config: ExperimentConfig) -> dict[str, str]:
    """What stands in the fields for a configuration, by key."""
    table = asdict(config)
    values = {key: typed_text(_value_at(table, key)) for key in _annotations()}
    starts = "\n".join(f"{one.name} = {one.distribution}" for one in config.start)
    return {**values, RULE: rules_text(config.rules) or config.spec, START: starts}


def config_of(
    base: ExperimentConfig, typed: Mapping[str, str]
) -> tuple[ExperimentConfig, dict[str, str]]:
    """A configuration with what was typed in place of some of its values.

    Returns:
        It, those values left as they are that are not understood, and what is wrong with them.

    Raises:
        ConfigError: There is no such field.
    """
    annotations, config, wrong = _annotations(), base, dict[str, str]()
    before = typed_values(base)
    for key, text in typed.items():
        if key not in before:
            raise ConfigError(f"{key[:80]}: there is no such field")
        if text == before[key]:
            continue
        try:
            if len(text) > LONGEST:
                raise ConfigError(f"must have at most {LONGEST:,} characters")
            if key == RULE:
                config = _with_rule(config, text)
            elif key == START:
                named = read_starts(_lines(text))
                config = replace(config, start=tuple(StartChoice(*one) for one in named.items()))
            else:
                config = _with_value(config, key, read_typed(text, annotations[key]))
        except ConfigError as error:
            wrong[key] = str(error)
    return config, wrong


def unused(config: ExperimentConfig) -> frozenset[str]:
    """Fields that nothing looks at with the method, simulator and scenario chosen."""
    keys = set(ignored_settings(config.method))
    traffic, encounter = config.is_sumo_traffic, config.is_encounter
    shipped = config.simulator in SHIPPED_SIMULATORS
    for key in (*_annotations(), START):
        table, _, name = key.partition(".")
        if table == "scenario" and key != TRACKER:
            black_box = config.simulator in BLACK_BOXES and name != "camera_height_m"
            is_used = not encounter and not traffic and not black_box
        elif table == "encounter":
            is_used = encounter or (name == "logical_scenario" and shipped and not traffic)
        elif table == "sumo":
            is_used = config.simulator == "sumo" and (traffic or name in ("model", "config"))
        else:
            is_used = {
                "carla": config.simulator == "carla",
                START: encounter,
                "frailty": not encounter,
                "memory_law": not encounter,
                "varying_frailty": config.memory_law == "visibility",
                "varying_frailty_s": config.memory_law == "visibility",
                "memory_curve": not encounter,
                "reference": not encounter,
                "position_errors": shipped and not traffic,
                "smooth_beta_per_m": config.metric == "smooth-cumulative",
                "encounters_per_hour": not traffic,
            }.get(key, True)
        if not is_used:
            keys.add(key)
    return frozenset(keys)


def beside(config: ExperimentConfig) -> tuple[str, ...]:
    """The main fields that belong to the others with the method chosen."""
    method = method_of(config)
    return BUDGET if method is not None and method.most is not None else ()


def method_of(config: ExperimentConfig) -> MethodDescription | None:
    """The method; ``None`` where it cannot be had, as of a run of a package that is gone."""
    try:
        return by_name(config.method)
    except ConfigError:
        return None


def _declared() -> Iterator[tuple[str, Any, str]]:
    """Key, annotation and words of each field."""
    docs = field_docs(ExperimentConfig)
    yield RULE, str, f"{docs['spec']} {RULE_HELP}"
    yield START, str | None, START_HELP
    yield from _settings(ExperimentConfig)


def _settings(kind: type[Any], table: str = "") -> Iterator[tuple[str, Any, str]]:
    """The same of all that the configuration holds as one value, tables of it included."""
    hints, docs = get_type_hints(kind, include_extras=True), field_docs(kind)
    for one in fields(kind):
        annotation = hints[one.name]
        if is_dataclass(annotation) and isinstance(annotation, type):
            yield from _settings(annotation, f"{table}{one.name}.")
        elif get_origin(annotation) is not tuple and one.name != "spec":
            yield f"{table}{one.name}", annotation, docs[one.name]


@cache
def _annotations() -> Mapping[str, Any]:
    return {key: annotation for key, annotation, _ in _settings(ExperimentConfig)}


def _field(key: str, annotation: Any, words: str) -> FormField:
    kind = optional_value(annotation)
    choices, is_open = _choices(key, kind)
    base = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    is_number = base in (int, float)
    unit, last = UNIT.search(words), key.rpartition(".")[2]
    name = LABELS.get(last) or UNITS_IN_NAMES.sub("", last).replace("_", " ").capitalize()
    form: Kind = "number" if is_number else "switch" if base is bool else "text"
    return FormField(
        key=key,
        label=LABELS.get(key, name),
        unit=unit[1] if unit and is_number else "",
        group=topic_of(last if key == TRACKER else key) or "method",
        main=key in MAIN,
        kind="lines" if key in (RULE, START) else "choice" if choices else form,
        choices=choices,
        open=is_open,
        help=words,
        may_be_empty=allows_none(annotation),
    )


def _choices(key: str, kind: Any) -> tuple[tuple[str, ...], bool]:
    """The values that a field has one of, and whether it may have another."""
    shipped = {"pem": shipped_pems, "position_errors": shipped_position_errors}
    if key in shipped:
        return tuple(shipped[key]()), True
    if key in ("simulator", "surrogate"):
        return SIMULATORS.names(), key == "surrogate"
    if get_origin(kind) is Literal:
        return get_args(kind), False
    parts = [part for part in get_args(kind)[1:] if isinstance(part, NamedPart)]
    return (parts[0].names(), False) if parts else ((), False)


def _value_at(table: Mapping[str, Any], key: str) -> Any:
    inner, _, name = key.rpartition(".")
    return table[inner][name] if inner else table[name]


def _with_value(config: ExperimentConfig, key: str, value: Any) -> ExperimentConfig:
    inner, _, name = key.rpartition(".")
    if inner:
        name, value = inner, replace(getattr(config, inner), **{name: value})
    return replace(config, **{name: value})


def _with_rule(config: ExperimentConfig, text: str) -> ExperimentConfig:
    """With rules if the first line names one, else with all lines as one specification."""
    lines = _lines(text)
    plain = replace(config, rules=(), spec=" ".join(line.strip() for line in lines))
    return plain.with_rules(read_rules(lines)) if lines and _is_named(lines[0]) else plain


def _is_named(line: str) -> bool:
    name, equals, after = line.partition("=")
    return bool(equals) and not after.startswith("=") and _fits(name.strip())


def _fits(name: str) -> bool:
    return RULE_NAME.fullmatch(name) is not None


def _lines(text: str) -> Sequence[str]:
    return [line for line in text.splitlines() if line.strip()]
