"""The configuration of a run: every number that shapes a result, with unit and range."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, Self

from pemviz.config.encounters import (
    NO_LOGICAL_SCENARIO,
    EncounterConfig,
    Positive,
    StartChoice,
    start_values,
)
from pemviz.config.ranges import NamedPart, Range, check_fields, explains_fields, shown
from pemviz.config.tracker_text import NO_TRACKER, read_tracker
from pemviz.errors import ConfigError

METHODS = NamedPart(
    kind="method",
    group="pemviz.methods",
    shipped=(
        "auto",
        "adaptive",
        "mixture",
        "zero-variance",
        "splitting",
        "subset",
        "monte-carlo",
        "naive",
    ),
)
"""What each of them is: ``pemviz.sampling.registry``."""
MethodName = Annotated[str, METHODS]
MetricName = Literal["classical", "agm", "smooth-cumulative"]
KeepName = Literal["all", "violations"]
LostName = Literal["end", "violation", "none"]
MemoryLaw = Literal["outcomes", "visibility"]
SHIPPED_SIMULATORS = ("vectorized", "highway-env", "sumo")
"""Back ends of the shipped scenarios."""
BLACK_BOXES = ("merge",)
"""Environments of others that pemviz ships an adapter for; a preset of the same name has rules."""
CLIENTS = ("carla",)
"""Servers with a client of their own, on which the braking scenario is carried out."""

NotNegative = Range(low=0.0, high=1e6)
DEFAULT_ADDRESS = "127.0.0.1:2000"
"""CARLA's own port, on this machine."""
RULE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")
MOST_RULES = 20
WITHOUT_EFFECT = ("step_time_limit_s",)
"""Settings that results do not depend on: a run goes on with others."""
LIMITS = ("precision", "max_rollouts", "max_minutes")
"""Settings that say when a run is over: one goes on with others from where it ended."""


@dataclass(frozen=True)
class Rule:
    """One of several specifications that are answered by one run.

    Attributes:
        name: For tables and options: a letter, then up to 39 letters, digits, ``_`` or ``-``.
        formula: As ``spec``.
    """

    name: str
    formula: str


@explains_fields
@dataclass(frozen=True, kw_only=True)
class ScenarioConfig:
    """An ego car follows a braking lead car on a straight road.

    ``pemviz.simulators.braking`` says exactly how.
    """

    initial_speed_kmh: Annotated[float, Range(low=0.0, low_open=True, high=144.0)] = 70.0
    """Speed of both cars at the start, and the ego's target speed [km/h]; above 0, at most 144."""
    initial_gap_m: Annotated[float, Range(low=0.0, low_open=True, high=200.0)] = 15.0
    """Windscreen camera to the rear of the lead car at the start [m]; above 0, at most 200."""
    lead_deceleration_mps2: Annotated[float, Range(low=0.0, high=20.0)] = 2.943
    """The lead car's braking until it stands [m/s^2]; 0 to 20."""
    lead_brake_time_s: Annotated[float, NotNegative] = 0.0
    """When the lead car starts to brake [s]; 0 to 1e6."""
    emergency_gap_m: Annotated[float, Positive] = 10.0
    """A detection below this gap triggers emergency braking [m]; above 0, at most 1e6."""
    emergency_deceleration_mps2: Annotated[float, Range(low=0.0, low_open=True, high=20.0)] = 8.0
    """The ego's emergency braking [m/s^2]; above 0, at most 20."""
    speed_gain_per_s: Annotated[float, NotNegative] = 1.0
    """Proportional gain of the speed controller [1/s]; 0 to 1e6."""
    speed_integral_gain_per_s2: Annotated[float, NotNegative] = 0.05
    """Integral gain of the speed controller [1/s^2]; 0 to 1e6."""
    maximum_acceleration_mps2: Annotated[float, Range(low=0.0, high=20.0)] = 1.0
    """Upper limit of the speed controller [m/s^2]; 0 to 20."""
    maximum_deceleration_mps2: Annotated[float, Range(low=0.0, high=20.0)] = 3.0
    """Lower limit of the speed controller, as a positive number [m/s^2]; 0 to 20."""
    dt_s: Annotated[float, Range(low=0.001, high=1.0)] = 0.05
    """Time step [s]; 0.001 to 1."""
    states: Annotated[int, Range(low=2, high=100_000)] = 100
    """States in a rollout (T); perception acts at all but the last; 2 to 100000."""
    camera_height_m: Annotated[float, Range(low=0.0, low_open=True, high=100.0)] = 1.65
    """Camera above the road, the y that the perception error model sees [m]; above 0 to 100."""
    lead_length_m: Annotated[float, Range(low=0.0, low_open=True, high=30.0)] = 5.0
    """Length of the lead car; its centre lies half of it beyond the gap [m]; above 0 to 30."""
    gap_bound_m: Annotated[float, Positive] = 25.0
    """The agm metric normalises gaps from minus to plus this value [m]; above 0 to 1e6."""
    speed_bound_mps: Annotated[float, Positive] = 40.0
    """The agm metric normalises speeds from 0 to this value [m/s]; above 0 to 1e6."""
    tracker: str = NO_TRACKER
    """Tracker between perception and controller: none, or M/N: the lead car is tracked once M of
    the last N outcomes detected it, and the ego brakes for a tracked car. Options behind it,
    separated by commas: coast=SECONDS that a track stays without a detection; filter=none,
    alpha-beta or kalman, of the gap; alpha=, beta=; position-sd= [m], acceleration-sd= [m/s^2],
    speed-sd= [m/s]. For instance 2/3,coast=0.5,filter=kalman."""

    @property
    def initial_speed_mps(self) -> float:
        """Speed of both cars at the start [m/s]."""
        return self.initial_speed_kmh / 3.6


@explains_fields
@dataclass(frozen=True, kw_only=True)
class SumoConfig:
    """With simulator sumo; ``pemviz.simulators.sumo`` says exactly."""

    model: Literal["idm", "krauss", "acc"] = "idm"
    """Car-following model of SUMO's that the encounter's other cars drive by: idm (intelligent
    driver model), krauss (SUMO's default) or acc (adaptive cruise control)."""
    config: str | None = None
    """Traffic of SUMO's own, in place of encounters: free-traffic, which is shipped, or a .sumocfg
    file with the ego in it."""
    ego: str = "ego"
    """Which vehicle of that traffic is the ego: its id."""
    warm_up_s: Annotated[float, Range(low=0.0, high=10_000.0)] = 10.0
    """How long SUMO drives the ego in traffic, once it has entered, before a rollout begins [s]; 0
    to 10000."""
    step_s: Annotated[float, Range(low=0.001, high=1.0)] = 0.1
    """Time step in traffic [s], in place of the file's; whole milliseconds, 0.001 to 1."""
    states: Annotated[int, Range(low=2, high=100_000)] = 101
    """States in a rollout in traffic (T); perception acts at all but the last; 2 to 100000."""

    @property
    def dt_s(self) -> float:
        """Time step in traffic [s]."""
        return self.step_s


@explains_fields
@dataclass(frozen=True, kw_only=True)
class ExperimentConfig:
    """One experiment: scenario, specification, perception error model, method, seed."""

    method: MethodName = "auto"
    """How the failure probability is estimated: auto, mixture, adaptive, zero-variance, splitting,
    subset, monte-carlo, naive, or a name that an installed package registers as an entry point of
    the group pemviz.methods."""
    metric: MetricName = "classical"
    """Robustness metric that ranks rollouts and sets thresholds; whether a rollout violates is
    decided by the formula itself, > and < as strict as they are written. agm counts what
    position errors, latents or a tracker carry beyond its bounds as the bound."""
    spec: str = "always[0,99] (gap >= 2.0)"
    """Specification in Signal Temporal Logic over gap [m], ego_speed and lead_speed [m/s];
    intervals count steps. Where both sides are equal >= and <= hold, > and < fail."""
    rules: tuple[Rule, ...] = ()
    """Rules by name; each is answered, and any of them: ``spec`` then says that all are kept."""
    pem: str = "ml-nn"
    """Perception error model: a shipped name or a file."""
    memory_s: Annotated[float, Range(low=0.0, high=60.0)] | None = None
    """Memory time of misses [s]: after a miss, or a hit, the same is likelier again, the less so
    the longer ago, by exp(-time / memory_s); how often the error model misses in all is as
    without; 0 to 60. 0: misses are independent of each other given the state. Left out, the error
    model's own, and assumed_memory_s where it has none."""
    assumed_memory_s: Annotated[float, Range(low=0.0, high=60.0)] = 0.0
    """Memory time of misses [s] where memory_s is left out and the error model has none of its own;
    0 to 60."""
    frailty: Annotated[float, Range(low=0.0, high=5.0)] | None = None
    """How much obstacles differ in being missed beyond what the state says: each has a visibility
    of its own for as long as it is there, with this spread; how often the error model misses in
    all is as without; 0 to 5. 0: all are equal. Left out, the error model's own, and 0 where it has
    none, or with several slots."""
    memory_law: MemoryLaw = "outcomes"
    """What hangs together where misses do: outcomes, which are repeated (memory_s) by obstacles
    that differ (frailty); or visibility, of which a part lasts (frailty) and a part comes and goes
    (varying_frailty, varying_frailty_s): P(missed) then is the error model's in every frame,
    however fast the state changes, as of a detector that looks at each image anew. What is left out
    is the error model's own. One obstacle; not with memory_s."""
    varying_frailty: Annotated[float, Range(low=0.01, high=5.0)] | None = None
    """Spread of what comes and goes of an obstacle's visibility, with memory_law visibility; 0.01
    to 5."""
    varying_frailty_s: Annotated[float, Range(low=0.01, high=10.0)] | None = None
    """Time after which that has fallen to 1/e [s], with memory_law visibility; 0.01 to 10."""
    position_errors: str | None = None
    """Errors of the lead car's measured distance, in encounters of the place of every car, which
    the ego then brakes by: a shipped name (pointpillars, pointrcnn) or a file of 'pemviz pem fit
    --position-errors'. Left out, it is measured without error. Shipped back ends only; without
    method zero-variance and reference."""
    measured_memory: bool = True
    """Also report the failure probability with the memory of misses that was measured on video: the
    error model's own and the ends of its interval or, where it has none, that of two detectors;
    from half as many rollouts as the run's, 100 to 600, on a scenario with a fast twin and one
    slot."""
    memory_curve: bool = False
    """Also report the failure probability over memory times from 0 to 1 s and over frailties from 0
    to 1.2, from 2400 rollouts each of their own (on the fast twin where there is one)."""
    simulator: str = "vectorized"
    """Back end that steps the scenario: vectorized, highway-env, sumo (needs pemviz[sumo]), carla
    (needs pemviz[carla] and a server), or a name that an installed package registers as an entry
    point of the group pemviz.simulators."""
    surrogate: str | None = None
    """A fast simulator of about the same scenario, named as simulator is, that methods auto and
    mixture learn proposals on before they run the simulator itself, with the same settings. It may
    be wrong: the answer rests on rollouts of the simulator alone. Left out, none."""
    carla: str | None = None
    """With simulator carla: HOST:PORT of the server; left out, 127.0.0.1:2000."""
    alpha: Annotated[float, Range(low=0.0, high=1.0)] | None = None
    """Exponent that smooths the training weights; 0 to 1. It never enters an estimate. Left out,
    it is the method's own: the paper's 0.1 with adaptive; with mixture as large as the weights'
    effective sample size allows, at each stage anew."""
    sigma: Annotated[float, Range(low=0.95, high=1.0, high_open=True)] = 0.95
    """Elite quantile: a stage learns from the least robust 1 - sigma (mixture: while it looks for
    violations, counted by weight); at least 0.95, below 1."""
    precision: Annotated[float, Range(low=0.001, high=1.0)] = 0.2
    """Half-width of the 95 % interval, as a share of the answer, that method auto goes on for, of
    the answer to each rule that a rollout has broken; 0.001 to 1."""
    max_rollouts: Annotated[int, Range(low=10, high=100_000_000)] | None = None
    """Rollouts at most that method auto simulates, in all repetitions and searches; 10 to 100
    million. Left out, ten times those of stages, rollouts and final_rollouts are sampled from
    proposals at most, beside plain ones and what searches for failure modes."""
    max_minutes: Annotated[float, Range(low=0.0, low_open=True, high=1e5)] | None = None
    """Minutes that method auto means to take [min]; above 0, at most 1e5. Plain rollouts are cut
    off, what proposals sample is planned by what rollouts took so far. The answer of a seed then
    depends on how fast the machine is. Left out, none."""
    chains: Annotated[int, Range(low=0, high=100_000)] | None = None
    """Rollouts a level of the Markov chains that search for failure modes before mixture fits
    proposals; 0 to 100,000, 0: none do. Left out, 100 where rollouts begin at random, 200 where
    noise enters, but none in scenarios with slots, as the logical scenarios are, and in
    environments that are stepped one rollout at a time."""
    stages: Annotated[int, Range(low=1, high=1000)] = 10
    """Learning stages (K); 1 to 1000."""
    rollouts: Annotated[int, Range(low=2, high=1_000_000)] = 100
    """Rollouts a stage, pre-training included (N_kappa); 2 to 1000000. With mixture a stage of over
    10,000 (of 100 states) is over once 10,000 violate."""
    final_rollouts: Annotated[int, Range(low=2, high=1_000_000_000)] = 100
    """Rollouts that the estimate is formed from (N_e); 2 to 10000000, with monte-carlo and keep
    violations to 1000000000."""
    epochs: Annotated[int, Range(low=1, high=100_000)] = 500
    """Full-batch training steps of the proposal network at each stage; 1 to 100000."""
    learning_rate: Annotated[float, Range(low=0.0, low_open=True, high=1.0)] = 1e-3
    """Adam's step size; above 0, at most 1."""
    smooth_beta_per_m: Annotated[float, Range(low=0.0, low_open=True, high=1e6)] = 75.0
    """Sharpness of the smooth-cumulative metric [1/m]; above 0, at most 1e6."""
    naive_detection_probability: Annotated[
        float, Range(low=0.0, high=1.0, low_open=True, high_open=True)
    ] = 0.5
    """Constant detection probability that the naive method samples from; above 0 and below 1."""
    seed: Annotated[int, Range(low=0, high=2**63 - 1)] = 0
    """Root of all randomness; the same seed and config give the same result; 0 or more."""
    repetitions: Annotated[int, Range(low=1, high=100_000)] = 1
    """Independent repetitions, summarised by their mean; 1 to 100000."""
    step_time_limit_s: Annotated[float, Range(low=0.0, low_open=True, high=1e6)] = 600.0
    """A step of the rollouts that are simulated at a time which takes longer fails the run [s];
    with workers, a rollout, once it was tried three times. Results do not depend on it, and a
    stopped run goes on with another; above 0, at most 1e6."""
    lost: LostName = "end"
    """What a rollout counts as that cannot be simulated in three tries, as the simulator raises
    something in a step or, with workers, ends its process or stalls: end, the run ends, and names
    it; violation, it violates; none, it does not, unless it had before. The answer says how many
    there were, and what it would be if they counted otherwise."""
    reference: bool = False
    """Also compute the answer by the zero-variance reference, to compare with."""
    target: Annotated[float, Range(low=0.0, low_open=True, high=1.0)] | None = None
    """Failure probability to bring the system below: reports by which factor misses would have to
    become rarer, for each distance band, and with memory_s to what the memory time would have to
    fall; above 0, at most 1."""
    encounters_per_hour: Annotated[float, Range(low=0.0, low_open=True, high=1e6)] | None = None
    """How many encounters such as the scenario's an hour of driving holds on average [1/h]: also
    report violations an hour and the hours of driving between them; above 0, at most 1e6."""
    plan: bool = False
    """Also report what to measure next: the cheapest labels that would show the target (without
    one, a failure probability halfway to what the labels at hand allow), labels that would halve
    the range over refits, tracked sequences that would fix the memory time; a few seconds."""
    keep: KeepName = "all"
    """Which rollouts the run folder keeps: all, or violations: of the final rollouts those that
    violate and the twenty least robust of each stage; learning stages are kept whole, of large
    ones (of 100 states over 20,000 rollouts with adaptive, over 10,000 with mixture) the 5,000 or
    12,500 least robust and an even sample. Results are the same; a final stage not kept whole is
    simulated again when a stopped run goes on."""
    scenario: ScenarioConfig = field(default_factory=ScenarioConfig)
    """The scenario's parameters."""
    encounter: EncounterConfig = field(default_factory=EncounterConfig)
    """A logical scenario in place of the scenario, whose tracker it has."""
    start: tuple[StartChoice, ...] = ()
    """Start values of the encounter with other distributions than the logical scenario's."""
    sumo: SumoConfig = field(default_factory=SumoConfig)
    """Of simulator sumo."""

    @property
    def is_braking_scenario(self) -> bool:
        """Whether it is about the one gap of the shipped braking scenario."""
        is_shipped = self.simulator in SHIPPED_SIMULATORS and not self.is_sumo_traffic
        return is_shipped and not self.is_encounter

    @property
    def is_encounter(self) -> bool:
        """Whether it is about a logical scenario."""
        return self.encounter.logical_scenario != NO_LOGICAL_SCENARIO

    @property
    def is_sumo_traffic(self) -> bool:
        """Whether it is about traffic of SUMO's own."""
        return self.simulator == "sumo" and self.sumo.config is not None

    @property
    def other_scenario(self) -> str:
        """In words, of what is not the braking scenario."""
        if self.is_sumo_traffic:
            traffic = f"traffic of {self.sumo.config}, in SUMO"
            return f"{traffic}, whose vehicle {self.sumo.ego} is the ego"
        if self.is_encounter:
            return f"logical scenario {self.encounter.logical_scenario}, on {self.simulator}"
        return f"that of the simulator {self.simulator}"

    @property
    def dt_s(self) -> float:
        """Time step of what is shipped [s]."""
        return self._timed.dt_s

    @property
    def states(self) -> int:
        """States in a rollout of what is shipped (T)."""
        return self._timed.states

    @property
    def _timed(self) -> ScenarioConfig | EncounterConfig | SumoConfig:
        if self.is_sumo_traffic:
            return self.sumo
        return self.encounter if self.is_encounter else self.scenario

    def with_rules(self, rules: Mapping[str, str]) -> Self:
        """The same with rules, formulas by name, instead of one specification; none: as it is."""
        if not rules:
            return self
        named = tuple(Rule(name, formula) for name, formula in rules.items())
        return replace(self, rules=named, spec=conjunction(named))

    def validate(self) -> None:
        """Check every value and those that must fit together.

        Raises:
            ConfigError: One line that names field, value and what is allowed.
        """
        check_fields(self)
        read_tracker(self.scenario.tracker)
        self._validate_memory_law()
        self._validate_rules()
        self._validate_encounter()
        self._validate_sumo()
        self._validate_carla()
        if not self.pem.strip():
            raise ConfigError("pem = '': must be the name of a shipped model or a file")
        if not self.simulator.strip():
            message = f"simulator = '': must be {', '.join(SHIPPED_SIMULATORS)} or registered"
            raise ConfigError(message)

    def _validate_memory_law(self) -> None:
        if self.memory_law == "visibility":
            if self.memory_s:
                where = f"memory_s = {self.memory_s:g}"
                raise ConfigError(f"{where}: must be left out with memory_law visibility")
            return
        for name in ("varying_frailty", "varying_frailty_s"):
            if (value := getattr(self, name)) is not None:
                raise ConfigError(
                    f"{name} = {value:g}: must be left out without memory_law visibility"
                )

    def _validate_rules(self) -> None:
        names = [rule.name for rule in self.rules]
        for name in names:
            if RULE_NAME.fullmatch(name) is None:
                allowed = "a letter, then up to 39 letters, digits, _ or -"
                raise ConfigError(f"rules: the name {shown(name)} must be {allowed}")
        if len(set(names)) < len(names) or len(names) > MOST_RULES:
            message = f"rules = {', '.join(names)}: must be at most {MOST_RULES}, each name once"
            raise ConfigError(message)
        if self.rules and self.spec != conjunction(self.rules):
            raise ConfigError(f"spec = {self.spec!r}: must be left out where there are rules")

    def _validate_sumo(self) -> None:
        if self.sumo != SumoConfig() and (self.simulator != "sumo" or self.is_braking_scenario):
            raise ConfigError(
                "sumo: must be left out without simulator sumo and a logical scenario or "
                "sumo.config"
            )
        if not self.is_sumo_traffic:
            return
        if self.encounters_per_hour is not None:
            raise ConfigError(
                f"encounters_per_hour = {self.encounters_per_hour:g}: must be left out with "
                "sumo.config, which is answered per kilometre"
            )
        if self.is_encounter:
            where = f"sumo.config = {self.sumo.config!r}"
            raise ConfigError(f"{where}: must be left out with {self._logical_scenario}")
        if abs(round(self.sumo.step_s * 1000) / 1000 - self.sumo.step_s) > 1e-12:
            raise ConfigError(f"sumo.step_s = {self.sumo.step_s:g}: must be whole milliseconds")

    def _validate_carla(self) -> None:
        if self.carla is None:
            return
        if self.simulator not in CLIENTS:
            message = f"carla = {shown(self.carla)}: must be left out without simulator carla"
            raise ConfigError(message)
        read_address(self.carla)

    def _validate_encounter(self) -> None:
        if not self.is_encounter:
            if self.encounter != EncounterConfig() or self.start:
                changed = "start" if self.start else "encounter"
                message = f"{changed}: must be left out where encounter.logical_scenario is none"
                raise ConfigError(message)
            return
        if self.scenario != ScenarioConfig(tracker=self.scenario.tracker):
            raise ConfigError(
                f"scenario: must be left out but for its tracker with {self._logical_scenario}"
            )
        if self.simulator not in SHIPPED_SIMULATORS:
            allowed = ", ".join(SHIPPED_SIMULATORS)
            raise ConfigError(
                f"simulator = {self.simulator!r}: must be {allowed} with {self._logical_scenario}"
            )
        known = [value.name for value in start_values(self.encounter)]
        names = [choice.name for choice in self.start]
        for name in names:
            if name not in known:
                allowed = f"{', '.join(known)} with {self._logical_scenario}"
                raise ConfigError(f"start = {shown(name)}: must be one of {allowed}")
        if len(set(names)) < len(names):
            raise ConfigError(f"start = {', '.join(names)}: must be each name once")
        for choice in self.start:
            from pemviz.config.distribution_text import read_distribution  # noqa: PLC0415  numpy

            read_distribution(choice.distribution, name=f"start.{choice.name}")

    @property
    def _logical_scenario(self) -> str:
        return f"encounter.logical_scenario {self.encounter.logical_scenario}"


def conjunction(rules: Sequence[Rule]) -> str:
    """The specification that all of at least one rule are kept.

    Example:
        >>> from pemviz.config.settings import Rule, conjunction
        >>> apart, slow = "always[0,9] (gap > 0)", "always[0,9] (v < 9)"
        >>> conjunction([Rule("apart", apart), Rule("slow", slow)])
        '(always[0,9] (gap > 0)) and (always[0,9] (v < 9))'
    """
    return " and ".join(f"({rule.formula})" for rule in rules)


def read_address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``.

    Raises:
        ConfigError: It is none.
    """
    host, _, port = text.rpartition(":")
    is_number = port.isascii() and port.isdigit() and len(port) <= 5
    if not host or not host.isprintable() or " " in host or not is_number:
        raise ConfigError(f"carla = {text[:80]!r}: must be HOST:PORT, such as {DEFAULT_ADDRESS}")
    if not 1 <= int(port) <= 65535:
        raise ConfigError(f"carla = {text[:80]!r}: the port must be from 1 to 65535")
    return host, int(port)
