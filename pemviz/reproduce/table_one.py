"""Table I: how well each kind of error model predicts held-out detections."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from pemviz.pem import load_table
from pemviz.pem.fitting.fit import ModelKind
from pemviz.reproduce.tables import Column, Table

MODELS: tuple[ModelKind, ...] = ("guess-mu", "lr", "b-nn", "ml-nn")
CLOSE_BCE = 0.005
CLOSE_AUC = 0.01

COLUMNS = (
    Column("model", "model"),
    Column("bce_nats", "BCE, ours [nats]", ".4f"),
    Column("bce_spread_nats", "+- between folds", ".4f"),
    Column("bce_paper_nats", "BCE, paper", ".3f"),
    Column("roc_auc", "ROC-AUC, ours", ".3f"),
    Column("roc_auc_spread", "+- between folds", ".3f"),
    Column("roc_auc_paper", "ROC-AUC, paper", ".3f"),
)

Scores = tuple[float, float, float, float]
"""Cross-entropy [nats], its spread between folds, ROC-AUC, its spread."""


def score_model(model: ModelKind, data: Path, seed: int) -> Scores:
    """5-fold stratified cross-validation of one kind of model."""
    from pemviz.pem.judging.cross_validation import cross_validate  # noqa: PLC0415  sklearn is slow

    evaluation = cross_validate(load_table(data), model=model, seed=seed)
    return (*evaluation.bce, *evaluation.roc_auc)


def trainable_models() -> tuple[ModelKind, ...]:
    """The paper's models, but for the Bayesian network where pyro-ppl is not installed."""
    has_pyro = find_spec("pyro") is not None
    return tuple(model for model in MODELS if model != "b-nn" or has_pyro)


def table_1(scores: Mapping[str, Scores]) -> Table:
    """Ours beside the paper's."""
    from pemviz.pem.judging.cross_validation import PAPER_TABLE_1  # noqa: PLC0415  sklearn is slow

    paper = {str(model): values for model, values in PAPER_TABLE_1.items()}
    return Table(
        name="table1",
        title="Table I: perception error models",
        columns=COLUMNS,
        rows=tuple(
            (model, bce, bce_spread, paper[model][0], auc, auc_spread, paper[model][1])
            for model, (bce, bce_spread, auc, auc_spread) in scores.items()
        ),
        remarks=(
            "Stratified 5-fold cross-validation in the table's order, as the authors did; "
            "normalisation fitted on the training part alone.",
            *(_remark(model, values, paper[model]) for model, values in scores.items()),
            *(
                f"{model}: left out, since the optional package pyro-ppl is not installed."
                for model in MODELS
                if model not in scores
            ),
        ),
    )


def _remark(model: str, scores: Scores, paper: tuple[float, float]) -> str:
    bce, _, auc, _ = scores
    same = abs(bce - paper[0]) <= CLOSE_BCE and abs(auc - paper[1]) <= CLOSE_AUC
    if same:
        return f"{model}: as in the paper, within {CLOSE_BCE} nats and {CLOSE_AUC} of ROC-AUC."
    better = "better" if bce < paper[0] else "worse"
    reason = (
        "prior and variational family of the Bayesian network are our choice here"
        if model == "b-nn"
        else "the fit's details differ where the paper leaves them open"
    )
    return f"{model}: {better} here than in the paper ({bce:.3f} against {paper[0]:.3f}); {reason}."
