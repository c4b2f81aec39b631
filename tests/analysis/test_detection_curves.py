from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from pemviz.analysis.detection_curves import detection_curves, gap_grid, mean_near_gaps, pem_curve
from pemviz.config import ScenarioConfig
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.gap_network import initial_gap_network
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import RolloutBatch, StateBatch
from tests.toy import FunctionPem

SIMULATOR = VectorizedSimulator(ScenarioConfig())


@dataclass(frozen=True)
class ClosingSpeedProposal:
    """P(detected) from the closing speed alone."""

    def logit(self, states: StateBatch, pem_logit: np.ndarray) -> np.ndarray:
        return states.signals["ego_speed"] - states.signals["lead_speed"] + 0.0 * pem_logit

    def arrays(self) -> Mapping[str, np.ndarray]:
        return {}


@FunctionPem
def sloping_pem(salient):
    return 5.0 - 0.1 * salient[..., 9]


def batch(gap_m, ego_mps) -> RolloutBatch:
    """Rollouts whose lead car stands; N rows of T states."""
    gap_m, ego_mps = np.array(gap_m, dtype=float), np.array(ego_mps, dtype=float)
    steps = gap_m.shape[1] - 1
    nothing = np.zeros((gap_m.shape[0], steps))
    return RolloutBatch(
        signals={"gap": gap_m, "ego_speed": ego_mps, "lead_speed": np.zeros_like(gap_m)},
        memory={},
        detected=nothing.astype(bool),
        pem_logit=nothing,
        proposal_logit=nothing,
    )


def test_the_grid_reaches_from_contact_beyond_the_initial_gap():
    grid = gap_grid(SIMULATOR)
    assert grid[0] == 0.0
    assert grid[-1] == 20.0
    np.testing.assert_allclose(np.diff(grid), 0.1)
    far = gap_grid(VectorizedSimulator(ScenarioConfig(initial_gap_m=60.0, gap_bound_m=100.0)))
    assert far[-1] == 80.0


def test_curves_of_proposals_that_need_no_path():
    grid = gap_grid(SIMULATOR)
    expected = expit(5.0 - 0.1 * (grid + 2.5))
    np.testing.assert_allclose(
        pem_curve(simulator=SIMULATOR, pem=sloping_pem, gap_m=grid), expected
    )
    for proposal, curve in ((PemProposal(), expected), (ConstantProposal(0.3), 0.3)):
        curves = detection_curves(
            simulator=SIMULATOR, pem=sloping_pem, proposal=proposal, gap_m=grid
        )
        np.testing.assert_allclose(curves.pem, expected)
        np.testing.assert_allclose(curves.proposal, curve)


def test_a_proposal_of_more_than_the_gap_is_averaged_over_the_states_near_it():
    rollouts = batch([[10.0, 5.0, 0.0], [10.0, 5.0, 0.0]], [[8.0, 2.0, 0.0], [4.0, 6.0, 0.0]])
    curves = detection_curves(
        simulator=SIMULATOR,
        pem=sloping_pem,
        proposal=ClosingSpeedProposal(),
        gap_m=np.array([0.0, 5.0, 7.5, 10.0, 20.0]),
        rollouts=rollouts,
        rollout_weight=np.array([3.0, 1.0]),
    )
    near = (3 * expit(2.0) + expit(6.0)) / 4
    far = (3 * expit(8.0) + expit(4.0)) / 4
    # halfway between two gaps that states are near, and the ends held
    expected = [near, near, (near + far) / 2, far, far]
    np.testing.assert_allclose(curves.proposal, expected)


def test_a_proposal_of_the_gap_alone_needs_no_states_near_it():
    grid = gap_grid(SIMULATOR)
    network = initial_gap_network(seed=3)
    curves = detection_curves(
        simulator=SIMULATOR,
        pem=sloping_pem,
        proposal=network,
        gap_m=grid,
        rollouts=batch([[10.0, 5.0, 0.0]], [[8.0, 2.0, 0.0]]),
    )
    np.testing.assert_array_equal(curves.proposal, expit(network.logit_at(grid)))


@given(
    gaps=st.lists(st.floats(0, 20), min_size=3, max_size=30),
    weights=st.lists(st.floats(0, 5), min_size=2, max_size=2),
)
def test_means_stay_within_what_is_averaged(gaps, weights):
    speeds = np.linspace(3.0, 9.0, len(gaps))
    rollouts = batch([gaps, gaps[::-1]], [speeds, speeds + 1.0])
    means = mean_near_gaps(
        rollouts.decision_states().signals["ego_speed"],
        rollouts=rollouts,
        gap_m=np.linspace(0, 20, 41),
        rollout_weight=np.array(weights),
    )
    assert means.shape == (41,)
    assert ((means >= 3.0 - 1e-9) & (means <= 10.0 + 1e-9)).all()
