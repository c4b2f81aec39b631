"""The Experiment tab: what to run, in controls and in words; Run and Stop."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import cast, get_args

import viser

from pemviz.config import METHODS, ExperimentConfig, MetricName
from pemviz.config.encounters import NO_LOGICAL_SCENARIO, start_values
from pemviz.config.rule_words import read_rules, rules_text
from pemviz.config.toml_files import load_preset, preset_names
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.errors import InputError
from pemviz.panel.browser import Browser, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.experiment_controls import (
    EncounterControls,
    PerceptionControls,
    asked_simulator,
    check_encounter,
    check_measured,
    hint,
    limits,
)
from pemviz.panel.page import block, good, grid, quiet
from pemviz.pem import shipped_pems
from pemviz.reports.html import warning
from pemviz.runs.specification import build_formula
from pemviz.sampling.registry import by_name
from pemviz.simulators.registry import simulator_names

WORDS = {
    "braking": "a lead car brakes",
    "cut-in": "a car cuts in ahead of the ego",
    "cut-out": "a lead car leaves the lane and reveals a slower one",
}


def scenario_text(config: ExperimentConfig) -> str:
    """The scenario in a sentence."""
    if config.encounter.logical_scenario != NO_LOGICAL_SCENARIO:
        return encounter_text(config)
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


def encounter_text(config: ExperimentConfig) -> str:
    """The logical scenario in a sentence, and what is drawn for each encounter."""
    encounter, chosen = config.encounter, {one.name: one.distribution for one in config.start}
    tracker = config.scenario.tracker
    tracked = "" if tracker == NO_TRACKER else f" It acts on a tracker ({tracker})."
    end_s = (encounter.states - 1) * encounter.dt_s
    lines = [
        [
            value.name.replace("_", " "),
            escape(chosen.get(value.name, value.distribution)),
            value.unit,
        ]
        for value in start_values(encounter)
    ]
    return block(
        quiet(
            f"Logical scenario {encounter.logical_scenario}: "
            f"{WORDS[encounter.logical_scenario]}. The ego "
            "keeps its speed and a gap, and brakes hard at "
            f"{encounter.hard_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO} when the time to "
            f"collision is too small.{tracked} {encounter.states} states, {encounter.dt_s:g} s "
            f"apart ({end_s:.1f} s). Drawn for each encounter:"
        )
        + grid(["start value", "distribution", ""], lines, name="Start values")
    )


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
FRAILTY_STEP = 0.05
MEMORY_STEP_S = 0.01
TARGET_WORDS = " Empty: none."
WAITS = "Run waits until what is said below to be wrong is mended."
LIMIT_HINT = (
    "Limit of a gate: beside the answer it is told whether the upper 95 % bound stays below it, as "
    "pemviz record --fail-above does; above 0, at most 1. Empty: none."
)
RULES_HINT = (
    "Rules by name, a line NAME = FORMULA each, in place of the specification: each is answered, "
    "and any of them. Empty: the specification alone."
)
MOST_ENCOUNTERS = 1e6
LARGEST_EXACT = 2**53 - 1  # a browser holds no larger whole number exactly


class ExperimentTab:
    """Controls of an experiment; this browser's own."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._base = load_preset(FIRST_PRESET)
        self._running = self._wrong = False
        self._add_buttons()
        self._add_choices()
        self._add_numbers()
        self._add_specification()
        self._fill(self._base)

    @property
    def config(self) -> ExperimentConfig:
        """What the controls say; what is wrong between them is told when the run is built.

        Raises:
            InputError: What was typed as a target is no probability.
        """
        settings = replace(
            self._base,
            method=self.method.value,
            metric=cast(MetricName, self.metric.value),
            alpha=self._alpha(),
            sigma=self.sigma.value,
            stages=self.stages.value,
            rollouts=self.rollouts.value,
            final_rollouts=self.final_rollouts.value,
            seed=self.seed.value,
            pem=self.pem.value,
            simulator=self.simulator.value,
            memory_s=float(self.memory.value),
            frailty=float(self.frailty.value),
            target=self._target(),
            encounters_per_hour=self._encounters(),
            memory_curve=self.memory_curve.value,
            reference=self.reference.value,
            spec=self.spec.value,
            rules=(),
        )
        settings = self.encounter.into(self.perception.into(settings))
        return settings.with_rules(self._rules())

    def _rules(self) -> Mapping[str, str]:
        """The rules typed, name to formula.

        Raises:
            InputError: A line is no rule.
        """
        return read_rules([line for line in self.rules.value.splitlines() if line.strip()])

    def _target(self) -> float | None:
        return read_number(self.target.value, name="target")

    def _fail_above(self) -> float | None:
        return read_number(self.fail_above.value, name="fail above")

    def _encounters(self) -> float | None:
        most, name = MOST_ENCOUNTERS, "encounters per hour"
        return read_number(self.encounters.value, name=name, most=most)

    def refresh(self, state: PanelState) -> None:
        """Run is possible while nothing runs and nothing is wrong, Stop while something runs."""
        self._running = state.running
        self._enable_run()
        idle = not state.running or state.stopping
        if self.stop.disabled != idle:
            self.stop.disabled = idle

    @property
    def limit(self) -> float | None:
        """What the upper bound must not exceed; ``None`` where nothing sensible is said."""
        try:
            return self._fail_above()
        except InputError:
            return None

    def show(self, config: ExperimentConfig) -> None:
        """Fill the controls with another run's settings."""
        self._base = config
        self._fill(config)

    def _add_buttons(self) -> None:
        gui, browser = self._browser.client.gui, self._browser
        self.run = gui.add_button("Run", icon=viser.Icon.PLAYER_PLAY, color="blue", hint=RUN_HINT)
        self.stop = gui.add_button(
            "Stop", icon=viser.Icon.PLAYER_STOP, color="red", disabled=True, hint=STOP_HINT
        )
        self._waits = gui.add_html("")
        self.run.on_click(browser.on(self._run))
        self.stop.on_click(browser.on(browser.hub.controller.stop))

    def _add_choices(self) -> None:
        gui, browser = self._browser.client.gui, self._browser
        self.preset = gui.add_dropdown(
            "Preset", preset_names(), initial_value=FIRST_PRESET, hint=PRESET_HINT
        )
        self.method = gui.add_dropdown("Method", METHODS.names(), hint=hint("method"))
        self.metric = gui.add_dropdown("Metric", get_args(MetricName), hint=hint("metric"))
        self.preset.on_update(browser.on(self._choose_preset))
        self.method.on_update(browser.on(self._choose_parts))

    def _add_numbers(self) -> None:
        self.own_alpha = self._browser.client.gui.add_checkbox(
            "Method's own alpha", True, hint=OWN_ALPHA_HINT
        )
        self.own_alpha.on_update(self._browser.on(self._enable))
        self.alpha = self._float("alpha", "alpha", step=ALPHA_STEP)
        self.sigma = self._float("sigma", "sigma", step=SIGMA_STEP)
        self.stages = self._count("Stages", "stages")
        self.rollouts = self._count("Rollouts", "rollouts")
        self.final_rollouts = self._count("Final rollouts", "final_rollouts")
        self.seed = self._count("Seed", "seed")

    def _add_specification(self) -> None:
        gui, browser = self._browser.client.gui, self._browser
        self.pem = gui.add_dropdown("Error model", tuple(shipped_pems()), hint=hint("pem"))
        low_s, high_s = limits("memory_s", step=MEMORY_STEP_S)
        self.memory = gui.add_number(
            "Memory [s]", 0.0, min=low_s, max=high_s, step=MEMORY_STEP_S, hint=hint("memory_s")
        )
        low, high = limits("frailty", step=FRAILTY_STEP)
        self.frailty = gui.add_number(
            "Frailty", 0.0, min=low, max=high, step=FRAILTY_STEP, hint=hint("frailty")
        )
        self.simulator = gui.add_dropdown("Simulator", simulator_names(), hint=hint("simulator"))
        self.perception = PerceptionControls(gui, browser.on(self._choose_parts))
        self.encounter = EncounterControls(gui, browser.on(self._check))
        self.memory_curve = gui.add_checkbox("Memory curve", False, hint=hint("memory_curve"))
        self.reference = gui.add_checkbox("Reference", False, hint=hint("reference"))
        self.target = gui.add_text("Target", "", hint=hint("target") + TARGET_WORDS)
        self.encounters = gui.add_text(
            "Encounters per hour", "", hint=hint("encounters_per_hour") + TARGET_WORDS
        )
        self.fail_above = gui.add_text("Fail above", "", hint=LIMIT_HINT)
        self.spec = gui.add_text("Specification", "", multiline=True, hint=hint("spec"))
        self.rules = gui.add_text("Rules", "", multiline=True, hint=RULES_HINT)
        self._verdict = gui.add_html("")
        self._facts = gui.add_html("")
        for typed in (
            self.spec, self.rules, self.target, self.encounters, self.stages, self.rollouts,
            self.final_rollouts, self.seed, self.memory, self.frailty,
        ):  # fmt: skip
            typed.on_update(browser.on(self._check))
        for chosen in (self.simulator, self.reference):
            chosen.on_update(browser.on(self._choose_parts))
        self.fail_above.on_update(browser.on(self._judge))

    def _float(self, label: str, name: str, *, step: float) -> viser.GuiSliderHandle[float]:
        low, high = limits(name, step=step)
        initial = low if getattr(self._base, name) is None else getattr(self._base, name)
        return self._browser.client.gui.add_slider(label, low, high, step, initial, hint=hint(name))

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

    def _choose_preset(self) -> None:
        self.show(load_preset(self.preset.value))

    def _choose_parts(self) -> None:
        """What there is to choose beside them, and what fits, may be different."""
        self._enable()
        self._check()

    def _fill(self, config: ExperimentConfig) -> None:
        if config.method not in self.method.options:
            self.method.options = (*self.method.options, config.method)
        self.method.value, self.metric.value = config.method, config.metric
        self._fill_alpha(config)
        self.sigma.value = config.sigma
        self.stages.value, self.rollouts.value = config.stages, config.rollouts
        self.final_rollouts.value, self.seed.value = config.final_rollouts, config.seed
        if config.pem not in self.pem.options:
            self.pem.options = (*self.pem.options, config.pem)
        if config.simulator not in self.simulator.options:
            self.simulator.options = (*self.simulator.options, config.simulator)
        self.pem.value, self.simulator.value = config.pem, config.simulator
        self.frailty.value = config.frailty
        self.memory.value, self.memory_curve.value = config.memory_s, config.memory_curve
        self.reference.value, self.rules.value = config.reference, rules_text(config.rules)
        self.spec.value = config.spec
        self.target.value = "" if config.target is None else f"{config.target:g}"
        encounters = config.encounters_per_hour
        self.encounters.value = "" if encounters is None else f"{encounters:g}"
        self.encounter.fill(config)
        self.perception.fill(config)
        self._choose_parts()

    def _fill_alpha(self, config: ExperimentConfig) -> None:
        own = by_name(config.method).alpha
        self.own_alpha.value = config.alpha is None
        self.alpha.value = config.alpha if config.alpha is not None else own or ALPHA_AT_FIRST

    def _alpha(self) -> float | None:
        """What the controls say; ``None`` where this is what the method does by itself."""
        own = by_name(self.method.value).alpha
        left_out = self.own_alpha.value if own is None else self.alpha.value == own
        return None if left_out else self.alpha.value

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
            if control.visible != shown:
                control.visible = shown
        logical_scenario = self.encounter.chosen
        self.perception.offer(self.simulator.value, errors=not logical_scenario)
        for control in (self.frailty, self.memory_curve, self.reference):
            if (
                control.visible == logical_scenario
            ):  # not with several obstacles, nor without a twin
                control.visible = not logical_scenario
        for name, control in (
            ("stages", self.stages),
            ("rollouts", self.rollouts),
            ("final_rollouts", self.final_rollouts),
        ):
            if control.disabled == (name in used):
                control.disabled = name not in used

    def _enable_run(self) -> None:
        disabled = self._running or self._wrong
        if self.run.disabled != disabled:
            self.run.disabled = disabled

    def _judge(self) -> None:
        """The limit of the gate has changed."""
        self._check()
        self._browser.refresh()

    def _check(self) -> None:
        """Say what is wrong with what was typed, and have Run wait until it is right."""
        self.spec.disabled = bool(self.rules.value.strip())
        complaints = list(self._complaints())
        self._wrong = bool(complaints)
        if not self._wrong:
            set_html(self._facts, scenario_text(self.config))
        set_html(self._verdict, verdict(complaints, rules=self.spec.disabled))
        set_html(self._waits, block(quiet(WAITS)) if complaints else "")
        self._enable_run()

    def _complaints(self) -> Iterator[str]:
        """What is wrong, a line each."""
        wrong = False
        yield from self._misunderstood()
        for read in (self._target, self._encounters, self._fail_above):
            try:
                read()
            except InputError as error:
                wrong = True
                yield str(error)
        if not wrong:
            try:
                self.config.validate()
                check_measured(self.config)
                check_encounter(self.config)
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
            simulator = asked_simulator(plain)
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


def read_number(typed: str, *, name: str, most: float = 1.0) -> float | None:
    """A number above 0, as a probability is, as it was typed; ``None`` for an empty field.

    Raises:
        InputError: It is no number above 0 and at most ``most``.
    """
    if not typed.strip():
        return None
    try:
        value = float(typed)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= most:
        allowed = f"above 0 and at most {most:g}"
        message = f"{name} = {typed.strip()[:40]!r}: must be {allowed}, or empty"
        raise InputError(message)
    return value


def verdict(complaints: Sequence[str], *, rules: bool = False) -> str:
    """What is wrong with what was typed; the specification itself is not repeated."""
    if not complaints:
        return block(good(f"The {'rules are' if rules else 'specification is'} understood."))
    lines = "".join(warning(words) for words in complaints)
    return block(f"<div role='alert'>{lines}</div>")
