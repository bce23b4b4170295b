"""What to record: the options of the recorder."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from draccus.utils import ParsingError
from huggingface_hub.utils import HFValidationError, validate_repo_id
from lerobot.configs.video import RGBEncoderConfig
from lerobot.utils.constants import HF_LEROBOT_HOME

from env_door.checks import check_choice, check_range
from env_door.latch import KINDS, check_kinds
from env_door.limits import MAX_OFFSET

ROBOT_TYPES = {"ur5e": "ur5e_robotiq", "panda": "panda"}
# Options that may change between the runs that make up one dataset.
FREE_OPTIONS = ("repo_id", "root", "episodes_per_kind", "push_to_hub", "private", "tags", "resume")


@dataclass
class FrameEncoderConfig(RGBEncoderConfig):
    """Encoder that codes every frame alone, at a constant quantiser and with full colour resolution.

    A decoded frame is then a function of the rendered frame and of nothing else: no later frame, which would show
    the kind of the door, leaves a trace in an earlier one. Any frame is decoded without its neighbours, too. The usual
    halved colour resolution blurs the small coloured parts of a 128-pixel image, which a policy sees sharp at run time.
    """

    vcodec: str = "h264"
    pix_fmt: str = "yuv444p"
    g: int | None = 1
    crf: int | float | None = None
    fast_decode: int = 1
    extra_options: dict[str, Any] = field(default_factory=lambda: {"qp": 20})


@dataclass
class DatasetConfig:
    """What to record, and where to, whatever the environment."""

    repo_id: str
    """Name of the dataset, {hf_username}/{dataset_name}."""
    root: str | Path | None = None
    """Folder of the dataset; by default $HF_LEROBOT_HOME/{repo_id}."""
    episodes_per_kind: int = 5
    """Episodes to save for each kind of door or way."""
    kinds: list[str] = field(default_factory=list)
    """Kinds of door or ways to record."""
    seed: int = 0
    """First seed; the following episodes count up from it."""
    matched: bool = True
    """Use the same seeds for every kind or way."""
    rgb_encoder: FrameEncoderConfig = field(default_factory=FrameEncoderConfig)
    """Video encoder; by default one that keeps the kind of the door out of earlier frames."""
    push_to_hub: bool = False
    """Upload the dataset once it is complete."""
    private: bool | None = None
    """Upload as a private dataset; None leaves it to the Hub's default."""
    tags: list[str] | None = None
    """Tags of the dataset on the Hub."""
    resume: bool = False
    """Go on with an interrupted recording, or extend a finished one."""

    def __post_init__(self) -> None:
        wanted = "repo_id must read {hf_username}/{dataset_name}, for example my-name/door"
        try:
            validate_repo_id(self.repo_id)
        except HFValidationError as error:
            raise ParsingError(f"{wanted}: {error}") from error
        if "/" not in self.repo_id:
            raise ParsingError(f"{wanted}; got {self.repo_id!r}.")
        if "/eval_" in self.repo_id:
            raise ParsingError(f"Dataset names starting with 'eval_' are reserved for evaluations, got {self.repo_id}.")
        check_range(self, "episodes_per_kind", low=1)
        check_range(self, "seed", low=0)

    @property
    def path(self) -> Path:
        """Folder of the dataset."""
        return Path(self.root).expanduser().resolve() if self.root else HF_LEROBOT_HOME / self.repo_id

    @property
    def total_episodes(self) -> int:
        """Episodes of the complete dataset."""
        return self.episodes_per_kind * len(self.kinds)

    @property
    def robot_type(self) -> str | None:
        """Name of the real robot whose joints these are, if there is one."""
        return None

    @property
    def hint(self) -> str:
        """What may help an expert that keeps failing."""
        return ""

    @property
    def settings(self) -> dict[str, Any]:
        """The options that every episode of a dataset must share."""
        return {name: value for name, value in asdict(self).items() if name not in FREE_OPTIONS}


@dataclass
class RecordConfig(DatasetConfig):
    """What to record of the door, and where to."""

    kinds: list[str] = field(default_factory=lambda: list(KINDS))
    """Kinds of door to record: push, pull, slide, and further slide_right, push_ccw, pull_ccw, slide_ccw,
    slide_right_ccw."""
    arm: str = "ur5e"
    """ur5e or panda."""
    door_offset: float = 0.0
    """Half-width in m, 0 to 0.05, of the range of the door's lateral shift: spread evenly if matched, else drawn."""
    num_steps: int = 150
    """Frames of an episode, 10 a second."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "num_steps", low=1)
        check_choice(self, "arm", ROBOT_TYPES)
        check_range(self, "door_offset", low=0.0, high=MAX_OFFSET, unit="m")
        check_kinds(self.kinds, "kinds")

    @property
    def robot_type(self) -> str:
        """Name of the real robot whose joints these are."""
        return ROBOT_TYPES[self.arm]

    @property
    def hint(self) -> str:
        """What may help an expert that keeps failing."""
        return f" With num_steps={self.num_steps} it may lack the time to open the door; 150 is enough for every kind."
