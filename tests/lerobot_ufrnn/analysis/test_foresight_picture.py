import numpy as np
import pytest
import torch
from PIL import Image
from small import IMAGE_SIZE, observation
from small_network import network_config

from lerobot_ufrnn import UFRNNPolicy
from lerobot_ufrnn.analysis.foresight_picture import decisive, draw
from lerobot_ufrnn.analysis.trial import Attempt, Imagination, TrialHistory
from lerobot_ufrnn.networks import Prediction

CANDIDATES = 9


def futures_that_part_by(spread: float) -> Prediction:
    means = spread * torch.linspace(-1, 1, CANDIDATES)[None, :, None].expand(10, CANDIDATES, 7)
    return Prediction(means, torch.zeros_like(means), means[..., :2], means[..., :3])


def trial_of(*imaginations: Imagination, first_try: int | None = None) -> TrialHistory:
    attempts = [] if first_try is None else [Attempt(first_try, "pull")]
    return TrialHistory("pull", ("a", "b", "c"), states=[None] * 50, attempts=attempts, imaginations=[*imaginations])


def test_with_recall_the_last_return_was_decisive():
    refuted = np.linspace(0, 1, CANDIDATES)
    returns = [Imagination(step, 3, futures_that_part_by(60 - step), 0, refuted) for step in (20, 40)]
    assert decisive(trial_of(*returns, first_try=10), 3) is returns[1]


@pytest.mark.parametrize(("first_try", "step"), [(30, 25), (None, 45)])
def test_without_recall_it_is_where_futures_part_most_in_the_two_seconds_before_the_first_try_or_the_end(
    first_try, step
):
    parting = {5: 9.0, 25: 3.0, 35: 2.0, 45: 8.0}
    history = trial_of(
        *(Imagination(step, 2, futures_that_part_by(parting.get(step, 1.0)), 0) for step in range(50)),
        first_try=first_try,
    )
    assert decisive(history, 3).step == step


def test_a_trial_in_which_nothing_was_imagined_is_refused():
    with pytest.raises(ValueError, match="Nothing was imagined"):
        decisive(trial_of(), 3)


@pytest.mark.parametrize("length", [6, 30])
@pytest.mark.parametrize("refuted", [None, np.linspace(0, 1, CANDIDATES)])
def test_a_picture_is_drawn_also_where_the_trial_ends_before_the_horizon(length, refuted, tmp_path):
    torch.manual_seed(0)
    foresight = {"horizon": 10, "num_samples": CANDIDATES}
    policy = UFRNNPolicy(network_config(foresight=foresight, recall={"enabled": False}, kernel="reference"))
    policy.joint_scaler.fit(torch.full((3,), -3.0), torch.full((3,), 3.0))
    policy.image_encoder.scaler.fit(torch.full((4,), -1.0), torch.full((4,), 1.0))
    history = TrialHistory("pull", ("a", "b", "c"))
    for step in range(length):
        policy.select_action(observation(1))
        history.states.append(policy.memory.state)
        history.joints.append(np.zeros(3))
        history.variances.append(policy.model.modality_variance(policy.memory.prediction)[0].numpy())
        history.images.append(np.full((IMAGE_SIZE, IMAGE_SIZE, 3), 90, dtype=np.uint8))
        futures = Prediction(*(values[:, :, 0] for values in policy.last_trace.imagined))
        history.imaginations.append(Imagination(step, 2, futures, int(policy.last_trace.chosen[0]), refuted))
    draw(policy, history, tmp_path / "folder" / "foresight.png")
    with Image.open(tmp_path / "folder" / "foresight.png") as picture:
        assert picture.size[0] == 2 * 7 * 110  # camera, reconstruction and five candidates
