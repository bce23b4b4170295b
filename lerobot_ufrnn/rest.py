"""Rest: has the arm come to a standstill where no demonstration ended?

Where demonstrations part, a network that has learned both ways can be led to the mean of them. If they are opposites,
that is no movement at all, and it is foreseen: nothing surprises. But demonstrations rest at their ends only; where
one paused on its way for as long, a rest tells nothing, and none is detected.
"""

import torch
from torch import Tensor, nn

REST_STEPS = 20
"""Steps of standstill that are a rest."""

STANDSTILL = 0.15
"""Share of the least that demonstrations moved in as many steps below which an arm stands still."""

MOST_ENDINGS = 64
"""Remembered ends of demonstrations; of more, those that differ most."""

AT_AN_ENDING = 0.15
"""Distance from the end of a demonstration that is still at its end, as a fraction of how far it has led."""


class RestDetector(nn.Module):
    """Remembers where demonstrations ended and the least that they moved elsewhere. Saved with the checkpoint.

    Args:
        joint_dim (`int`):
            Number of joints D_j.
    """

    endings: Tensor
    extent: Tensor
    least_movement: Tensor

    def __init__(self, joint_dim: int):
        super().__init__()
        self.register_buffer("endings", torch.zeros(MOST_ENDINGS, joint_dim))
        self.register_buffer("extent", torch.zeros(()))
        self.register_buffer("least_movement", torch.zeros(()))

    @torch.no_grad()
    def observe(self, joints: Tensor) -> None:
        """Learns from a demonstration; one that was seen before teaches nothing new.

        Args:
            joints (`Tensor`):
                Its scaled measured joints, (L, D_j).
        """
        ending = joints[-1:]
        distances = (joints - ending).norm(dim=-1)
        is_first = not self.extent > 0
        self.endings.copy_(_most_different(ending if is_first else torch.cat((self.endings, ending)), MOST_ENDINGS))
        self.extent.copy_(torch.maximum(self.extent, distances.max()))
        # A demonstration too short to tell counts as one that rests, so that nothing else does.
        least = joints.new_zeros(())
        if len(joints) > REST_STEPS:
            elsewhere = distances[REST_STEPS:] > AT_AN_ENDING * self.extent
            movements = _movement(joints.unfold(0, REST_STEPS + 1, 1).movedim(-1, 0))[elsewhere]
            if len(movements) > 0:
                least = movements.min()
        self.least_movement.copy_(least if is_first else torch.minimum(self.least_movement, least))

    def detects(self, joints: Tensor) -> bool:
        """Whether the arm rests where no demonstration ended.

        Args:
            joints (`Tensor`):
                Scaled measured joints of the last `REST_STEPS` + 1 steps, (REST_STEPS + 1, D_j).

        Returns:
            `bool`: whether it moved far less than any demonstration did in as many steps, and is at no ending.
        """
        if not bool(_movement(joints) < STANDSTILL * self.least_movement):
            return False
        return bool((self.endings - joints[-1]).norm(dim=-1).min() > AT_AN_ENDING * self.extent)


def _movement(joints: Tensor) -> Tensor:
    """How far the joint that moved most did, (...), from joints over time, (L, ..., D_j)."""
    return (joints.amax(0) - joints.amin(0)).amax(-1)


def _most_different(points: Tensor, count: int) -> Tensor:
    """Picks points that are farthest from those picked before (Gonzalez, 1985); repeats them where there are fewer."""
    picked = [0]
    distances = (points - points[0]).norm(dim=-1)
    for _ in range(count - 1):
        picked.append(int(distances.argmax()))
        distances = torch.minimum(distances, (points - points[picked[-1]]).norm(dim=-1))
    return points[picked]
