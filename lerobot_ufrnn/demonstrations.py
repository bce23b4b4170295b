"""What a policy remembers of its demonstrations: recall goes back to it, and takes its measures from it."""

import logging
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from .networks import SHLSTM, HiddenState

logger = logging.getLogger(__name__)

SPACING = 0.1  # seconds from one remembered moment to the next
MOST_MOMENTS = 4000  # of all demonstrations together; later demonstrations are not remembered
NEIGHBOURS = 3  # of at most that many demonstrations the farthest tells how far one usually passes another
FARTHEST_NEAR = 0.05  # most that may be called near, as a fraction of the extent of all demonstrations


class Demonstrations(nn.Module):
    """Scaled sensations and commands of the demonstrations, saved in the checkpoint (at most some 2 MB).

    Args:
        joint_dim (`int`):
            Number of joints D_j.
        feature_dim (`int`):
            Number of image features D_f.
        fps (`float`, *optional*, defaults to 10.0):
            Control steps a second.
    """

    sensed: Tensor
    commands: Tensor
    lengths: Tensor
    indices: Tensor
    fps: Tensor

    def __init__(self, joint_dim: int, feature_dim: int, fps: float = 10.0):
        super().__init__()
        self.register_buffer("sensed", torch.zeros(0, joint_dim + feature_dim))
        self.register_buffer("commands", torch.zeros(0, joint_dim))
        self.register_buffer("lengths", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("indices", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("fps", torch.tensor(float(fps)))
        self._moments: tuple[SHLSTM, Moments | None] | None = None
        self._is_full = False

    @property
    def stride(self) -> int:
        """`int`: control steps from one moment to the next."""
        return max(1, round(SPACING * float(self.fps)))

    @torch.no_grad()
    def remember(self, index: int, sensed: Tensor, commands: Tensor) -> None:
        """Adds a demonstration, scaled: sensations (L, D) and commands (L, D_j). One too many is left out."""
        if index in self.indices:
            return
        if len(self.sensed) + len(sensed) > MOST_MOMENTS * self.stride:
            if not self._is_full:
                logger.info("The memory is full with %d demonstrations; more are not remembered.", len(self.lengths))
            self._is_full = True
            return
        self.sensed = torch.cat((self.sensed, sensed))
        self.commands = torch.cat((self.commands, commands))
        self.lengths = torch.cat((self.lengths, self.lengths.new_tensor([len(sensed)])))
        self.indices = torch.cat((self.indices, self.indices.new_tensor([index])))
        self._moments = None

    def moments(self, network: SHLSTM) -> "Moments | None":
        """Moments as this network went through them; `None` if there is no choice between ways to be had from them.

        They are computed once: the network is taken to stay as it is until the next training.
        """
        if self._moments is None or self._moments[0] is not network:
            self._moments = network, Moments.of(self, network)
            if self._moments[1] is None:
                logger.info("Of %d demonstrations no two part: there is nothing to choose between.", len(self.lengths))
        return self._moments[1]

    def _apply(self, *args: Any, **kwargs: Any) -> "Demonstrations":
        self._moments = None  # it may be on another device now
        return super()._apply(*args, **kwargs)

    def train(self, mode: bool = True) -> "Demonstrations":
        """Forgets what it computed: the network changes."""
        self._moments = None
        return super().train(mode)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        for name, buffer in self._buffers.items():
            if buffer is not None and prefix + name in state_dict:
                self._buffers[name] = buffer.new_zeros(state_dict[prefix + name].shape)
        self._moments = None
        super()._load_from_state_dict(state_dict, prefix, *args)


@dataclass(frozen=True)
class Moments:
    """The demonstrations at moments a tenth of a second apart, one after the other; M moments of n demonstrations.

    Attributes:
        joints (`Tensor`), features (`Tensor`), commands (`Tensor`): scaled, (M, D_j), (M, D_f) and (M, D_j).
        before (`HiddenState`): the network's state before it sensed each moment, (M, hidden size) each.
        owner (`Tensor`): which demonstration each is of, int64 (M,).
        begin (`Tensor`), end (`Tensor`): first and last moment of each demonstration, int64 (n,).
        arc (`Tensor`): length of the joints' path from the beginning, (M,).
        half_step (`Tensor`): half the distance to the next moment, (M,).
        apart (`Tensor`): how far each moment is from the path of each demonstration, (M, n).
        dwell (`Tensor`): for how many seconds the demonstration stayed near each; infinite where it ended, (M,).
        near (`float`): distance of joints that is near: how far one demonstration usually passes another.
        alike (`float`): difference of features that is none: twice that to the demonstration that looks most alike.
        pace (`float`): usual distance from moment to moment.
        lead (`float`): usual distance from joints to their command.
        spacing (`float`): seconds from moment to moment.
        stride (`int`): control steps from moment to moment.
    """

    joints: Tensor
    features: Tensor
    commands: Tensor
    before: HiddenState
    owner: Tensor
    begin: Tensor
    end: Tensor
    arc: Tensor
    half_step: Tensor
    apart: Tensor
    dwell: Tensor
    near: float
    alike: float
    pace: float
    lead: float
    spacing: float
    stride: int

    @classmethod
    @torch.no_grad()
    def of(cls, demonstrations: Demonstrations, network: SHLSTM) -> "Moments | None":
        """Takes the measures of what is remembered; `None` if there are fewer than two ways."""
        lengths = demonstrations.lengths.tolist()
        if len(lengths) < 2:
            return None
        stride, dim = demonstrations.stride, network.joint_dim
        spacing = stride / float(demonstrations.fps)
        rows = [torch.arange(0, length, stride) for length in lengths]
        sensed = demonstrations.sensed.split(lengths)
        parts = [values[row.to(values.device)] for values, row in zip(sensed, rows, strict=True)]
        joints = [part[:, :dim] for part in parts]
        commands = [v[r.to(v.device)] for v, r in zip(demonstrations.commands.split(lengths), rows, strict=True)]
        steps = [(path[1:] - path[:-1]).norm(dim=-1) for path in joints]
        moving = torch.cat(steps)
        pace = float(moving[moving > 0.1 * moving.max()].median()) if moving.any() else 0.0
        if pace == 0:
            return None
        device = joints[0].device
        counts = torch.tensor([len(path) for path in joints], device=device)
        owner = torch.repeat_interleave(torch.arange(len(joints), device=device), counts)
        end = counts.cumsum(0) - 1
        all_joints, features = torch.cat(joints), torch.cat([part[:, dim:] for part in parts])
        gaps, looks = torch.cdist(all_joints, all_joints), torch.cdist(features, features)

        def to_neighbour(distances: Tensor, rank: int) -> Tensor:
            """Distance (M,) of each moment from the demonstration that passes it as so many-th nearest."""
            to_each = _nearest_of_each(distances, owner, len(joints))
            to_each.scatter_(1, owner[:, None], math.inf)
            return to_each.sort(dim=-1).values[:, rank - 1]

        half_step = torch.cat([torch.cat((step, step[-1:] if len(step) else step.new_zeros(1))) / 2 for step in steps])
        most = FARTHEST_NEAR * float((all_joints.amax(0) - all_joints.amin(0)).norm())
        for rank in range(min(NEIGHBOURS, len(joints) - 1), 0, -1):
            near = float(to_neighbour(gaps, rank).quantile(0.75))
            if near <= most:
                break  # of fewer demonstrations a way, those farther off go another way
        near = max(pace, min(near, most))
        # The nearest one only: where a colour tells the way, those of the other ways look different.
        differences = to_neighbour(looks.masked_fill(gaps >= near, math.inf), 1)
        differences = differences[differences.isfinite()]
        change = float(torch.cat([(part[1:, dim:] - part[:-1, dim:]).norm(dim=-1) for part in parts]).median())
        alike = max(2 * float(differences.quantile(0.95)) if len(differences) else 0.0, change, 1e-6)
        moments = cls(
            joints=all_joints,
            features=features,
            commands=torch.cat(commands),
            before=_states_before(network, sensed, rows),
            owner=owner,
            begin=end - counts + 1,
            end=end,
            arc=torch.cat([torch.cat((step.new_zeros(1), step.cumsum(0))) for step in steps]),
            half_step=half_step,
            apart=_nearest_of_each((gaps - half_step).clamp(min=0), owner, len(joints)),
            dwell=torch.cat([_dwell(part[:, :dim], part[:, dim:], near, 3 * alike) for part in parts]) * spacing,
            near=near,
            alike=alike,
            pace=pace,
            lead=max(float((torch.cat(commands) - all_joints).norm(dim=-1).median()), 1e-3),
            spacing=spacing,
            stride=stride,
        )
        if all(moments.same_way(row, begin, math.inf).min() > 0.5 for row, begin in enumerate(moments.begin.tolist())):
            return None
        return moments

    @property
    def size(self) -> int:
        """`int`: number n of demonstrations."""
        return len(self.begin)

    def pull(self, joints: Tensor, commands: Tensor) -> Tensor:
        """What commands ask for, (..., D_j): from joints to command, no farther than demonstrations usually asked."""
        asked = commands - joints
        return asked * (self.lead / asked.norm(dim=-1, keepdim=True).clamp(min=self.lead))

    def gap(self, joints: Tensor) -> Tensor:
        """Distance of joints (K, D_j) from the path at each moment, (K, M)."""
        return (torch.cdist(joints, self.joints) - self.half_step).clamp(min=0)

    def same_way(self, which: int, start: int, length: float) -> Tensor:
        """How much each demonstration passes along a piece of one, (n,): from its moment `start` over a length of path.

        It is 1 where it does not stray from the piece, and falls to 0 from about twice `near` on.
        """
        ahead = self.arc - self.arc[start]
        strays = self.apart[(self.owner == which) & (ahead >= 0) & (ahead <= length)].amax(0)
        return torch.exp(-0.5 * (strays / (2 * self.near)) ** 4)

    def parting(self, which: int, phases: Tensor, others: list[int]) -> int:
        """The moment from which on one demonstration has parted from all these others, given their moments (n,)."""
        begin = int(phases[which])
        away = self.apart[begin : int(self.end[which]) + 1, others] >= 2 * self.near
        first = away.to(torch.uint8).argmax(0) * away.any(0)
        return begin + int(first.max() if len(others) else 0)

    @torch.no_grad()
    def not_followed(self, network: SHLSTM) -> list[int]:
        """Demonstrations that a network leaves when it imagines them from where they part from all other ways."""
        left = []
        for which in range(self.size):
            begin, end = int(self.begin[which]), int(self.end[which]) + 1
            other_ways = self.same_way(which, begin, math.inf) < 0.5
            together = (self.apart[begin:end, other_ways] < 2 * self.near).any(-1).nonzero()
            start = begin + (int(together[-1]) + 1 if len(together) else 0)
            if start >= end - 1:
                continue  # all ways end alike
            sensed = torch.cat((self.joints[start], self.features[start]))[None]
            state, path = network.step(sensed, self.before.at(slice(start, start + 1))), []
            for _ in range((end - start) * self.stride):
                expected = network.predict_mean(state)
                path.append(expected[:, : self.joints.shape[-1]])
                state = network.step(expected, state)
            missed = (torch.cat(path) - self.joints[end - 1]).norm(dim=-1).min()
            if missed > max(4 * self.near, 0.25 * float(self.arc[end - 1] - self.arc[start])):
                left.append(which)
        return left


def _nearest_of_each(distances: Tensor, owner: Tensor, count: int) -> Tensor:
    """Least distance to each demonstration, from that to each moment: (..., M) -> (..., n)."""
    nearest = distances.new_full((*distances.shape[:-1], count), math.inf)
    return nearest.scatter_reduce(-1, owner.expand_as(distances), distances, "amin")


def _dwell(joints: Tensor, features: Tensor, near: float, alike: float) -> Tensor:
    """For how many moments (L,) a demonstration stayed near each without a break; infinite at its end."""
    stays = (torch.cdist(joints, joints) <= near) & (torch.cdist(features, features) <= alike)
    index = torch.arange(len(joints), device=joints.device)
    leaves = index.where(~stays & (index > index[:, None]), len(joints)).amin(-1)
    came = index.where(~stays & (index < index[:, None]), -1).amax(-1)
    return torch.where(leaves == len(joints), math.inf, leaves - came - 1)


def _states_before(network: SHLSTM, sensed: tuple[Tensor, ...], rows: list[Tensor]) -> HiddenState:
    """The network's state before it senses these rows of each demonstration, when it reads them from the beginning."""
    padded = nn.utils.rnn.pad_sequence(list(sensed))  # (L, n, D)
    states = [network.initial_state(padded.shape[1])]
    for inputs in padded[:-1]:
        states.append(network.step(inputs, states[-1]))
    stacked = HiddenState.stack(states)  # (L, n, hidden size) each
    return HiddenState(*(torch.cat([v[r.to(v.device), i] for i, r in enumerate(rows)]) for v in stacked))
