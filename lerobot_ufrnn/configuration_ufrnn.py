"""Every knob of the `ufrnn` policy."""

import math
from dataclasses import dataclass, field

from draccus.utils import ParsingError
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from .foresight import PERTURBED_STATES

CHOICES = {
    "exploration": ("foresight", "noise", "none"),
    "noise_unit": ("variance", "std"),
    "noise_scale": ("linear", "log"),
    "perturbed_states": tuple(PERTURBED_STATES),
    "variance_baseline": ("common", "candidate"),
    "variance_aggregation": ("variance", "entropy"),
    "horizon_mode": ("fixed", "learned"),
    "command_target": ("action", "next_state"),
    "kernel": ("auto", "fast", "reference"),
}


@PreTrainedConfig.register_subclass("ufrnn")
@dataclass
class UFRNNConfig(PreTrainedConfig):
    """Configuration of UF-RNN and its two baselines.

    Where the paper (Hiruma, Ito, Ogata: UF-RNN) leaves a choice open, both readings are offered.

    Args:
        exploration (`str`, *optional*, defaults to `"foresight"`):
            `foresight` is UF-RNN, `noise` the baseline SH-RNN+noise, `none` the baseline SH-RNN.
        num_samples (`int`, *optional*, defaults to `5`):
            Number N of perturbed candidates per step (Sec. III-C, Sec. IV-B).
        horizon (`int`, *optional*, defaults to `10`):
            Number T of steps imagined ahead; the longest horizon where it is learned (Sec. IV-B).
        horizon_mode (`str`, *optional*, defaults to `"fixed"`):
            `learned` cuts each candidate's horizon to `ceil(T * sigmoid(step))`, the larger of both modalities
            (Sec. III-B, item 3). The paper gives the step scalar no loss; here it learns at which imagined step the
            kept future was least uncertain.
        noise_range (`tuple[float, float]`, *optional*, defaults to `(0.05, 0.15)`):
            Hidden-state noise at the least and at the most uncertain moment (Sec. III-C.1).
        noise_unit (`str`, *optional*, defaults to `"std"`):
            Whether `noise_range` is a `variance`, as the notation N(H, f) says, or a standard deviation (`std`).
        noise_scale (`str`, *optional*, defaults to `"linear"`):
            Whether f places the variance within its range on a `linear` or a `log` scale.
        perturbed_states (`str`, *optional*, defaults to `"hidden"`):
            What is perturbed: `hidden` the h of all LSTMs, `shared` only that of the upper one, `hidden_and_cell` all
            h and c.
        variance_baseline (`str`, *optional*, defaults to `"common"`):
            `o_t^var` in the selection rule: `common` takes the variance predicted for this step, `candidate` each
            perturbed state's own.
        variance_aggregation (`str`, *optional*, defaults to `"variance"`):
            One number from many variances: mean `variance` of each modality, summed, or the same of log-variances
            (`entropy`).
        keep_unperturbed (`bool`, *optional*, defaults to `False`):
            Whether the unperturbed hidden state is one of the N candidates.

        recall (`bool`, *optional*, defaults to `True`):
            Whether acting goes back to a remembered state when the joints are not where they were predicted to be, and
            tries another future from there (see `recall.py`; not in the paper). Not used in training.
        surprise_threshold (`float`, *optional*, defaults to `4.0`):
            Squared prediction error of the joints, in units of the predicted variance, from which to go back, if the
            arm does not move as foreseen. It is one on average while all goes as foreseen.
        recall_samples (`int`, *optional*, defaults to `60`):
            Number of imagined futures.
        recall_noise (`tuple[float, float]`, *optional*, defaults to `(1.0, 5.0)`):
            Range of how far the first sensations that they imagine deviate from the expected ones, in predicted
            standard deviations.
        recall_horizon (`int`, *optional*, defaults to `60`):
            Imagined steps by whose end futures are compared.
        recall_commitment (`int`, *optional*, defaults to `24`):
            Imagined steps that are carried out, at the arm's pace, before it listens to its senses again.
        recall_memory (`float`, *optional*, defaults to `200.0`):
            Steps in which the memory of a failed try fades to 1/e; 0 forgets at once.
        recall_at_rest (`bool`, *optional*, defaults to `True`):
            Whether it also goes back when the arm has come to rest where no demonstration began or ended (see
            `rest.py`). It never does if a demonstration paused on its way for 20 steps.

        joint_hidden_dim (`int`, *optional*, defaults to `50`):
            Hidden size of `LSTM_joint`.
        image_hidden_dim (`int`, *optional*, defaults to `50`):
            Hidden size of `LSTM_image`.
        shared_hidden_dim (`int`, *optional*, defaults to `20`):
            Hidden size of `LSTM_shared`.
        log_variance_range (`tuple[float, float]`, *optional*, defaults to `(-9.0, 3.0)`):
            Soft bounds of predicted log-variances, in scaled units (data within [-0.8, 0.8]).
        command_target (`str`, *optional*, defaults to `"action"`):
            What is commanded: the demonstrated `action`, learned by a head of its own, or the predicted `next_state`
            itself as in the paper. A gripper that squeezes needs the action; its measurement would let go.

        image_size (`tuple[int, int]`, *optional*, defaults to `(128, 128)`):
            Height and width in pixels that camera images are resized to.
        feature_dim (`int`, *optional*, defaults to `10`):
            Image features per camera.
        conv_channels (`tuple[int, ...]`, *optional*, defaults to `(64, 64)`):
            Channels of the autoencoder's convolutions; all but the first halve height and width.
        conv_first_stride (`int`, *optional*, defaults to `16`):
            By how much the first convolution divides height and width. Patches of 16 pixels learn in a tenth of the
            time of the usual 2 (as in `configs/ufrnn_paper.yaml`), at a lower error.
        autoencoder_hidden_dim (`int`, *optional*, defaults to `128`):
            Width of the linear layer around the bottleneck.
        autoencoder_steps (`int`, *optional*, defaults to `400`):
            Training updates spent on the autoencoder before the recurrent network starts.
        autoencoder_batch_size (`int`, *optional*, defaults to `16`):
            Frames per autoencoder update, drawn from the batch's episodes.
        autoencoder_lr (`float`, *optional*, defaults to `3e-3`):
            Adam learning rate of the autoencoder.
        autoencoder_path (`str`, *optional*):
            Checkpoint folder or Hub repository of a `ufrnn` policy whose trained autoencoder is taken over; no update
            is then spent on it.
        image_shift (`int`, *optional*, defaults to `2`):
            Largest random shift in pixels while training the autoencoder.
        image_jitter (`float`, *optional*, defaults to `0.1`):
            Largest relative change of brightness and colour while training the autoencoder.
        image_noise (`float`, *optional*, defaults to `0.02`):
            Standard deviation of pixel noise while training the autoencoder.

        kernel (`str`, *optional*, defaults to `"auto"`):
            What computes recurrence and foresight: `reference` is the readable PyTorch code, `fast` the same compiled
            for the CPU (on whatever device the weights are), `auto` is `fast` where Numba can be imported.
        input_noise (`float`, *optional*, defaults to `0.05`):
            Standard deviation of noise on the recurrent network's inputs during training, in scaled units.
        input_noise_correlation (`float`, *optional*, defaults to `0.95`):
            Correlation of that noise from step to step. Noise that drifts teaches the network to lead back to the
            demonstrated way from beside it, so that what it imagines in closed loop stays true.
        hold_end_steps (`int`, *optional*, defaults to `0`):
            Steps for which training holds the last moment of a demonstration on. For recordings that stop while the arm
            still moves, 20 make it come to rest where they ended, instead of before.
        stall_probability (`float`, *optional*, defaults to `0.0`):
            Probability per step that the observation stalls and its target waits (training only). Stalls tie progress
            to what is seen; they also make episodes longer and learning slower.
        stall_steps (`int`, *optional*, defaults to `12`):
            Longest stall in steps.
        stall_stretch (`float`, *optional*, defaults to `1.3`):
            Longest stalled episode as a multiple of the longest episode of the batch; bounds the time of an update.
        optimizer_lr (`float`, *optional*, defaults to `5e-4`):
            Adam learning rate of the recurrent network. The paper states 1e-4.
        optimizer_grad_clip_norm (`float`, *optional*, defaults to `1.0`):
            Largest norm of the gradient.
        drop_n_last_frames (`int`, *optional*, defaults to `0`):
            Read by LeRobot's sampler. Training sets it so that each episode is one item (see `UFRNNPolicy`).

    Raises:
        ParsingError: If a field is out of range (the parser of LeRobot's command lines hides the text of a ValueError).
    """

    exploration: str = "foresight"
    num_samples: int = 5
    horizon: int = 10
    horizon_mode: str = "fixed"
    noise_range: tuple[float, float] = (0.05, 0.15)
    noise_unit: str = "std"
    noise_scale: str = "linear"
    perturbed_states: str = "hidden"
    variance_baseline: str = "common"
    variance_aggregation: str = "variance"
    keep_unperturbed: bool = False

    recall: bool = True
    surprise_threshold: float = 4.0
    recall_samples: int = 60
    recall_noise: tuple[float, float] = (1.0, 5.0)
    recall_horizon: int = 60
    recall_commitment: int = 24
    recall_memory: float = 200.0
    recall_at_rest: bool = True

    joint_hidden_dim: int = 50
    image_hidden_dim: int = 50
    shared_hidden_dim: int = 20
    log_variance_range: tuple[float, float] = (-9.0, 3.0)
    command_target: str = "action"

    image_size: tuple[int, int] = (128, 128)
    feature_dim: int = 10
    conv_channels: tuple[int, ...] = (64, 64)
    conv_first_stride: int = 16
    autoencoder_hidden_dim: int = 128
    autoencoder_steps: int = 400
    autoencoder_batch_size: int = 16
    autoencoder_lr: float = 3e-3
    autoencoder_path: str | None = None
    image_shift: int = 2
    image_jitter: float = 0.1
    image_noise: float = 0.02

    kernel: str = "auto"
    input_noise: float = 0.05
    input_noise_correlation: float = 0.95
    hold_end_steps: int = 0
    stall_probability: float = 0.0
    stall_steps: int = 12
    stall_stretch: float = 1.3
    optimizer_lr: float = 5e-4
    optimizer_grad_clip_norm: float = 1.0

    # LeRobot's own fields, with what suits this policy.
    drop_n_last_frames: int = 0
    # Without a Hub repository the stock training command should just work.
    push_to_hub: bool = False  # type: ignore[assignment]
    # State and action share one scaling, which lives in the policy beside the weights that depend on it.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, allowed in CHOICES.items():
            value = getattr(self, name)
            if value not in allowed:
                raise ParsingError(f"`{name}` must be one of {list(allowed)}, got {value!r}.")
        for name in (
            *("num_samples", "horizon", "joint_hidden_dim", "image_hidden_dim", "shared_hidden_dim"),
            *("feature_dim", "autoencoder_hidden_dim", "autoencoder_batch_size", "autoencoder_steps", "stall_steps"),
            *("conv_first_stride", "recall_samples", "recall_horizon"),
        ):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        for name in ("image_shift", "drop_n_last_frames", "recall_commitment", "hold_end_steps"):
            self._require(name, getattr(self, name) >= 0, "at least 0")
        for name in ("image_jitter", "image_noise", "input_noise", "input_noise_correlation"):
            self._require(name, 0 <= getattr(self, name) < 1, "from 0 to below 1")
        for name in ("optimizer_lr", "autoencoder_lr", "optimizer_grad_clip_norm"):
            self._require(name, 0 < getattr(self, name) < math.inf, "above 0")
        self._require("surprise_threshold", 1 < self.surprise_threshold < math.inf, "above 1")
        self._require("recall_memory", 0 <= self.recall_memory < math.inf, "at least 0")
        self._require("recall_commitment", self.recall_commitment <= self.recall_horizon, "at most `recall_horizon`")
        low, high = self._pair("recall_noise")
        self._require("recall_noise", 0 <= low <= high < math.inf, "two numbers with 0 <= low <= high")
        self._require("stall_probability", 0 <= self.stall_probability <= 1, "from 0 to 1")
        self._require("stall_stretch", 1 <= self.stall_stretch < math.inf, "at least 1")
        low, high = self._pair("noise_range")
        self._require("noise_range", 0 <= low <= high < math.inf, "two numbers with 0 <= low <= high")
        low, high = self._pair("log_variance_range")
        self._require("log_variance_range", -math.inf < low < high < math.inf, "two finite numbers with low < high")
        height, width = self._pair("image_size")
        self._require("image_size", min(height, width) >= 16, "at least 16 x 16 pixels")
        self._require("conv_first_stride", self.conv_first_stride <= min(height, width), "at most the image's side")
        halvings = len(self.conv_channels) - 1
        self._require(
            "conv_channels",
            halvings >= 0
            and min(self.conv_channels) >= 1
            and self.conv_first_stride * 2**halvings <= min(height, width),
            "positive, and no more of them than the image can be halved after `conv_first_stride`",
        )

    def _pair(self, name: str) -> tuple[float, float]:
        value = getattr(self, name)
        if len(value) != 2:
            raise ParsingError(f"`{name}` must hold two numbers, got {value}.")
        return value[0], value[1]

    def _require(self, name: str, condition: bool, allowed: str) -> None:
        if not condition:
            raise ParsingError(f"`{name}` must be {allowed}, got {getattr(self, name)}.")

    @property
    def cameras(self) -> tuple[str, ...]:
        """`tuple[str, ...]`: camera keys in the order of their features."""
        return tuple(sorted(self.image_features))

    def validate_features(self) -> None:
        """Checks that the dataset or environment has what UF-RNN reads and commands.

        Raises:
            ValueError: If the joint state, the action or all cameras are missing, or joints and action differ in size.
        """
        given = f"inputs {sorted(self.input_features or {})}, outputs {sorted(self.output_features or {})}"
        state, action = self.robot_state_feature, self.action_feature
        if state is None or action is None:
            missing = OBS_STATE if state is None else ACTION
            raise ValueError(f"UF-RNN needs '{missing}', but it is missing: got {given}.")
        if not self.image_features:
            raise ValueError(
                f"UF-RNN needs at least one camera image ('observation.images.<name>'), got {given}. "
                "Record with a camera, e.g. `ufrnn record` or `lerobot-record --robot.cameras=...`."
            )
        if len(state.shape) != 1 or state.shape != action.shape:
            raise ValueError(
                "UF-RNN feeds its predicted joints back as the next measured ones, so state and action must be vectors "
                f"of the same joints; got '{OBS_STATE}' of shape {state.shape} and '{ACTION}' of shape {action.shape}."
            )
        for key, feature in self.image_features.items():
            if len(feature.shape) != 3 or feature.shape[0] != 3:
                raise ValueError(
                    f"Camera '{key}' must be a colour image of shape (3, height, width), got {feature.shape}."
                )

    def get_optimizer_preset(self) -> AdamConfig:
        """`AdamConfig`: Adam, as in the paper (Sec. IV-B)."""
        return AdamConfig(lr=self.optimizer_lr, grad_clip_norm=self.optimizer_grad_clip_norm)

    def get_scheduler_preset(self) -> None:
        """No schedule: the paper trains at a constant rate."""
        return

    @property
    def observation_delta_indices(self) -> None:
        """`None`: an item names an episode; its frames come from `EpisodeStore`, decoded once."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """`None`: see `observation_delta_indices`."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """`None`: rewards are not used."""
        return None
