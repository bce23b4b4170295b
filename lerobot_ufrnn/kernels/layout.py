"""What the compiled functions pass to each other: weights, sizes, options, and what a walk leaves behind.

A state is two rows, hidden and cell, with the parts `[joint | image | shared]`. Gates are in the order input, forget,
output, candidate; the weights of the first three are halved (see `packing.py`), since
`sigmoid(a) = (1 + tanh(a / 2)) / 2`: so every gate is stored as a hyperbolic tangent.
"""

from typing import NamedTuple

import numpy as np


class Weights(NamedTuple):
    """Weights as the compiled functions read them: panels of inputs x outputs, see `multiply_add`.

    Attributes:
        shared (`np.ndarray`): gates of the shared cell from `[h_joint | h_image | h_shared]`.
        joint (`np.ndarray`): gates of the joint cell from `[joints | h_shared]`.
        image (`np.ndarray`): gates of the image cell from `[features | h_shared]`.
        joint_mean (`np.ndarray`): joint means before tanh, from `h_joint`.
        image_mean (`np.ndarray`): feature means before tanh, from `h_image`.
        joint_spread (`np.ndarray`): unbounded log-variances of the joints and the step scalar, from `h_joint`.
        image_spread (`np.ndarray`): the same of the features, from `h_image`.
    """

    shared: np.ndarray
    shared_bias: np.ndarray
    joint: np.ndarray
    joint_bias: np.ndarray
    image: np.ndarray
    image_bias: np.ndarray
    joint_mean: np.ndarray
    joint_mean_bias: np.ndarray
    image_mean: np.ndarray
    image_mean_bias: np.ndarray
    joint_spread: np.ndarray
    joint_spread_bias: np.ndarray
    image_spread: np.ndarray
    image_spread_bias: np.ndarray


class Sizes(NamedTuple):
    """Sizes of the network: dimensions of joints and features, hidden sizes of the three cells."""

    joint_dim: int
    feature_dim: int
    joint_hidden: int
    image_hidden: int
    shared_hidden: int


class Options(NamedTuple):
    """What `UFRNNConfig` says of prediction and foresight, in numbers.

    Attributes:
        log_variance_low (`float`), log_variance_high (`float`): bounds of predicted log-variances.
        perturbs (`bool`): whether any noise is added.
        selects (`bool`): whether futures are imagined to select by.
        horizon (`int`): steps imagined ahead, T.
        learned_horizon (`bool`), own_baseline (`bool`), entropy (`bool`): see `Foresight`.
        noise_low (`float`), noise_high (`float`), noise_is_variance (`bool`), log_scale (`bool`): see `NoiseSchedule`.
        noise_columns (`tuple`): first column of the noise of each `HiddenState` field, -1 where it is not perturbed.
    """

    log_variance_low: float
    log_variance_high: float
    perturbs: bool
    selects: bool
    horizon: int
    learned_horizon: bool
    own_baseline: bool
    entropy: bool
    noise_low: float
    noise_high: float
    noise_is_variance: bool
    log_scale: bool
    noise_columns: tuple[int, int, int, int, int, int]


class Steps(NamedTuple):
    """Everything that a walk through L steps of B episodes leaves behind; filled in place.

    Attributes:
        hidden (`np.ndarray`), cell (`np.ndarray`): state that is kept after each step, (L, B, H).
        raw_cell (`np.ndarray`): cell state before it was perturbed, (L, B, H).
        joint_input (`np.ndarray`): input of the joint cell, `[joints | h_shared]` (L, B, D_j + H_s).
        image_input (`np.ndarray`): input of the image cell, `[features | h_shared]` (L, B, D_f + H_s).
        shared_gates (`np.ndarray`), joint_gates (`np.ndarray`), image_gates (`np.ndarray`): (L, B, 4 hidden, padded).
        noise_std (`np.ndarray`): standard deviation of the noise, joints first, (L, B, 2).
        chosen (`np.ndarray`): kept candidate, (L, B).
        baseline (`np.ndarray`), final (`np.ndarray`): uncertainty before and at the horizon, (L, N, B).
        horizon (`np.ndarray`): imagined steps that counted, (L, N, B).
        calmest (`np.ndarray`): imagined step of least uncertainty, from 1, (L, N, B); with a learned horizon.
    """

    hidden: np.ndarray
    cell: np.ndarray
    raw_cell: np.ndarray
    joint_input: np.ndarray
    image_input: np.ndarray
    shared_gates: np.ndarray
    joint_gates: np.ndarray
    image_gates: np.ndarray
    noise_std: np.ndarray
    chosen: np.ndarray
    baseline: np.ndarray
    final: np.ndarray
    horizon: np.ndarray
    calmest: np.ndarray


class TransposedWeights(NamedTuple):
    """Panels of outputs x inputs: from the gradient of the gates to that of their inputs.

    Attributes:
        shared (`np.ndarray`): to `[h_joint | h_image | h_shared]`.
        joint (`np.ndarray`): to `h_shared`.
        image (`np.ndarray`): to `h_shared`.
        zeros (`np.ndarray`): a bias for all.
    """

    shared: np.ndarray
    joint: np.ndarray
    image: np.ndarray
    zeros: np.ndarray


class GateGradients(NamedTuple):
    """Gradients of the gates before tanh, (L, B, 4 hidden, padded) each; padding is zero."""

    shared: np.ndarray
    joint: np.ndarray
    image: np.ndarray
