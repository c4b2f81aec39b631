"""The film of a logical scenario's least robust rollout shows that rollout."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import PIL.Image
import pytest

from pemviz.config import StartChoice
from pemviz.config.toml_files import load_preset
from pemviz.recording import paths
from tests.recording.conftest import chunks, record, with_blind_pem


def test_a_logical_scenario_is_filmed_with_its_own_start_and_in_grey_from_contact_on(tmp_path):
    pytest.importorskip("highway_env")
    preset = load_preset("braking")
    config = replace(
        preset, method="naive", naive_detection_probability=0.02, memory_s=0.0, rules=(),
        spec="always[0,30] (clearance - collided >= 0)",
        encounter=replace(preset.encounter, states=31), final_rollouts=20, plan=False,
        start=(StartChoice(name="gap", distribution="uniform(8, 9)"),
               StartChoice(name="brake_time", distribution="0.2")),
    )  # fmt: skip
    recorded = record(with_blind_pem(config), tmp_path, frames=True)
    pictures = [c for c in chunks(recorded.path) if c.entity_path == paths.FRAMES]
    rows = [c.to_record_batch()["EncodedImage:blob"] for c in pictures if not c.is_static]
    frames = [np.asarray(PIL.Image.open(BytesIO(bytes(one[0]))).convert("RGB"), dtype=np.int64)
              for row in rows for one in row.to_pylist()]  # fmt: skip
    assert len(frames) == 31
    ranked, (stage,) = recorded.result.least_robust[0], recorded.stages
    signals = {name: v[ranked.rollout] for name, v in stage.scored.rollouts.signals.items()}
    assert signals["collided"].any()
    colored = [np.ptp(frame, axis=-1).max() > 60 for frame in frames]
    assert colored == (signals["collided"] == 0.0).tolist()
    # the orange car starts as far ahead of the blue one as in the rollout: 7.2 pixels a metre
    orange = (frames[0][..., 0] > 150) & (frames[0][..., 2] < 90)
    blue = (frames[0][..., 2] > 130) & (frames[0][..., 0] < 90)
    gap_px = np.flatnonzero(orange.any(axis=0))[0] - np.flatnonzero(blue.any(axis=0))[-1]
    assert gap_px / 7.2 == pytest.approx(signals["gap_lead"][0], abs=0.6)
