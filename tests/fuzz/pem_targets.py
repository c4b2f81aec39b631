"""Targets that read perception error models."""

from functools import partial

import numpy as np
from safetensors.numpy import load

from pemviz.pem import ensemble_of, load_pem, save_pem, support_of
from pemviz.pem.data.support import support_check
from pemviz.pem.exchange.autoware import read_noise
from pemviz.pem.exchange.binned_models import miss_model, position_model
from pemviz.pem.model_files import METADATA_KEY, read_tensors
from pemviz.pem.models.cards import card_markdown
from pemviz.pem.models.network import NetworkPem
from pemviz.pem.models.protocol import Pem
from tests.fuzz.containers import damage_safetensors
from tests.fuzz.harness import Case, Target
from tests.fuzz.mutate import text_bytes
from tests.pem.helpers import braking_rows, random_rows

ROWS = np.concatenate(
    [braking_rows(np.linspace(-30.0, 60.0, 20)), random_rows(np.random.default_rng(5), 40)]
)
CSV = "distance_m,p_detected\n0,0.2\n5,0.5\n20.5,0.9\n60,0.999\n"


def _sound(case: Case, pem: Pem, *, written: bool) -> None:
    """It answers everywhere with numbers, tells of itself, and is stored as what it is."""
    logit = pem.logit(ROWS)
    assert logit.shape == (len(ROWS),)
    assert np.isfinite(logit).all(), logit
    assert np.array_equal(pem.logit(ROWS[:7]), logit[:7])
    assert isinstance(card_markdown(pem.card, digest=pem.digest), str)
    support = support_of(pem)
    if support is not None:
        support_check(ROWS, support=support, pem=pem)
    if written:
        path = case.folder / "copy.safetensors"
        save_pem(pem, path)
        assert load_pem(str(path)).digest == pem.digest


def read_model(case: Case, *, kind: str) -> None:
    """A safetensors file of one kind."""
    contents = case.valid.pems
    path = case.folder / "damaged.safetensors"
    tensors = load(contents[kind])
    source = case.valid.folder / f"{kind}.safetensors"
    metadata = read_tensors(source)[1] if source.is_file() else {"source": "made up"}
    path.write_bytes(damage_safetensors(case.rng, tensors, metadata, list(contents.values())))
    pem = load_pem(str(path))
    ensemble_of(str(path))
    _sound(case, pem, written=METADATA_KEY in metadata or isinstance(pem, NetworkPem))


def read_csv_model(case: Case) -> None:
    """A table of distances and probabilities."""
    path = case.folder / "damaged.csv"
    path.write_bytes(text_bytes(case.rng, CSV, [CSV, "1,2\n"]))
    _sound(case, load_pem(str(path)), written=True)


def read_noise_parameters(case: Case) -> None:
    """Noise parameters of scenario_simulator_v2."""
    path = case.folder / "noise.yaml"
    path.write_bytes(text_bytes(case.rng, case.valid.noise, [case.valid.noise, "&a [*a]", "1e999"]))
    for one in read_noise(path).configurations:
        pem = miss_model(one, {}, name="noise", sensor_ahead_m=0.0)
        errors = position_model(one, {}, name="noise", sensor_ahead_m=0.0)
        _sound(case, pem, written=True)
        if errors is not None:
            assert np.isfinite(errors.error(ROWS, np.ones((len(ROWS), 2)))).all()


TARGETS = (
    *(
        Target(f"pem-{kind}", partial(read_model, kind=kind), weight)
        for kind, weight in (
            ("network", 5),
            ("trees", 5),
            ("table", 4),
            ("ensemble", 3),
            ("tree-ensemble", 2),
            ("authors", 5),
        )
    ),
    Target("pem-csv", read_csv_model, 5),
    Target("pem-noise", read_noise_parameters, 2),
)
