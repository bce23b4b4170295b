"""Rest: has the arm come to a standstill where no demonstration began or ended?

Where demonstrations part, a network that has learned both ways can be led to the mean of them. If they are opposites,
that is no movement at all, and it is foreseen: nothing surprises. But demonstrations rest before they begin and after
they end only; where one paused on its way for as long, a rest tells nothing, and none is detected.
"""

import torch
from torch import Tensor, nn

REST_STEPS = 20
"""Steps of standstill that are a rest."""

STANDSTILL = 0.15
"""Share of the least that demonstrations moved in as many steps below which an arm stands still."""

MOST_PLACES = 64
"""Remembered places where demonstrations began or ended; of more, those that differ most."""

NEAR = 0.15
"""Distance from such a place that is still there, as a fraction of how far demonstrations led."""


class RestDetector(nn.Module):
    """Remembers where demonstrations began and ended and the least that they moved elsewhere; saved in the checkpoint.

    Args:
        joint_dim (`int`):
            Number of joints D_j.
    """

    places: Tensor
    extent: Tensor
    least_movement: Tensor

    def __init__(self, joint_dim: int):
        super().__init__()
        self.register_buffer("places", torch.zeros(MOST_PLACES, joint_dim))
        self.register_buffer("extent", torch.zeros(()))
        self.register_buffer("least_movement", torch.zeros(()))

    @torch.no_grad()
    def observe(self, joints: Tensor) -> None:
        """Learns from a demonstration; one that was seen before teaches nothing new.

        Args:
            joints (`Tensor`):
                Its scaled measured joints, (L, D_j).
        """
        both = joints[[0, -1]]
        is_first = not self.extent > 0
        self.places.copy_(_most_different(both if is_first else torch.cat((self.places, both)), MOST_PLACES))
        self.extent.copy_(torch.maximum(self.extent, (joints - joints[-1]).norm(dim=-1).max()))
        # A demonstration too short to tell counts as one that rests, so that nothing else does.
        least = joints.new_zeros(())
        if len(joints) > REST_STEPS:
            distances = (joints[:, None] - both).norm(dim=-1).amin(-1)
            elsewhere = distances.unfold(0, REST_STEPS + 1, 1).amin(-1) > NEAR * self.extent
            movements = _movement(joints.unfold(0, REST_STEPS + 1, 1).movedim(-1, 0))[elsewhere]
            if len(movements) > 0:
                least = movements.min()
        self.least_movement.copy_(least if is_first else torch.minimum(self.least_movement, least))

    def detects(self, joints: Tensor) -> bool:
        """Whether the arm rests where no demonstration began or ended.

        Args:
            joints (`Tensor`):
                Scaled measured joints of the last `REST_STEPS` + 1 steps, (REST_STEPS + 1, D_j).

        Returns:
            `bool`: whether it moved far less than any demonstration did in as many steps, and is at no such place.
        """
        if not bool(_movement(joints) < STANDSTILL * self.least_movement):
            return False
        return bool((self.places - joints[-1]).norm(dim=-1).min() > NEAR * self.extent)


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
