"""What the form for a new run asks for: its fields, what is wrong with what is typed, to start it.

The form begins with a shipped preset or with a kept run; what comes with each request is where it
began, and what was typed in place of its values. The server keeps nothing of it.
"""

import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import load_preset, preset_names, preset_words, with_own_rules
from pemviz.errors import InputError
from pemviz.panel.arguments import Arguments
from pemviz.panel.form_checks import (
    Placed,
    complaints,
    cost_notes,
    facts,
    missing_extra,
    placed,
    scenario_of,
    whole_complaints,
)
from pemviz.panel.form_fields import (
    BUDGET,
    LONGEST,
    RULE,
    START,
    beside,
    config_of,
    form_fields,
    labels,
    typed_values,
    unused,
)
from pemviz.panel.hub import Hub
from pemviz.panel.run_data import RunData
from pemviz.panel.site import Page, Request
from pemviz.reports.run_document import scenario_text
from pemviz.sampling.registry import by_name, ignored_note, ignored_settings

FIRST_PRESET = "paper"
GROUPS = {
    "question": "Question",
    "scenario": "Braking scenario",
    "encounter": "Logical scenario",
    "sumo": "SUMO",
    "detector": "Detector",
    "method": "Method",
    "certainty": "Certainty",
    "output": "What is kept",
}
"""Headings of what is advanced, in this order."""
BUSY = "another run is under way: stop it first"
LOOK_S = 0.02


@dataclass(frozen=True)
class Base:
    """Where a form began.

    Attributes:
        name: Of the preset or run.
        words: What it is, in a sentence.
        options: With which ``pemviz record`` begins there, too.
    """

    name: str
    words: str
    config: ExperimentConfig
    options: tuple[str, ...]


class NewRunPlace:
    """Answers the form."""

    def __init__(self, hub: Hub, find: Callable[[str], RunData]) -> None:
        """``find`` gives a run by its name."""
        self._hub = hub
        self._find = find
        self._building = Lock()
        self._signals: Mapping[ExperimentConfig, tuple[str, ...]] = {}

    @property
    def requests(self) -> Mapping[str, Request]:
        """What a page may ask for, by name."""
        return {"form": self._form, "check": self._check, "start": self._start}

    def _form(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """The fields, with what stands in them at first."""
        base = self._base(asked)
        presets = [
            {"name": name, "words": preset_words(name),
             "missing": missing_extra(load_preset(name).simulator)}
            for name in preset_names()
        ]  # fmt: skip
        fields = form_fields()
        lacking = {name: missing_extra(name) for name in ("sumo", "carla")}
        return {
            "name": base.name,
            "words": base.words,
            "presets": presets,
            "groups": list(GROUPS.items()),
            "fields": [asdict(field) for field in fields],
            "missing": {name: words for name, words in lacking.items() if words},
            "values": typed_values(base.config),
            "hidden": _hidden(base.config),
            "longest": LONGEST,
        }

    def _check(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """What is wrong and what is told with what was typed; ``whole`` builds all that runs."""
        base, typed = self._base(asked), _typed(asked)
        config, wrong = config_of(base.config, typed)
        config = with_own_rules(config)
        wrong = {**complaints(config), **wrong}
        scenario = scenario_of(config)
        is_whole = asked.flag("whole") and not wrong
        if is_whole:
            with self._building:
                wrong, signals = whole_complaints(config)
            if signals:
                self._signals = {scenario: signals}
        changes = _differences(base.config, config, typed)
        notes = cost_notes(
            config, changed=[one["key"] for one in changes], folder=self._hub.recordings.root,
            measure=asked.flag("whole") and set(wrong) <= {"max_rollouts", *BUDGET},
        )  # fmt: skip
        return {
            "wrong": wrong,
            "notes": {**_ignored(config, changes), **notes},
            "facts": _facts(config, self._signals.get(scenario, ()), wrong),
            "differs": changes,
            "understood": "" if wrong else understood(config),
            "command": "" if wrong else command(base, config),
            "hidden": _hidden(config),
            "whole": is_whole,
        }

    def _start(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """The run's name as soon as it has one, or what is wrong."""
        base, typed = self._base(asked), _typed(asked)
        config, wrong = config_of(base.config, typed)
        wrong = {**complaints(config), **wrong}
        if wrong:
            return {"wrong": wrong}
        controller = self._hub.controller
        before = _name(controller.state.run)
        if not controller.start(config):
            return {"wrong": {"": BUSY}}
        while (state := controller.state).running and _name(state.run) == before:
            time.sleep(LOOK_S)
        if _name(state.run) != before:
            return {"run": _name(state.run)}
        if state.error is not None:
            return {"wrong": dict([placed(InputError(state.error))])}
        return {"wrong": {"": "it was stopped before it began"}}

    def _base(self, asked: Arguments) -> Base:
        name = asked.text("run", "")
        if not name:
            preset = asked.text("preset", "") or FIRST_PRESET
            config = load_preset(preset)  # says of what there is not what there is
            options = () if preset == FIRST_PRESET else ("--preset", preset)
            return Base(preset, preset_words(preset), config, options)
        run = self._find(name)
        folder = run.folder or Path(name)
        options = ("--config", str(folder / "config.toml"))
        return Base(name, scenario_text(run.config), run.config, options)


def _typed(asked: Arguments) -> dict[str, str]:
    values = Arguments(asked.mapping("values"))
    return {key: values.text(key) for key in asked.mapping("values")}


def _name(run: RunData | None) -> str | None:
    return None if run is None else run.name


def _hidden(config: ExperimentConfig) -> Mapping[str, Sequence[str]]:
    """Fields that nothing looks at, and main ones that belong to the others."""
    return {"unused": sorted(unused(config)), "beside": beside(config)}


def _facts(config: ExperimentConfig, signals: tuple[str, ...], wrong: Placed) -> Placed:
    """Nothing while the scenario itself is wrong."""
    is_wrong = any(key.partition(".")[0] in ("scenario", "encounter", START) for key in wrong)
    return {} if is_wrong else facts(config, signals)


def _differences(
    base: ExperimentConfig, config: ExperimentConfig, typed: Mapping[str, str]
) -> list[dict[str, str]]:
    """What differs from where the form began, also by what is not understood."""
    before = typed_values(base)
    after = {**typed_values(config), **typed}
    return [
        {"key": key, "label": label, "before": before[key], "after": after[key]}
        for key, label in labels().items()
        if before[key] != after[key]
    ]


def _ignored(config: ExperimentConfig, changes: Sequence[Mapping[str, str]]) -> Placed:
    """A line for each change that the method does not look at."""
    ignored = ignored_settings(config.method)
    keys = [one["key"] for one in changes if one["key"] in ignored]
    return {key: f"{ignored_note(config.method)}." for key in keys}


def understood(config: ExperimentConfig) -> str:
    """A configuration in a line: the scenario, what must hold, the detector, how it is answered."""
    method = by_name(config.method)
    rules = ", ".join(rule.name for rule in config.rules) or config.spec
    memory = "memory as measured, if any"
    if config.memory_law == "visibility":
        memory = "visibility that comes and goes"
    elif config.memory_s is not None:
        memory = f"memory {config.memory_s:g} s" if config.memory_s else "misses independent"
    elif config.assumed_memory_s:
        memory = f"memory {config.assumed_memory_s:g} s if it has none of its own"
    budget = method.budget(config).words
    if method.most is not None:
        share = f"\N{PLUS-MINUS SIGN}{100.0 * config.precision:g} %"
        budget = f"{budget}, then on to {share} or {method.most(config):,} rollouts"
    times = f", {config.repetitions} times" * (config.repetitions > 1)
    return (
        f"Scenario: {scenario_text(config)}. {'Rules' if config.rules else 'Rule'}: {rules}. "
        f"Detector {config.pem}, {memory}. {config.method}: {budget}{times}, seed {config.seed}."
    )


def command(base: Base, config: ExperimentConfig) -> str:
    """The command line that runs the same; empty where none can say it."""
    before, after = typed_values(base.config), typed_values(config)
    words = ["pemviz", "record", *base.options]
    for key, text in after.items():
        if text == before[key]:
            continue
        if key == RULE:
            for rule in config.rules:
                words += ["--rule", f"{rule.name}={rule.formula}"]
            words += [] if config.rules else _option(key="spec", text=config.spec)
        elif key == START:
            given = {one.name: one.distribution for one in config.start}
            if any(one.name not in given for one in base.config.start):
                return ""
            words += [w for name, drawn in given.items() for w in ("--start", f"{name}={drawn}")]
        elif text in ("true", "false"):
            table, dot, name = key.rpartition(".")
            words.append(f"--{table}{dot}{'no-' * (text == 'false')}{name}".replace("_", "-"))
        else:
            words += _option(key=key, text=text or "None")
    return shlex.join(words)


def _option(*, key: str, text: str) -> list[str]:
    name = f"--{key.replace('_', '-')}"
    return [f"{name}={text}"] if text.startswith("-") else [name, text]
