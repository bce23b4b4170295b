"""How far imagination drifts from what was demonstrated: whether a future that is chosen can be carried out.

A network that predicts every single step well may still leave the demonstrated way once it feeds on its own
predictions. Its imagined futures then end in poses that no arm ever went through, and trying them opens no door.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..episodes import Episode
from ..modeling_ufrnn import UFRNNPolicy
from .hidden_states import states_along


@torch.no_grad()
def imagined_drift(policy: UFRNNPolicy, demonstrations: Sequence[Episode], num_steps: int) -> list[Tensor]:
    """Distance of imagined poses from the nearest demonstrated one; imagining itself adds no noise.

    Args:
        policy (`UFRNNPolicy`):
            Trained policy.
        demonstrations (`Sequence[Episode]`):
            It reads them, exploring as it does when it acts, and imagines from each of their steps; all their poses
            count as demonstrated.
        num_steps (`int`):
            Number of imagined steps T.

    Returns:
        `list[Tensor]`: for each demonstration of L steps and each of these as a start the mean distance over the
            imagined steps, (L,), in units of the scaled joints, which were demonstrated between -0.8 and 0.8.
    """
    poses = [policy.joint_scaler.scale(episode.states.to(policy.updates.device)) for episode in demonstrations]
    demonstrated, joint_dim = torch.cat(poses), policy.model.network.joint_dim
    drifts = []
    for states in states_along(policy, list(demonstrations)):
        imagined = policy.model.network.predict_mean(policy.model.imagine(states, num_steps))  # (T + 1, L, D)
        drifts.append(torch.cdist(imagined[..., :joint_dim], demonstrated).amin(-1).mean(0))
    return drifts
