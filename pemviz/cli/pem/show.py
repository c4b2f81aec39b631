"""``pemviz pem show``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.markdown import Markdown

from pemviz.cli.pem.checks import check_out
from pemviz.cli.pem.position_errors import show_position_errors
from pemviz.errors import PemError
from pemviz.files.text_files import writing
from pemviz.pem.data.support import support_check, support_of
from pemviz.pem.judging.distance_curve import (
    ObstacleView,
    distance_curve,
    terminal_table,
    write_picture,
)
from pemviz.pem.judging.memory_report import write_memory_picture
from pemviz.pem.model_files import (
    ensemble_of,
    is_position_errors,
    load_ensemble,
    load_pem,
    load_position_errors,
    shipped_pems,
    shipped_position_errors,
)
from pemviz.pem.models.cards import PemCard, check_markdown, memory_markdown
from pemviz.pem.models.protocol import CLASS_NAMES, OCCLUSION_NAMES, Pem

ClassName = Literal["Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram"]
OcclusionName = Literal["none", "partly", "largely"]


@dataclass(frozen=True)
class ShowArguments:
    """Show P(missed) against distance, beside the training data; memory, and position errors."""

    pem: tyro.conf.Positional[str] = "ml-nn"
    """Name of a shipped model, or a file (.safetensors, .csv), of misses or of position errors."""
    ensemble: str | None = None
    """Ensemble for the band, by name or file; the one that belongs to the model if not given."""
    out: Path | None = None
    """Picture to write (.png); none if not given. A model with a memory gets a second one beside
    it, NAME-memory.png; a detector whose position errors are shipped too, NAME-position-errors.png.
    """
    class_name: ClassName = "Car"
    """Class of the obstacle."""
    occlusion: OcclusionName = "none"
    """How much of it is hidden."""
    x_m: float = 0.0
    """Its offset to the right [m]."""
    rotation_y_rad: float = -np.pi / 2
    """Its heading [rad], -pi to pi; -pi/2 is away from the camera."""
    z_from_m: float = 0.5
    """Nearest distance shown [m]."""
    z_to_m: float = 60.0
    """Farthest distance shown [m]."""
    allow_python: bool = False
    """Allow a model named module:attribute, which runs that module's code."""


def run(arguments: ShowArguments) -> int:
    """Print the table, write the picture; gives the exit code.

    Raises:
        PemError: bad arguments or files; one line says what, where and what is allowed.
    """
    _validate(arguments)
    if is_position_errors(arguments.pem) and arguments.pem not in shipped_pems():
        model = load_position_errors(arguments.pem)
        show_position_errors(model, Console(), out=arguments.out)
        return 0
    pem = load_pem(arguments.pem, allow_python=arguments.allow_python)
    named = arguments.ensemble
    ensemble = ensemble_of(arguments.pem) if named is None else load_ensemble(named)
    view = ObstacleView(
        class_id=CLASS_NAMES.index(arguments.class_name),
        occlusion=OCCLUSION_NAMES.index(arguments.occlusion),
        x_m=arguments.x_m,
        rotation_y_rad=arguments.rotation_y_rad,
    )
    z_m = np.linspace(arguments.z_from_m, arguments.z_to_m, 600)
    support = support_of(pem)
    curve = distance_curve(pem, ensemble=ensemble, support=support, view=view, z_m=z_m)
    title = f"{pem.name}: {arguments.class_name}, occlusion {arguments.occlusion}"
    console = Console()
    console.print(terminal_table(curve, title=title))
    if support is not None:
        report = support_check(view.at(z_m), support=support, pem=pem)
        for warning in report.warnings:
            console.print(f"warning: {warning}", soft_wrap=True)
    console.print(f"trained on: {pem.data}; licence: {pem.licence}", soft_wrap=True)
    if arguments.out is not None:
        with writing(arguments.out):
            write_picture(curve, arguments.out, title=title)
        console.print(f"written: {arguments.out}", soft_wrap=True)
    _show_memory(pem, console, out=arguments.out)
    if arguments.pem in shipped_position_errors():
        out = arguments.out
        beside = None if out is None else out.with_name(f"{out.stem}-position-errors.png")
        show_position_errors(load_position_errors(arguments.pem), console, out=beside)
    return 0


def _show_memory(pem: Pem, console: Console, *, out: Path | None) -> None:
    """What the model's card says of its memory, if it has one, and of predictive checks."""
    card: object = getattr(pem, "card", None)
    if not isinstance(card, PemCard) or not card.memory:
        return
    console.print(Markdown(f"{memory_markdown(card.memory)}\n{check_markdown(card.check)}"))
    if out is not None:
        picture = out.with_name(f"{out.stem}-memory.png")
        with writing(picture):
            write_memory_picture(card.memory, picture, title=pem.name)
        console.print(f"written: {picture}", soft_wrap=True)


def _validate(arguments: ShowArguments) -> None:
    if not -100.0 <= arguments.z_from_m < arguments.z_to_m <= 200.0:
        raise PemError(
            f"z_from_m is {arguments.z_from_m:g} and z_to_m {arguments.z_to_m:g}, "
            "allowed: -100 to 200, increasing"
        )
    if not abs(arguments.rotation_y_rad) <= np.pi:
        raise PemError(f"rotation_y_rad is {arguments.rotation_y_rad:g}, allowed: -pi to pi")
    if not abs(arguments.x_m) <= 100.0:
        raise PemError(f"x_m is {arguments.x_m:g}, allowed: -100 to 100")
    check_out(arguments.out, ending=".png")
