"""A film of the least robust rollout: by highway-env from above, or as a user's system draws it."""

import logging
from collections.abc import Iterator
from importlib import import_module
from io import BytesIO

import numpy as np
import PIL.Image
import rerun as rr

from pemviz.arrays import AnyArray
from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO
from pemviz.errors import ConfigError
from pemviz.faults import exception_text
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.recording.worst import Track
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.detector_loop import Detecting
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.simulators.latents import latent_counts, parts_of
from pemviz.simulators.scene import FilmsRollouts
from pemviz.simulators.slots import SlotSimulator
from pemviz.simulators.tracking.tracked import TrackedSimulator
from pemviz.types import Simulator

LOG = logging.getLogger(__name__)
JPEG_QUALITY = 85


def film_title(
    config: ExperimentConfig, simulator: Simulator | SlotSimulator, *, is_own: bool
) -> str | None:
    """What a film of the least robust rollout is called; ``None``: nothing draws one.

    highway-env draws shipped scenarios of which outcomes and starts tell all: none with errors of
    places, none on SUMO, where cars move otherwise. A system of the user's own draws itself.
    """
    if is_own:
        filming = _filming(simulator)
        return None if filming is None else f"Rank 1, as {simulator.name} draws it"
    drawn = any(
        isinstance(part, VectorizedSimulator | VectorizedEncounters) for part in parts_of(simulator)
    )
    if not drawn or config.position_errors is not None or config.simulator == "sumo":
        return None
    return "Rank 1 in highway-env, from above"


def _filming(simulator: Simulator | SlotSimulator) -> FilmsRollouts | None:
    """The part of a system that draws pictures, if outcomes and start are all that it steps by."""
    for part in parts_of(simulator):
        if isinstance(part, TrackedSimulator):  # it is told of tracks, not of outcomes
            return None
        if isinstance(part, Detecting) and len(part.slots_reported) > 1:  # outcomes are of all
            return None
        if isinstance(part, FilmsRollouts):
            draws = getattr(part, "films", True) and not latent_counts(part).noise
            return part if draws else None
    return None


def log_film(
    file: RecordingFile,
    track: Track,
    *,
    config: ExperimentConfig,
    simulator: Simulator | SlotSimulator,
    stage: int,
    is_own: bool = False,
) -> None:
    """One JPEG picture for each state of a rollout of the braking scenario or of an encounter.

    Of one that measures places with errors there is none: a film is not told of their noise. A
    system of the user's own that fails to draw is told of, and costs the film alone.
    """
    if is_own:
        try:
            encoded = [_jpeg(frame) for frame in _own_frames(track, simulator)]
        except Exception as error:
            LOG.warning("no film: pictures of %s fail: %s", simulator.name, exception_text(error))
            return
    else:
        encoded = [_jpeg(frame) for frame in _frames(track, config, simulator)]
    times = StepTimes(stage=stage, count=len(encoded), dt_s=simulator.dt_s)
    file.static(paths.FRAMES, rr.EncodedImage.from_fields(media_type="image/jpeg"))
    file.along(paths.FRAMES, rr.EncodedImage.columns(blob=encoded), times=times)


def _own_frames(track: Track, simulator: Simulator | SlotSimulator) -> Iterator[AnyArray]:
    filming = _filming(simulator)
    if filming is None:
        return
    taken = latent_counts(filming).start
    start = None if track.start is None or not taken else track.start[:taken]
    for frame in filming.pictures(track.outcomes, start=start):
        picture = np.asarray(frame)
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            message = f"a picture is {picture.dtype} {list(picture.shape)}: must be bytes [H, W, 3]"
            raise ConfigError(message)
        yield picture


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
