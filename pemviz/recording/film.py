"""The least robust rollout filmed from above by highway-env, where the scenario can be filmed."""

from collections.abc import Iterator
from importlib import import_module
from io import BytesIO

import numpy as np
import PIL.Image
import rerun as rr

from pemviz.arrays import AnyArray
from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.recording.worst import Track
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Simulator

JPEG_QUALITY = 85


def log_film(
    file: RecordingFile,
    track: Track,
    *,
    config: ExperimentConfig,
    simulator: Simulator | SlotSimulator,
    stage: int,
) -> None:
    """One JPEG picture for each state of a rollout of the braking scenario or of an encounter.

    Of one that measures places with errors there is none: a film is not told of their noise.
    """
    encoded = [_jpeg(frame) for frame in _frames(track, config, simulator)]
    times = StepTimes(stage=stage, count=len(encoded), dt_s=config.dt_s)
    file.static(paths.FRAMES, rr.EncodedImage.from_fields(media_type="image/jpeg"))
    file.along(paths.FRAMES, rr.EncodedImage.columns(blob=encoded), times=times)


def import_filming(config: ExperimentConfig) -> None:
    """Import what films, which takes a second; pygame is in it.

    Raises:
        ImportError: highway-env is not installed.
    """
    scenario = "braking.highway_env_scenario"
    encounter = "encounters.highway_env_encounters"
    is_encounter = config.encounter.logical_scenario != NO_LOGICAL_SCENARIO
    import_module(f"pemviz.simulators.{encounter if is_encounter else scenario}")


def _frames(
    track: Track, config: ExperimentConfig, simulator: Simulator | SlotSimulator
) -> Iterator[AnyArray]:
    from pemviz.simulators.braking.highway_env_scenario import (  # noqa: PLC0415  pulls in pygame
        faded,
        frames,
    )

    if config.encounter.logical_scenario == NO_LOGICAL_SCENARIO:
        yield from frames(config.scenario, detected=track.outcomes)
        return
    from pemviz.simulators.encounters.highway_env_encounters import (  # noqa: PLC0415  likewise
        encounter_frames,
    )
    from pemviz.simulators.encounters.vectorized import VectorizedEncounters  # noqa: PLC0415

    encounters, drawn = drawn_scene(simulator), track.drawn
    if (
        not isinstance(encounters, VectorizedEncounters)
        or drawn is None
        or encounters.errors is not None
    ):
        return
    contact = drawn.count if drawn.contact_step is None else drawn.contact_step
    film = encounter_frames(encounters, detected=track.outcomes, start=track.start)
    for step, frame in enumerate(film):
        yield frame if step < contact else faded(frame)


def _jpeg(frame: AnyArray) -> bytes:
    buffer = BytesIO()
    PIL.Image.fromarray(np.ascontiguousarray(frame)).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()
