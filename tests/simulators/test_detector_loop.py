"""The detector itself in the loop: known answers, observed outcomes, and what is refused."""

import importlib
from dataclasses import dataclass, replace

import numpy as np
import pytest

import pemviz
from pemviz import quantiles
from pemviz.panel.run_summary import summary
from pemviz.pem import load_pem, load_table
from pemviz.pem.models.trees import TreesPem
from pemviz.recording.film import film_title
from pemviz.reports.case_runs import read_case_run
from pemviz.reports.run_document import ANSWER, run_document
from pemviz.reports.safety_case import safety_case_page
from pemviz.reports.terminal import plain_lines
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.check import check_simulator
from tests.lattice_walk import GAP, ToySimulator, toy_probability_by_recursion

SPEC = "always[0,10] (gap >= 0.5)"
TOY = ToySimulator(initial_gap=4, largest_gap=6, states=11)


@dataclass(frozen=True)
class LitWalk:
    """The lattice walk; beside the gap an image shows a light, which each step has anew."""

    name: str = "lit-walk"
    states: int = TOY.states
    dt_s: float = 0.1
    signals = TOY.signals
    latents = pemviz.LatentCounts(start=1, noise=1)
    salient_names = ("gap",)

    def initial(self, *, count, start):
        gap = np.full(count, float(TOY.initial_gap))
        return pemviz.StateBatch(np.array(0), {GAP: gap}, {"light": start[:, 0].copy()})

    def step(self, states, detected, noise):
        moved = states.signals[GAP] + np.where(detected, 1.0, -1.0)
        later = {GAP: np.minimum(moved, float(TOY.largest_gap))}
        return pemviz.StateBatch(states.step + 1, later, {"light": noise[:, 0].copy()})

    def salient(self, signals):
        return signals[GAP][..., None]


def light_of(z):
    return np.floor(quantiles.uniform(z, low=0.0, high=256.0)).clip(0, 255)


def render(states):
    images = np.zeros((len(states.signals[GAP]), 3, 4), dtype=np.uint8)
    images[:, 1, 2] = light_of(states.memory["light"])
    images[:, 0, 0] = states.signals[GAP].clip(0, 6)
    return images


def limit_of(gap):
    """It misses where the light is below: the farther the gap, the less light it needs."""
    return 20.0 + 12.0 * (6.0 - np.clip(gap, 0.0, 6.0))


def detect(images):
    return images[:, 1, 2] >= limit_of(images[:, 0, 0].astype(np.float64))


class ShareOfLights:
    """The same detector as P(detected | gap): so many of 256 lights, all as likely."""

    def logit(self, salient):
        missed = limit_of(salient[..., 0]) / 256.0
        return np.log1p(-missed) - np.log(missed)


TRUTH = toy_probability_by_recursion(TOY, ShareOfLights())


def loop_of(**changes):
    given = {"render": render, "detect": detect} | changes
    return pemviz.DetectorInTheLoop(given.pop("scenario", LitWalk()), **given)


def built(simulator=None, *, method="monte-carlo", parts=None, **settings):
    settings = {"spec": SPEC, "seed": 3, "final_rollouts": 400} | settings
    config = pemviz.ExperimentConfig(method=method, **settings)
    return pemviz.build_experiment(config, simulator=simulator or loop_of(), **(parts or {}))


def rollouts_of(experiment, **how):
    kept = pemviz.KeptStages()
    result = pemviz.run(experiment, observers=[kept], **how)
    return result, kept.stages[-1].scored.rollouts


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("monte-carlo", {"final_rollouts": 40_000}),
        ("mixture", {"stages": 6, "rollouts": 300, "final_rollouts": 3000}),
        ("subset", {"rollouts": 2000, "stages": 10}),
    ],
)
def test_the_answer_is_the_recursions(method, settings):
    """Four standard errors: a false alarm with probability 6e-5 where it is normal."""
    found = pemviz.run(built(method=method, **settings)).estimate
    assert found.std_error < 0.3 * TRUTH
    assert abs(found.probability - TRUTH) < 4.0 * found.std_error, (found, TRUTH)


def test_outcomes_are_what_the_detector_says_of_the_image_of_the_state():
    """Against a walk in plain numpy from the very same latents."""
    result, rollouts = rollouts_of(built())
    light = light_of(np.column_stack([rollouts.latents.start, rollouts.latents.noise[..., 0]]))
    gap = np.full(400, float(TOY.initial_gap))
    for step in range(TOY.states):
        found = light[:, step] >= limit_of(gap)
        np.testing.assert_array_equal(rollouts.signals["found"][:, step], found)
        np.testing.assert_array_equal(rollouts.signals["score"][:, step], found)
        np.testing.assert_array_equal(rollouts.signals[GAP][:, step], gap)
        if step < TOY.states - 1:
            np.testing.assert_array_equal(rollouts.detected[:, step], found)
        gap = np.minimum(gap + np.where(found, 1.0, -1.0), float(TOY.largest_gap))
    assert (rollouts.log_weight == 0.0).all()
    assert 0 < (~rollouts.detected).sum() < rollouts.detected.size
    assert result.pem.name == "detector itself"
    assert result.is_of_detector_itself


def test_a_model_of_that_name_is_a_model_all_the_same():
    shipped = load_pem("rrc")
    assert isinstance(shipped, TreesPem)
    namesake = replace(shipped, card=replace(shipped.card, name="detector itself"))
    config = pemviz.ExperimentConfig(
        method="monte-carlo", final_rollouts=300, measured_memory=False, plan=False
    )
    result = pemviz.run(pemviz.build_experiment(config, pem=namesake))
    assert not result.is_of_detector_itself
    assert result.memory is not None
    assert result.memory.tau_s > 0.2
    assert "memory time of 0.249 s" in " ".join(result.assumptions)
    assert any(one.startswith("extrapolation") for one in result.warnings)


def test_neither_batches_nor_workers_nor_images_at_a_time_change_a_digit():
    wanted, rollouts = rollouts_of(built())
    for other, how in (
        (built(parts={"batch_rollouts": 7}), {}),
        (built(loop_of(images_at_a_time=5)), {}),
        (built(), {"workers": 2}),
    ):
        found, others = rollouts_of(other, **how)
        assert found.estimate == wanted.estimate
        for name, values in rollouts.signals.items():
            np.testing.assert_array_equal(others.signals[name], values)


def test_the_detector_is_always_given_as_many_images():
    sizes = set()

    def counting(images):
        sizes.add(images.shape)
        return detect(images)

    rollouts_of(built(loop_of(detect=counting, images_at_a_time=9), final_rollouts=20))
    assert sizes == {(9, 3, 4)}


def test_weighted_rollouts_do_not_touch_outcomes():
    """Proposals move latents alone: with what is certain, no outcome carries a weight."""
    _, rollouts = rollouts_of(built(method="mixture", stages=3, rollouts=100))
    np.testing.assert_array_equal(rollouts.detected, rollouts.signals["found"][:, :-1] > 0.0)
    np.testing.assert_array_equal(rollouts.proposal_logit, rollouts.pem_logit)
    assert np.any(rollouts.log_weight != 0.0)


# boxes


def boxes_of(states):
    """The obstacle fills 10 x 10 pixels; beyond a gap of 5 it is out of the image."""
    boxes = np.tile([10.0, 10.0, 20.0, 20.0], (len(states.signals[GAP]), 1))
    boxes[states.signals[GAP] > 5.0] = np.nan
    return boxes


def boxed(images):
    """Of each image a box that is off by so much as its light says, and one elsewhere."""
    off = images[:, 1, 2] / 255.0 * 10.0
    found = np.tile([10.0, 10.0, 20.0, 20.0], (len(images), 2, 1))
    found[:, 0, ::2] += off[:, None]
    found[:, 1] += 50.0
    return found, np.tile([0.7, 0.9], (len(images), 1))


def test_boxes_are_found_where_they_overlap_enough():
    """Shifted by d of 10 pixels two boxes overlap by (10 - d) / (10 + d)."""
    loop = loop_of(detect=boxed, boxes=boxes_of, iou_above=0.5, threshold=0.6)
    _, rollouts = rollouts_of(built(loop))
    light = light_of(np.column_stack([rollouts.latents.start, rollouts.latents.noise[..., 0]]))
    shift = light / 255.0 * 10.0
    found = ((10.0 - shift) / (10.0 + shift) > 0.5) & (rollouts.signals[GAP] <= 5.0)
    assert 0 < found.sum() < found.size
    np.testing.assert_array_equal(rollouts.signals["found"] > 0.0, found)
    np.testing.assert_array_equal(rollouts.signals["score"], np.where(found, 0.7, 0.0))


def test_a_box_of_too_low_a_score_is_none():
    loop = loop_of(detect=boxed, boxes=boxes_of, iou_above=0.0, threshold=0.8)
    _, rollouts = rollouts_of(built(loop, final_rollouts=50))
    assert not rollouts.detected.any()
    assert rollouts.signals["score"].max() == 0.7


# slots


class TwoWalks(LitWalk):
    """A car, which is there up to a gap of 5, and a ghost: either's error is a step nearer."""

    slots = (pemviz.Slot("lead car"), pemviz.Slot("ghost", nominal=False))

    def step(self, states, detected, noise):
        return super().step(states, detected[:, 0] & ~detected[:, 1], noise)

    def salient(self, signals):
        return np.stack([signals[GAP][..., None]] * 2, axis=-2)

    def present(self, signals):
        there = signals[GAP] <= 5.0
        return np.stack([there, np.ones_like(there)], axis=-1)


def both(images):
    light = images[:, 1, 2].astype(np.float64)
    return np.stack([light >= 60.0, light >= 250.0], axis=1)


def test_slots_are_answered_each_and_an_outcome_is_whether_all_are_right(tmp_path):
    loop = loop_of(scenario=TwoWalks(), detect=both)
    _, rollouts = rollouts_of(built(loop))
    light = light_of(np.column_stack([rollouts.latents.start, rollouts.latents.noise[..., 0]]))
    there = rollouts.signals[GAP] <= 5.0
    car, ghost = (light >= 60.0) | ~there, light >= 250.0
    np.testing.assert_array_equal(rollouts.signals["found_lead_car"] > 0.0, car)
    np.testing.assert_array_equal(rollouts.signals["found_ghost"] > 0.0, ghost)
    np.testing.assert_array_equal(rollouts.detected, (car & ~ghost)[:, :-1])
    written = loop.write_frames(tmp_path / "frames.csv", rollouts)
    table = load_table(tmp_path / "frames.csv", features=["gap"])
    assert written == len(table) == there[:, :-1].sum()
    assert table.detected.sum() == (car & there)[:, :-1].sum()


# episodes


class WalkEnvironment:
    """The same walk as a black box that is reset, stepped, and renders itself."""

    name, states, dt_s = "lit-walk", TOY.states, 0.1
    signals, latents = TOY.signals, LitWalk.latents

    def reset(self, start):
        self._gap, self._light = float(TOY.initial_gap), start[0]
        return {GAP: self._gap}

    def step(self, detected, noise):
        self._gap = min(self._gap + (1.0 if detected else -1.0), float(TOY.largest_gap))
        self._light = noise[0]
        return {GAP: self._gap}, False

    def salient(self, signals):
        return signals[GAP][..., None]

    def render(self):
        light = np.array([self._light])
        return render(
            pemviz.StateBatch(np.array(0), {GAP: np.array([self._gap])}, {"light": light})
        )[0]


def environment():
    return pemviz.DetectorEpisodes(WalkEnvironment(), detect=detect)


@pytest.mark.parametrize("method", ["monte-carlo", "mixture"])
def test_episodes_are_the_same_rollouts_however_many_are_side_by_side(method):
    few = {"method": method, "stages": 2, "rollouts": 60, "final_rollouts": 100}
    wanted, rollouts = rollouts_of(built(environment(), **few))
    others = [pemviz.side_by_side(environment, 4)]
    others += [loop_of()] * (method == "monte-carlo")  # mixture also learns of kept states
    for given in others:
        found, same = rollouts_of(built(given, **few))
        assert found.estimate == wanted.estimate
        for name, values in rollouts.signals.items():
            np.testing.assert_array_equal(same.signals[name], values)
    np.testing.assert_array_equal(rollouts.detected, rollouts.signals["found"][:, :-1] > 0.0)


class Lamp:
    """A gymnasium environment whose picture is as bright as what is left of its lamp."""

    render_mode = "rgb_array"

    def reset(self, *, seed=None, options=None):
        self.left = 1.0
        return self.left, {}

    def step(self, action):
        self.left *= 0.9 if action else 0.8
        return self.left, 0.0, False, False, {}

    def render(self):
        return np.full((8, 8, 3), round(255.0 * self.left), dtype=np.uint8)


def test_gymnasiums_pictures_are_what_the_detector_sees():
    signals = (pemviz.Signal("left", "left", "", 0.0, 1.0),)
    lamp = pemviz.GymnasiumEpisodes(
        environment=Lamp(), signals=signals, observe=lambda left: {"left": left}, states=9, dt_s=1.0
    )
    loop = pemviz.DetectorEpisodes(lamp, detect=lambda images: images.mean(axis=(1, 2, 3)) / 255.0)
    experiment = built(loop, spec="always[0,8] (left >= 0.1)", final_rollouts=3)
    result, rollouts = rollouts_of(experiment)
    left = [1.0]
    for _ in range(8):
        left.append(left[-1] * (0.9 if round(255.0 * left[-1]) / 255.0 >= 0.5 else 0.8))
    np.testing.assert_allclose(rollouts.signals["left"], np.tile(left, (3, 1)))
    np.testing.assert_array_equal(rollouts.detected[0], np.array(left[:-1]) >= 0.5)
    assert result.estimate.probability == 0.0
    title = film_title(experiment.config, experiment.declared, is_own=True)
    assert title == "Rank 1, as gymnasium draws it"


# tables, and what is said


def test_frames_become_an_error_model(tmp_path):
    """P(missed) by gap, counted in the table, is what the detector's lights say: four sigma."""
    loop = loop_of()
    _, rollouts = rollouts_of(built(loop, final_rollouts=4000))
    where = rollouts.signals[GAP][:, :-1] > 0.0
    written = loop.write_frames(tmp_path / "frames.csv", rollouts, where=where)
    table = load_table(tmp_path / "frames.csv", features=["gap"])
    assert written == len(table) == where.sum()
    for gap in (2.0, 4.0, 6.0):
        rows = table.salient[:, 0] == gap
        share, missed = limit_of(gap) / 256.0, (~table.detected[rows]).mean()
        assert abs(missed - share) < 4.0 * np.sqrt(share * (1.0 - share) / rows.sum())
    experiment = built(LitWalk(), parts={"pem": pemviz.pem.fit_pem(table, model="lr")})
    assert experiment.pem.name == "lr"


def test_weighted_rollouts_and_nameless_features_make_no_table(tmp_path):
    loop = loop_of()
    _, rollouts = rollouts_of(built(loop, method="mixture", stages=2, rollouts=60))
    with pytest.raises(pemviz.ConfigError, match="rollouts are weighted"):
        loop.write_frames(tmp_path / "frames.csv", rollouts)
    nameless = loop_of(scenario=type("Nameless", (LitWalk,), {"salient_names": ()})())
    with pytest.raises(pemviz.ConfigError, match="a table needs salient_names"):
        nameless.write_frames(tmp_path / "frames.csv", rollouts)


def test_a_result_speaks_of_no_error_model(tmp_path):
    result = pemviz.record(built(final_rollouts=2000), tmp_path)
    said = pemviz.summary_text(result)
    assert "with the detector itself on rendered images" in said
    for words in ("independent", "error model is right", "learned from", "warning", "by itself"):
        assert words not in said.replace("without an error model", "")
    assert "Misses that matter in a violation: 0.0" not in said
    everything = "\n".join(plain_lines(run_document(result).blocks(*ANSWER)))
    assert "violations" in everything
    for words in ("refits", "error model is"):
        assert words not in everything
    again = pemviz.read_result(tmp_path)
    assert again.estimate == result.estimate
    assert pemviz.summary_text(again) == said
    assert summary(again)["detector"] == "detector itself"
    page = safety_case_page([read_case_run(tmp_path)], below=0.05)
    assert "There is no error model: the detector itself is in the loop." in page
    for words in ("Perception is the error model", "speaks against the error model"):
        assert words not in page


def test_a_registered_one_needs_no_error_model_named(tmp_path, monkeypatch):
    info = tmp_path / "loops-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: loops\n")
    point = "lit-walk = tests.simulators.test_detector_loop:loop_of\n"
    (info / "entry_points.txt").write_text(f"[pemviz.simulators]\n{point}")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    config = pemviz.ExperimentConfig(
        simulator="lit-walk", method="monte-carlo", spec=SPEC, seed=3, final_rollouts=400
    )
    assert pemviz.run_experiment(config).estimate == pemviz.run(built()).estimate


# what is refused


def too_few(images):
    return detect(images)[:-1]


def with_nan(images):
    return np.where(detect(images), 1.0, np.nan)


RANDOM = np.random.default_rng(8)


REFUSED = {
    "floats": ({"render": lambda s: render(s) / 255.0}, "render gives float64 of shape"),
    "a list": ({"render": lambda s: [1] * len(s.signals[GAP])}, "a value of type list for"),
    "one image": ({"render": lambda s: render(s)[:1]}, r"uint8 of shape \(1, 3, 4\) for 4 states"),
    "flat": ({"render": lambda s: render(s)[:, 0]}, r"must be a numpy array of uint8, \[N, height"),
    "rows": ({"detect": too_few}, r"detect gives shape \(31,\) for 32 images: must be \(32,\)"),
    "numbers": ({"detect": lambda i: i[:, 0, 0]}, "must be an array of truth values or scores"),
    "nothing": ({"detect": lambda i: None}, "detect gives nothing: must be an array of truth"),
    "nan": ({"detect": with_nan}, "score of nan in rollout 1: must be a finite number"),
    "raises": ({"detect": lambda i: 1 / 0}, "detect raises ZeroDivisionError"),
    "random": (
        {"detect": lambda i: RANDOM.random(len(i))},
        "detect gives .* when asked again; what is random about it must come of latents",
    ),
    "beside": (
        {"detect": lambda i: np.cumsum(i[:, 1, 2]) / 1e4},
        "in another place among images; images_at_a_time = 1",
    ),
    "no boxes": ({"detect": detect, "boxes": boxes_of}, "must be two arrays, boxes"),
    "box shapes": (
        {"detect": lambda i: (np.zeros((len(i), 3, 4)), np.zeros((len(i), 2))), "boxes": boxes_of},
        r"boxes \(32, 3, 4\) and scores \(32, 2\) for 32 images",
    ),
    "truth": ({"detect": boxed, "boxes": lambda s: np.zeros(4)}, r"must be \(4, 4\)"),
    "threshold": ({"threshold": np.nan}, "threshold = nan: must be finite"),
    "overlap": ({"iou_above": 1.0}, "iou_above = 1.0: must be from 0 to below 1"),
    "none at a time": ({"images_at_a_time": 0}, "images_at_a_time = 0: must be at least 1"),
}


@pytest.mark.parametrize(("changes", "words"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused_in_a_line(changes, words):
    with pytest.raises(pemviz.InputError, match=words) as caught:
        built(loop_of(**changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "parts", "words"),
    [
        ({}, {"pem": ShareOfLights()}, "pem: simulator 'lit-walk' has the detector itself"),
        ({"memory_s": 0.2}, {}, "memory_s: .* knows how it misses; leave it out"),
        ({"frailty": 0.5}, {}, "frailty: .* has the detector itself"),
        ({"memory_curve": True}, {}, "memory_curve: .* has the detector itself"),
        (
            {"method": "splitting"},
            {},
            "has the detector itself in the loop; use mixture, with subset",
        ),
        ({"method": "adaptive"}, {}, "has the detector itself in the loop; use mixture"),
        ({"reference": True}, {}, "reference = true"),
    ],
)
def test_what_belongs_to_an_error_model_is_refused(settings, parts, words):
    with pytest.raises(pemviz.ConfigError, match=words):
        built(parts=parts, **settings)


def test_a_signal_of_its_name_is_refused():
    taken = replace(TOY.signals[0], name="score", key="score")
    scenario = type("Taken", (LitWalk,), {"signals": (*TOY.signals, taken)})()
    with pytest.raises(pemviz.ConfigError, match="the signal 'score' is pemviz's own here; choose"):
        loop_of(scenario=scenario)


def test_nan_during_a_run_names_rollout_and_step():
    """The trials before a run do not reach a light of 255; two thousand rollouts do."""

    def odd(images):
        return np.where(images[:, 1, 2] == 255, np.nan, detect(images))

    words = r"detect gives a score of nan in rollout \d+, step \d+ \(stage 0\): must be a finite"
    with pytest.raises(pemviz.RunError, match=words):
        pemviz.run(built(loop_of(detect=odd), final_rollouts=2000))


def test_it_keeps_to_the_protocol_whatever_outcomes_it_is_given():
    check_simulator(loop_of())
    outcomes = np.random.default_rng(1).random((6, 10)) < 0.5
    found = replay(simulator=loop_of(), detected=outcomes)
    np.testing.assert_array_equal(found[GAP], found[GAP][:1].repeat(6, axis=0))
