"""What ``pemviz pem fit`` and ``pemviz pem show`` do for models of position errors."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.markdown import Markdown

from pemviz.files.text_files import writing
from pemviz.pem.judging.position_error_report import write_position_picture
from pemviz.pem.model_files import save_position_errors
from pemviz.pem.models.cards import AXIS_UNITS, position_card_markdown
from pemviz.pem.models.position_errors import MEAN_FEATURES, SCALE_FEATURES, PositionErrorModel


def write_position_errors(model: PositionErrorModel, path: Path) -> None:
    """Write a model, its card (.md) and its parameters for reading (.json), and say what it is.

    Raises:
        PemError: A file cannot be written.
    """
    parameters = {name: array.tolist() for name, array in model.tensors().items()}
    document = {
        "digest": model.digest,
        "features_of_mean": MEAN_FEATURES,
        "features_of_log_scale": SCALE_FEATURES,
        "parameters": {
            name: ["infinite" if value == float("inf") else value for value in values]
            for name, values in parameters.items()
        },
        "card": asdict(model.card),
    }
    text = json.dumps(document, indent=1, allow_nan=False)
    page = position_card_markdown(model.card, digest=model.digest)
    with writing(path):
        save_position_errors(model, path)
        path.with_suffix(".md").write_text(page, encoding="utf-8")
        path.with_suffix(".json").write_text(text, encoding="utf-8")
    print(f"{path}: position errors, SHA-256 {model.digest[:16]}")
    for axis in model.card.report["axes"]:
        freedom, nats = axis["degrees_of_freedom"], axis["nats"]
        family = "Gaussian" if freedom is None else f"Student's t with {freedom:.1f} d.o.f."
        unit = AXIS_UNITS[axis["name"]]
        nearest, *_, farthest = axis["distances"]
        print(
            f"  {axis['name']}: {family}; 68 % within +- {nearest['fitted_half_width']:.2f} {unit} "
            f"at {nearest['low_m']:g} to {nearest['high_m']:g} m, "
            f"{farthest['fitted_half_width']:.2f} {unit} at {farthest['low_m']:g} to "
            f"{farthest['high_m']:g} m; held out, an error costs {nats['constant']:.3f} nats by "
            f"one Gaussian, {nats['gaussian' if freedom is None else 'student-t']:.3f} by this"
        )


def show_position_errors(model: PositionErrorModel, console: Console, *, out: Path | None) -> None:
    """Print a model's card, and draw it where a picture is asked for.

    Raises:
        PemError: The picture cannot be written, or the card has nothing to draw.
    """
    console.print(Markdown(position_card_markdown(model.card, digest=model.digest)))
    if out is not None:
        with writing(out):
            write_position_picture(model, out)
        console.print(f"written: {out}", soft_wrap=True)
