import numpy as np
import pytest
import torch
from drift import imagined_drift
from lerobot.policies.factory import make_policy
from oracle import Oracle
from small import batch_of, make_dataset, small_config, train
from small_network import in_closed_loop, row_of

from lerobot_ufrnn.analysis.hidden_states import read_demonstrations, states_along


def test_drift_is_the_mean_distance_of_imagined_poses_from_the_nearest_demonstrated_one(tmp_path):
    dataset = make_dataset(tmp_path / "dataset", (7, 12, 9), ("front", "wrist"))
    policy = make_policy(small_config(exploration="none"), ds_meta=dataset.meta)
    train(policy, [batch_of(0, 1, 2)] * 3)
    policy.eval()
    demonstrations = read_demonstrations(policy, dataset.root)
    poses = torch.cat([policy.joint_scaler.scale(episode.states) for episode in demonstrations]).numpy()
    network = policy.model.network
    drifts = imagined_drift(policy, demonstrations, 4)
    for states, drift in zip(states_along(policy, demonstrations), drifts, strict=True):
        for start in range(len(drift)):
            imagined = in_closed_loop(network, row_of(states, start), 4)
            means = [Oracle(network).predict(state)[0][: network.joint_dim] for state in imagined]
            nearest = [min(np.linalg.norm(mean - pose) for pose in poses) for mean in means]
            assert drift[start] == pytest.approx(np.mean(nearest), abs=1e-5)
