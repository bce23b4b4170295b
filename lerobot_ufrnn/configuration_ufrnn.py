"""Configuration of the `ufrnn` policy. Where the paper leaves a choice open, each reading is a field."""

from dataclasses import dataclass, field

from draccus.utils import ParsingError
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from env_door.checks import check_choice, check_pair, check_range


@dataclass
class ForesightConfig:
    """How noisy futures are imagined and one is selected (Sec. III-C).

    Args:
        num_samples (`int`, *optional*, defaults to `5`):
            Candidates N per step.
        horizon (`int`, *optional*, defaults to `10`):
            Steps T imagined ahead; the longest horizon where it is learned.
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
            `hidden` perturbs the h of all LSTMs, `shared` only that of the upper one, `hidden_and_cell` all h and c.
        variance_baseline (`str`, *optional*, defaults to `"common"`):
            `o_t^var` in the selection rule: `common` takes the variance predicted for this step, `candidate` each
            perturbed state's own.
        variance_aggregation (`str`, *optional*, defaults to `"variance"`):
            One number from many variances: mean `variance` of each modality, summed, or the same of log-variances
            (`entropy`).
        keep_unperturbed (`bool`, *optional*, defaults to `False`):
            Whether the unperturbed hidden state is one of the N candidates.
    """

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

    def __post_init__(self) -> None:
        check_range(self, "num_samples", "horizon", low=1)
        check_pair(self, "noise_range")
        check_range(self, "noise_range", low=0)
        check_choice(self, "horizon_mode", ("fixed", "learned"))
        check_choice(self, "noise_unit", ("variance", "std"))
        check_choice(self, "noise_scale", ("linear", "log"))
        check_choice(self, "perturbed_states", ("hidden", "shared", "hidden_and_cell"))
        check_choice(self, "variance_baseline", ("common", "candidate"))
        check_choice(self, "variance_aggregation", ("variance", "entropy"))


@dataclass
class RecallConfig:
    """Going back to another demonstrated way when contradicted; acting only, not in the paper. See `recall.py`.

    Lengths and times beyond these are taken from the demonstrations.

    Args:
        enabled (`bool`, *optional*, defaults to `True`):
            Whether acting goes back when contradicted. If so, foresight chooses then and only then, between remembered
            states; if not, it explores at every step, as in the paper.
        horizon (`float`, *optional*, defaults to `2.0`):
            Seconds that candidates imagine ahead.
        stay (`float`, *optional*, defaults to `1.5`):
            Times as long as any demonstration stayed at a place that contradict.
        strange (`float`, *optional*, defaults to `3.0`):
            Times the usual difference between the scenes of demonstrations that contradict.
        patience (`float`, *optional*, defaults to `0.8`):
            Seconds without progress after which a way that is carried out is blocked.
    """

    enabled: bool = True
    horizon: float = 2.0
    stay: float = 1.5
    strange: float = 3.0
    patience: float = 0.8

    def __post_init__(self) -> None:
        check_range(self, "horizon", "patience", above=0, unit="s")
        check_range(self, "stay", "strange", above=1)


@dataclass
class AutoencoderConfig:
    """The convolutional autoencoder of each camera, and its training before that of the recurrent network.

    Args:
        image_size (`tuple[int, int]`, *optional*, defaults to `(128, 128)`):
            Height and width in pixels that camera images are resized to.
        feature_dim (`int`, *optional*, defaults to `10`):
            Image features per camera.
        conv_channels (`tuple[int, ...]`, *optional*, defaults to `(64, 64)`):
            Channels of the convolutions; all but the first halve height and width.
        conv_first_stride (`int`, *optional*, defaults to `16`):
            By how much the first convolution divides height and width. Patches of 16 pixels learn in a tenth of the
            time of the usual 2 (as in `configs/ufrnn_paper.yaml`), at a lower error.
        hidden_dim (`int`, *optional*, defaults to `128`):
            Width of the linear layer around the bottleneck.
        steps (`int`, *optional*, defaults to `400`):
            Training updates spent on it before the recurrent network starts.
        batch_size (`int`, *optional*, defaults to `16`):
            Frames per update, drawn from the batch's episodes.
        lr (`float`, *optional*, defaults to `3e-3`):
            Adam learning rate.
        path (`str`, *optional*):
            Checkpoint folder or Hub repository of a `ufrnn` policy whose trained autoencoder is taken over; no update
            is then spent on it.
        image_shift (`int`, *optional*, defaults to `2`):
            Largest random shift in pixels.
        image_jitter (`float`, *optional*, defaults to `0.1`):
            Largest relative change of brightness and colour.
        image_noise (`float`, *optional*, defaults to `0.02`):
            Standard deviation of pixel noise.
    """

    image_size: tuple[int, int] = (128, 128)
    feature_dim: int = 10
    conv_channels: tuple[int, ...] = (64, 64)
    conv_first_stride: int = 16
    hidden_dim: int = 128
    steps: int = 400
    batch_size: int = 16
    lr: float = 3e-3
    path: str | None = None
    image_shift: int = 2
    image_jitter: float = 0.1
    image_noise: float = 0.02

    def __post_init__(self) -> None:
        check_range(self, "feature_dim", "conv_first_stride", "hidden_dim", "steps", "batch_size", low=1)
        check_range(self, "lr", above=0)
        check_range(self, "image_shift", low=0)
        check_range(self, "image_jitter", "image_noise", low=0, below=1)
        check_range(self, "image_size", low=16, unit="pixels")
        if len(self.image_size) != 2:
            raise ParsingError(f"`image_size` must hold two numbers, height and width, got {self.image_size}.")
        check_range(self, "conv_first_stride", high=min(self.image_size))
        check_range(self, "conv_channels", low=1)
        smallest = self.conv_first_stride * 2 ** (len(self.conv_channels) - 1)
        if not self.conv_channels or smallest > min(self.image_size):
            raise ParsingError(
                "`conv_channels` must hold a number for the first convolution and one for each time the image is "
                f"halved after it, got {self.conv_channels} for {self.image_size} pixels."
            )


@dataclass
class AugmentationConfig:
    """What training does to demonstrations before the recurrent network reads them.

    Args:
        input_noise (`float`, *optional*, defaults to `0.05`):
            Standard deviation of noise on the inputs, in scaled units.
        input_noise_correlation (`float`, *optional*, defaults to `0.95`):
            Correlation of that noise from step to step. Noise that drifts teaches the network to lead back to the
            demonstrated way from beside it, so that what it imagines in closed loop stays true.
        hold_end_steps (`int`, *optional*, defaults to `0`):
            Steps for which the last moment is held on. For recordings that stop while the arm still moves, 20 make it
            come to rest where they ended, instead of before.
        stall_probability (`float`, *optional*, defaults to `0.0`):
            Probability per step that the observation stalls and its target waits. Stalls tie progress to what is
            seen; they also make episodes longer and learning slower.
        stall_steps (`int`, *optional*, defaults to `12`):
            Longest stall in steps.
        stall_stretch (`float`, *optional*, defaults to `1.3`):
            Longest stalled episode as a multiple of the longest episode of the batch; bounds the time of an update.
    """

    input_noise: float = 0.05
    input_noise_correlation: float = 0.95
    hold_end_steps: int = 0
    stall_probability: float = 0.0
    stall_steps: int = 12
    stall_stretch: float = 1.3

    def __post_init__(self) -> None:
        check_range(self, "input_noise", "input_noise_correlation", low=0, below=1)
        check_range(self, "hold_end_steps", low=0)
        check_range(self, "stall_probability", low=0, high=1)
        check_range(self, "stall_steps", "stall_stretch", low=1)


@PreTrainedConfig.register_subclass("ufrnn")
@dataclass
class UFRNNConfig(PreTrainedConfig):
    """Configuration of UF-RNN (Hiruma, Ito, Ogata) and its two baselines.

    Args:
        exploration (`str`, *optional*, defaults to `"foresight"`):
            `foresight` is UF-RNN, `noise` the baseline SH-RNN+noise, `none` the baseline SH-RNN.
        foresight (`ForesightConfig`), recall (`RecallConfig`), autoencoder (`AutoencoderConfig`), \
augmentation (`AugmentationConfig`):
            Groups of fields, set as in `--policy.recall.enabled=false`.
        joint_hidden_dim (`int`, *optional*, defaults to `50`):
            Hidden size of `LSTM_joint`.
        image_hidden_dim (`int`, *optional*, defaults to `50`):
            Hidden size of `LSTM_image`.
        shared_hidden_dim (`int`, *optional*, defaults to `20`):
            Hidden size of `LSTM_shared`.
        log_variance_range (`tuple[float, float]`, *optional*, defaults to `(-14.0, 3.0)`):
            Soft bounds of predicted log-variances, in scaled units (data within [-0.8, 0.8]).
        command_target (`str`, *optional*, defaults to `"action"`):
            What is commanded: the demonstrated `action`, learned by a head of its own, or the predicted `next_state`
            itself as in the paper. A gripper that squeezes needs the action; its measurement would let go.
        kernel (`str`, *optional*, defaults to `"auto"`):
            `reference` is the readable PyTorch code, `fast` the same compiled for the CPU (on whatever device the
            weights are), `auto` is `fast` where Numba can be imported and has compiled this configuration's readings.
        optimizer_lr (`float`, *optional*, defaults to `5e-4`):
            Adam learning rate of the recurrent network. The paper states 1e-4.
        optimizer_grad_clip_norm (`float`, *optional*, defaults to `1.0`):
            Largest norm of the gradient.
        drop_n_last_frames (`int`, *optional*, defaults to `0`):
            Read by LeRobot's sampler. Training sets it so that each episode is one item (see `UFRNNPolicy`).

    Raises:
        ParsingError: If a field is out of range.
    """

    # Exploration.
    exploration: str = "foresight"
    foresight: ForesightConfig = field(default_factory=ForesightConfig)
    recall: RecallConfig = field(default_factory=RecallConfig)

    # Architecture.
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    joint_hidden_dim: int = 50
    image_hidden_dim: int = 50
    shared_hidden_dim: int = 20
    log_variance_range: tuple[float, float] = (-14.0, 3.0)
    command_target: str = "action"
    kernel: str = "auto"

    # Training.
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
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
        check_choice(self, "exploration", ("foresight", "noise", "none"))
        check_choice(self, "command_target", ("action", "next_state"))
        check_choice(self, "kernel", ("auto", "fast", "reference"))
        check_range(self, "joint_hidden_dim", "image_hidden_dim", "shared_hidden_dim", low=1)
        check_range(self, "log_variance_range")
        check_pair(self, "log_variance_range", strictly=True)
        check_range(self, "optimizer_lr", "optimizer_grad_clip_norm", above=0)
        check_range(self, "drop_n_last_frames", low=0)

    @property
    def cameras(self) -> tuple[str, ...]:
        """`tuple[str, ...]`: camera keys in the order of their features."""
        return tuple(sorted(self.image_features))

    @property
    def joint_dim(self) -> int:
        """`int`: number of joints D_j, gripper included."""
        return self.action_feature.shape[0]

    @property
    def image_dim(self) -> int:
        """`int`: number of image features D_f, of all cameras together."""
        return self.autoencoder.feature_dim * len(self.cameras)

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

    # An item of a batch names an episode; its frames come from `EpisodeStore`, decoded once.
    @property
    def observation_delta_indices(self) -> None:
        """`None`: one frame an item."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """`None`: one frame an item."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """`None`: rewards are not used."""
        return None
