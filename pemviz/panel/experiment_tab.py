"""The Experiment tab: what to run, in controls and in words; Run and Stop."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import viser

from pemviz.config import METHODS, ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO, start_values
from pemviz.config.rule_words import read_rules, rules_text
from pemviz.config.toml_files import load_preset, preset_names
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.errors import InputError
from pemviz.panel.browser import Browser
from pemviz.panel.controller import PanelState
from pemviz.panel.experiment_controls import (
    EncounterControls,
    PerceptionControls,
    check_back_end,
    hint,
    limits,
    plain_simulator,
)
from pemviz.panel.page import block, quiet
from pemviz.panel.ranking import METRIC_NAMES
from pemviz.pem import shipped_pems
from pemviz.reports.document import Paragraph, Table, Verdict
from pemviz.reports.html import blocks_html, warning
from pemviz.runs.specification import build_formula
from pemviz.sampling.registry import by_name
from pemviz.simulators.registry import simulator_names

WORDS = {
    "braking": "a lead car brakes",
    "cut-in": "a car cuts in ahead of the ego",
    "cut-out": "a lead car leaves the lane and reveals a slower one",
}
FIRST_PRESET = "paper"
PRESET_HINT = (
    "Shipped configuration that fills in all controls and the scenario: paper (70 km/h, lead car "
    "brakes at 0.3 g), town01 (30 km/h, lead car brakes hard), paper-algorithm (paper, with the "
    "paper's own method), or a logical scenario with random starts: braking, cut-in, cut-out."
)
RUN_HINT = "Run what is set up below. One experiment runs at a time; all browsers see it."
STOP_HINT = "Stop after the present batch of rollouts; what is finished is kept."
OWN_ALPHA_HINT = (
    "The method chooses the exponent that smooths the training weights at each stage; without the "
    "tick it is the alpha below."
)
ALPHA_AT_FIRST = 0.1
ALPHA_STEP, SIGMA_STEP = 0.01, 0.005
LEFT_OUT_WORDS = " Empty: left out."
EMPTY = " Empty: none."
TYPED = {
    "precision": "precision",
    "max_rollouts": "rollouts at most",
    "max_minutes": "minutes at most",
    "memory_s": "memory",
    "frailty": "frailty",
    "target": "target",
    "encounters_per_hour": "encounters per hour",
}
"""Numbers that may be left out, by field: what messages call them."""
MAY_BE_ZERO = ("memory_s", "frailty")
WAITS = "Run waits until what is said below to be wrong is fixed."
LIMIT_HINT = (
    "Limit of a gate: beside the answer it is told whether the upper 95 % bound stays below it, as "
    "pemviz record --fail-above does; above 0, at most 1. Empty: none."
)
RULES_HINT = (
    "Rules by name, a line NAME = FORMULA each, in place of the specification: each is answered, "
    "and any of them. Empty: the specification alone."
)
LARGEST_EXACT = 2**53 - 1  # a browser holds no larger whole number exactly


def scenario_text(config: ExperimentConfig) -> str:
    """The scenario in a sentence; of a logical one also what is drawn for each encounter."""
    if config.encounter.logical_scenario != NO_LOGICAL_SCENARIO:
        return _encounter_text(config)
    scenario, errors = config.scenario, config.position_errors
    end_s = (scenario.states - 1) * scenario.dt_s
    measured = "" if errors is None else f", measured with errors of {Path(errors).name},"
    follows = "" if scenario.tracker == NO_TRACKER else f", by a tracker ({scenario.tracker}),"
    return block(
        quiet(
            f"Scenario: both cars drive {scenario.initial_speed_kmh:g} km/h, "
            f"{scenario.initial_gap_m:g} m apart, when the lead car brakes at "
            f"{scenario.lead_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}. "
            f"A detection{follows} below {scenario.emergency_gap_m:g} m{measured} makes the ego "
            f"brake at {scenario.emergency_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}. "
            f"{scenario.states} states, {scenario.dt_s:g} s apart ({end_s:.2f} s)."
        )
    )


def _encounter_text(config: ExperimentConfig) -> str:
    encounter, chosen = config.encounter, {one.name: one.distribution for one in config.start}
    tracker = config.scenario.tracker
    tracked = "" if tracker == NO_TRACKER else f" It acts on a tracker ({tracker})."
    end_s = (encounter.states - 1) * encounter.dt_s
    words = (
        f"Logical scenario {encounter.logical_scenario}: {WORDS[encounter.logical_scenario]}. "
        "The ego keeps its speed and a gap, and brakes hard at "
        f"{encounter.hard_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO} when the time to "
        f"collision is too small.{tracked} {encounter.states} states, {encounter.dt_s:g} s "
        f"apart ({end_s:.1f} s). Drawn for each encounter:"
    )
    rows = tuple(
        (value.name.replace("_", " "), chosen.get(value.name, value.distribution), value.unit)
        for value in start_values(encounter)
    )
    drawn = Table(("start value", "distribution", ""), rows, name="Start values")
    return block(blocks_html([Paragraph(words, tone="quiet"), drawn]))


class ExperimentTab:
    """Controls of an experiment; this browser's own."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._base = load_preset(FIRST_PRESET)
        self._running = self._wrong = False
        self._add_choices()
        self._add_specification()
        self._plain: dict[str, Any] = {
            "method": self.method, "metric": self.metric, "sigma": self.sigma,
            "stages": self.stages, "rollouts": self.rollouts,
            "final_rollouts": self.final_rollouts, "seed": self.seed, "pem": self.pem,
            "simulator": self.simulator,
            "memory_curve": self.memory_curve, "reference": self.reference, "spec": self.spec,
        }  # fmt: skip
        """Controls by the field of a configuration whose value they hold as it is."""
        self._fill(self._base)

    @property
    def config(self) -> ExperimentConfig:
        """What the controls say; what is wrong between them is told when the run is built.

        Raises:
            InputError: What was typed as a target is no probability.
        """
        method, alpha = by_name(self.method.value), self.alpha.value
        own = self.own_alpha.value if method.alpha is None else alpha == method.alpha
        settings = replace(
            self._base,
            **{name: control.value for name, control in self._plain.items()},
            alpha=None if own else alpha,
            rules=(),
            **{name: self._typed_number(name) for name in TYPED},
        )
        settings = self.encounter.into(self.perception.into(settings))
        return settings.with_rules(self._rules())

    def _typed_number(self, name: str) -> float | None:
        """What was typed, left out what the configuration has then."""
        most, zero = limits(name, step=0)[1], name in MAY_BE_ZERO
        number = read_number(self._typed[name].value, name=TYPED[name], most=most, zero=zero)
        if number is None:
            return getattr(ExperimentConfig(), name)
        return int(number) if name == "max_rollouts" else number

    def _rules(self) -> Mapping[str, str]:
        return read_rules([line for line in self.rules.value.splitlines() if line.strip()])

    def refresh(self, state: PanelState) -> None:
        """Run is possible while nothing runs and nothing is wrong, Stop while something runs."""
        self._running = state.running
        self.run.disabled = self._running or self._wrong
        self.stop.disabled = not state.running or state.stopping

    @property
    def limit(self) -> float | None:
        """What the upper bound must not exceed; ``None`` where nothing sensible is said."""
        try:
            return read_number(self.fail_above.value, name="fail above")
        except InputError:
            return None

    def show(self, config: ExperimentConfig) -> None:
        """Fill the controls with another run's settings."""
        self._base = config
        self._fill(config)

    def _add_choices(self) -> None:
        gui, browser = self._browser.client.gui, self._browser
        self.run = gui.add_button("Run", icon=viser.Icon.PLAYER_PLAY, color="blue", hint=RUN_HINT)
        self.stop = gui.add_button(
            "Stop", icon=viser.Icon.PLAYER_STOP, color="red", disabled=True, hint=STOP_HINT
        )
        self._waits = gui.add_html("")
        self.preset = gui.add_dropdown(
            "Preset", preset_names(), initial_value=FIRST_PRESET, hint=PRESET_HINT
        )
        self.method = gui.add_dropdown("Method", METHODS.names(), hint=hint("method"))
        self.metric = gui.add_dropdown("Metric", METRIC_NAMES, hint=hint("metric"))
        self.own_alpha = gui.add_checkbox("Method's own alpha", True, hint=OWN_ALPHA_HINT)
        self.alpha = self._float("alpha", step=ALPHA_STEP)
        self.sigma = self._float("sigma", step=SIGMA_STEP)
        self.stages = self._count("Stages", "stages")
        self.rollouts = self._count("Rollouts", "rollouts")
        self.final_rollouts = self._count("Final rollouts", "final_rollouts")
        self._typed = {
            name: gui.add_text(TYPED[name].capitalize(), "", hint=hint(name))
            for name in ("precision", "max_rollouts", "max_minutes")
        }
        self.seed = self._count("Seed", "seed")
        self.run.on_click(browser.on(self._run))
        self.stop.on_click(browser.on(browser.hub.controller.stop))
        self.preset.on_update(browser.on(lambda: self.show(load_preset(self.preset.value))))
        self.method.on_update(browser.on(self._choose_parts))
        self.own_alpha.on_update(browser.on(self._enable))

    def _add_specification(self) -> None:
        gui, browser = self._browser.client.gui, self._browser
        self.pem = gui.add_dropdown("Error model", tuple(shipped_pems()), hint=hint("pem"))
        for name, label in (("memory_s", "Memory [s]"), ("frailty", "Frailty")):
            self._typed[name] = gui.add_text(label, "", hint=hint(name) + LEFT_OUT_WORDS)
        self.simulator = gui.add_dropdown("Simulator", simulator_names(), hint=hint("simulator"))
        self.perception = PerceptionControls(gui, browser.on(self._choose_parts))
        self.encounter = EncounterControls(gui, browser.on(self._check))
        self.memory_curve = gui.add_checkbox("Memory curve", False, hint=hint("memory_curve"))
        self.reference = gui.add_checkbox("Reference", False, hint=hint("reference"))
        for name in ("target", "encounters_per_hour"):
            words = hint(name) + EMPTY
            self._typed[name] = gui.add_text(TYPED[name].capitalize(), "", hint=words)
        self.fail_above = gui.add_text("Fail above", "", hint=LIMIT_HINT)
        self.spec = gui.add_text("Specification", "", multiline=True, hint=hint("spec"))
        self.rules = gui.add_text("Rules", "", multiline=True, hint=RULES_HINT)
        self._verdict = gui.add_html("")
        self._facts = gui.add_html("")
        for typed in (
            self.spec, self.rules, self.stages, self.rollouts, self.final_rollouts, self.seed,
            *self._typed.values(),
        ):  # fmt: skip
            typed.on_update(browser.on(self._check))
        for chosen in (self.simulator, self.reference):
            chosen.on_update(browser.on(self._choose_parts))
        self.fail_above.on_update(browser.on(self._judge))

    def _float(self, name: str, *, step: float) -> viser.GuiSliderHandle[float]:
        low, high = limits(name, step=step)
        return self._browser.client.gui.add_slider(name, low, high, step, low, hint=hint(name))

    def _count(self, label: str, name: str) -> viser.GuiNumberHandle[int]:
        low, high = limits(name, step=1)
        return self._browser.client.gui.add_number(
            label,
            int(getattr(self._base, name)),
            min=int(low),
            max=min(int(high), LARGEST_EXACT),
            step=1,
            hint=hint(name),
        )

    def _choose_parts(self) -> None:
        """What there is to choose beside them, and what fits, may be different."""
        self._enable()
        self._check()

    def _fill(self, config: ExperimentConfig) -> None:
        for dropdown, value in (
            (self.method, config.method), (self.pem, config.pem),
            (self.simulator, config.simulator),
        ):  # fmt: skip
            if value not in dropdown.options:
                dropdown.options = (*dropdown.options, value)
        for name, control in self._plain.items():
            control.value = getattr(config, name)
        self.own_alpha.value = config.alpha is None
        own = by_name(config.method).alpha
        self.alpha.value = config.alpha if config.alpha is not None else own or ALPHA_AT_FIRST
        self.rules.value = rules_text(config.rules)
        for name, text in self._typed.items():
            number = getattr(config, name)
            text.value = "" if number is None else f"{number:.15g}"
        self.encounter.fill(config)
        self.perception.fill(config)
        self._choose_parts()

    def _enable(self) -> None:
        """Grey out what the method does not use; a slider's box cannot be, so sliders go."""
        method = by_name(self.method.value)
        used = method.settings
        chooses = "alpha" in used and method.alpha is None
        for control, shown in (
            (self.own_alpha, chooses),
            (self.alpha, "alpha" in used and not (chooses and self.own_alpha.value)),
            (self.sigma, "sigma" in used),
        ):
            control.visible = shown
        logical_scenario = self.encounter.chosen
        self.perception.offer(self.simulator.value, errors=not logical_scenario)
        for control in (self._typed["frailty"], self.memory_curve, self.reference):
            control.visible = not logical_scenario  # none with several obstacles, without a twin
        for name in ("stages", "rollouts", "final_rollouts"):
            self._plain[name].disabled = name not in used
        for name in ("precision", "max_rollouts", "max_minutes"):
            self._typed[name].visible = name in used

    def _judge(self) -> None:
        self._check()
        self._browser.refresh()

    def _check(self) -> None:
        """Say what is wrong with what was typed, and have Run wait until it is right."""
        self.spec.disabled = bool(self.rules.value.strip())
        complaints = list(self._complaints())
        self._wrong = bool(complaints)
        if not self._wrong:
            self._facts.content = scenario_text(self.config)
        self._verdict.content = verdict(complaints, rules=self.spec.disabled)
        self._waits.content = block(quiet(WAITS)) if complaints else ""
        self.run.disabled = self._running or self._wrong

    def _complaints(self) -> Iterator[str]:
        wrong = False
        yield from self._misunderstood()
        for text, words, name in (
            *((self._typed[name], words, name) for name, words in TYPED.items()),
            (self.fail_above, "fail above", "target"),
        ):
            most, zero = limits(name, step=0)[1], name in MAY_BE_ZERO
            try:
                read_number(text.value, name=words, most=most, zero=zero)
            except InputError as error:
                wrong = True
                yield str(error)
        if not wrong:
            try:
                self.config.validate()
                check_back_end(self.config)
            except InputError as error:
                yield str(error)

    def _misunderstood(self) -> Iterator[str]:
        """What is wrong with the rules or, without any, with the specification."""
        try:
            rules = self._rules()
        except InputError:  # told with the rest
            return
        try:
            plain = replace(self.encounter.into(self._base), rules=())
            simulator = plain_simulator(plain)
        except InputError as error:
            yield str(error)
            return
        for name, formula in rules.items() if rules else (("", self.spec.value),):
            try:
                build_formula(replace(plain, spec=formula), simulator)
            except InputError as error:
                said = str(error).removeprefix(f"spec = {formula!r}: ")
                yield f"rule {name}: {said}" if name else said

    def _run(self) -> None:
        browser = self._browser
        config = self.config
        config.validate()
        if not browser.hub.controller.start(config):
            browser.tell("Not started", "Another experiment is running; stop it first.")
            return
        browser.look_at(None)


def read_number(typed: str, *, name: str, most: float = 1.0, zero: bool = False) -> float | None:
    """A number above 0 as it was typed, 10% for 0.1; ``None`` for an empty field.

    Args:
        typed: What stands in the field.
        name: Of the field, for messages.
        most: The largest allowed.
        zero: Whether 0 is allowed too.

    Raises:
        InputError: It is no number that is allowed.
    """
    if not typed.strip():
        return None
    number, is_percentage = typed.strip().removesuffix("%"), typed.strip().endswith("%")
    try:
        value = float(number) / (100.0 if is_percentage else 1.0)
    except ValueError:
        value = math.nan
    if not (0.0 < value <= most or (zero and value == 0.0)):
        allowed = f"{'0 or more' if zero else 'above 0'} and at most {most:g}"
        message = f"{name} = {typed.strip()[:40]!r}: must be {allowed}, or empty"
        raise InputError(message)
    return value


def verdict(complaints: Sequence[str], *, rules: bool = False) -> str:
    """What is wrong with what was typed; the specification itself is not repeated."""
    if not complaints:
        words = f"The {'rules are' if rules else 'specification is'} understood."
        return block(blocks_html([Verdict("yes", words)]))
    lines = "".join(warning(words) for words in complaints)
    return block(f"<div role='alert'>{lines}</div>")
