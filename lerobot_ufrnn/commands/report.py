"""`ufrnn report`: one page with all results, tables, pictures and videos in it."""

import subprocess
from dataclasses import dataclass, field
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import gymnasium as gym
import matplotlib.image
import numpy as np
from gymnasium.wrappers import RenderCollection
from numpy.typing import NDArray

from env_door.latch import KINDS, check_kinds

from ..analysis import report_sections
from ..analysis.foresight_picture import draw_strip
from ..analysis.report_page import Note, Picture, Section, Video, draw_picture, render
from ..analysis.trial import TrialHistory, run_trial
from ..analysis.trial_video import FRAMES_PER_SECOND, annotate, encode
from ..experiments.state import replace_text
from ..modeling_ufrnn import UFRNNPolicy
from .flags import parse_flags
from .policies import MODEL_NAMES, load_policy, read_provenance

VIDEO_SIZE = 384


@dataclass
class ReportConfig:
    """What to show. Whatever is missing is named in the page, with the command that makes it.

    Args:
        results_dir (`Path`, *optional*, defaults to `results`):
            Folder of the tables `door_protocol.csv`, `door_interference.csv` and `ablation.csv` and of the pictures
            `hidden.png`, `held.png`, `lyapunov.png` and `foresight.png`.
        output (`Path`, *optional*, defaults to `report.html`):
            Page to write.
        policy_path (`str`, *optional*):
            Checkpoint folder or Hub repository of the `ufrnn` policy whose trials are filmed and whose imagined futures
            are shown.
        dataset_dir (`Path`, *optional*):
            Folder of the demonstrations, to be described in the page's head.
        kinds (`list[str]`, *optional*, defaults to `["push", "pull", "slide"]`):
            Kinds of doors to film; one video each.
        arm (`str`, *optional*, defaults to `"ur5e"`):
            `ur5e` or `panda`.
        door_offset (`float`, *optional*, defaults to `0.0`):
            Half-width in metres of the range of the door's shift.
        seed (`int`, *optional*, defaults to `2000`):
            Seed of environment and exploration noise in the first trial with each kind of door; the others count up.
        trials_per_kind (`int`, *optional*, defaults to `8`):
            Most trials with each kind of door; the first that recovers from a wrong try is shown.
        num_steps (`int`, *optional*, defaults to `300`):
            Longest trial in steps.
    """

    results_dir: Path = Path("results")
    output: Path = Path("report.html")
    policy_path: str | None = None
    dataset_dir: Path | None = None
    kinds: list[str] = field(default_factory=lambda: list(KINDS))
    arm: str = "ur5e"
    door_offset: float = 0.0
    seed: int = 2000
    trials_per_kind: int = 8
    num_steps: int = 300

    def __post_init__(self) -> None:
        check_kinds(self.kinds, "--kinds")
        for name in ("trials_per_kind", "num_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}.")


def run(arguments: list[str]) -> None:
    """Writes the page."""
    config = parse_flags(ReportConfig, arguments)
    # What is quick to read and may be broken comes before the trials.
    measured = [
        part(config.results_dir)
        for part in (
            report_sections.success,
            report_sections.training,
            report_sections.interference,
            report_sections.ablation,
        )
    ]
    futures = report_sections.futures(config.results_dir)
    inside = [part(config.results_dir) for part in (report_sections.hidden_states, report_sections.exponents)]
    facts = _facts(config)
    recoveries = _film(config, futures)
    page = render("UF-RNN: opening doors that look the same", facts, [*measured, recoveries, futures, *inside])
    replace_text(config.output, page)
    print(f"Report: {config.output} ({len(page.encode()) / 1e6:.1f} MB)")


# ── Head of the page ──────────────────────────────────────────────────


def _facts(config: ReportConfig) -> dict[str, str]:
    facts = {"made": _date(datetime.now(UTC))}
    if commit := _commit(config.results_dir):
        facts["commit"] = commit
    if config.dataset_dir is not None:
        facts["demonstrations"] = _describe_dataset(config.dataset_dir)
    if config.policy_path is not None:
        facts["filmed policy"] = config.policy_path
    found = [config.results_dir / name for name in report_sections.FILES if (config.results_dir / name).exists()]
    for path in found:
        facts[path.name] = _date(datetime.fromtimestamp(path.stat().st_mtime, UTC))
    return facts


def _date(time: datetime) -> str:
    return f"{time:%Y-%m-%d %H:%M} UTC"


def _commit(folder: Path) -> str:
    """Commit of the repository that holds a folder, and whether it has changes; empty without one."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short=10", "HEAD") + (
            ", and uncommitted changes" if git("status", "--porcelain") else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return ""


def _describe_dataset(folder: Path) -> str:
    if not folder.is_dir():
        raise FileNotFoundError(f"--dataset_dir: there is no folder '{folder}'.")
    provenance = read_provenance(folder)
    if provenance is None:
        return str(folder)
    kinds = [episode["kind"] for episode in provenance.episodes]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    settings = provenance.settings
    return f"{folder}: {counts}; arm {settings['arm']}, door offset {settings['door_offset']:g} m"


# ── What needs a policy ───────────────────────────────────────────────


def _film(config: ReportConfig, futures: Section) -> Section:
    """Films a recovery a kind of door, and adds what was imagined in one of these trials to `futures`."""
    section = Section(
        "Recoveries on film",
        "A trial for each kind of door in which the first try was wrong and the door was opened all the same: the "
        "first such trial, not the best. What was tried so far stands above the picture.",
    )
    if config.policy_path is None:
        for without in (section, futures):
            without.notes.append(Note("There is none without a policy.", "ufrnn report --policy_path=<checkpoint>"))
        return section
    policy = load_policy(config.policy_path)
    shown: TrialHistory | None = None
    for kind in config.kinds:
        num_opened = 0
        for seed in range(config.seed, config.seed + config.trials_per_kind):
            history, frames = _run_filmed_trial(policy, config, kind, seed)
            num_opened += history.success
            outcome = "recovered" if history.recovered else "opened" if history.success else "not opened"
            print(f"{kind} door, seed {seed}: {outcome}", flush=True)
            if history.imaginations and (shown is None or _tells(history) > _tells(shown)):
                shown = history
            if history.recovered:
                section.videos.append(_video(history, frames, seed))
                break
        else:
            section.notes.append(_no_recovery(config, kind, num_opened))
    if shown is not None:
        futures.pictures.insert(0, _strip(policy, shown))
    elif policy.config.exploration == "foresight":
        futures.notes.append(Note("Nothing was imagined in these trials: the policy was never surprised."))
    else:
        model = MODEL_NAMES[policy.config.exploration]
        futures.notes.append(Note(f"The policy that was given imagines nothing: it is an {model}."))
    return section


def _tells(history: TrialHistory) -> int:
    """How much there is to see in a trial: nothing tried, something tried, a recovery."""
    return bool(history.attempts) + history.recovered


def _run_filmed_trial(
    policy: UFRNNPolicy, config: ReportConfig, kind: str, seed: int
) -> tuple[TrialHistory, NDArray[np.uint8]]:
    """One trial, and its pictures from before the first step to after the last, (steps + 1, height, width, 3)."""
    env = RenderCollection(
        gym.make(
            "env_door/Door-v0",
            max_episode_steps=config.num_steps,
            kind=kind,
            arm=config.arm,
            door_offset=config.door_offset,
            render_size=VIDEO_SIZE,
        )
    )
    try:
        return run_trial(policy, env, seed), np.stack(env.render())
    finally:
        env.close()


def _video(history: TrialHistory, pictures: NDArray[np.uint8], seed: int) -> Video:
    frames = annotate(pictures, history)
    tries = ", ".join(f"{way} at {_seconds(step + 1)}" for step, way in history.attempts)
    caption = f"{history.door_kind.capitalize()} door, seed {seed}. Tried {tries}; "
    if returns := [imagined.step for imagined in history.imaginations if imagined.refuted is not None]:
        caption += f"was surprised and went back at {', '.join(map(_seconds, returns))}; "
    caption += f"opened at {_seconds(len(history.states))}."
    png = BytesIO()
    # The poster shows the wrong try.
    matplotlib.image.imsave(png, frames[history.attempts[0].step + 1], format="png")
    return Video(encode(frames), Picture(png.getvalue(), caption, caption), caption)


def _seconds(steps: int) -> str:
    return f"{steps / FRAMES_PER_SECOND:.1f} s"


def _no_recovery(config: ReportConfig, kind: str, num_opened: int) -> Note:
    last = config.seed + config.trials_per_kind - 1
    return Note(
        f"No recovery with a {kind} door in {config.trials_per_kind} trials (seeds {config.seed} to {last}): "
        f"{num_opened} opened with the first guess right, {config.trials_per_kind - num_opened} not opened."
    )


def _strip(policy: UFRNNPolicy, history: TrialHistory) -> Picture:
    tries = ", then ".join(way for _, way in history.attempts) or "nothing"
    if history.imaginations[0].refuted is None:
        when = "in the 2 s before the first try, where the candidates parted most"
    else:
        when = "when the robot was surprised for the last time; the arm needs a moment to go back before it follows"
    return draw_picture(
        lambda file: draw_strip(policy, history, file),
        "Imagined images, a row for each candidate, above the camera at the same steps",
        f"A trial with a {history.door_kind} door (tried: {tries}): what candidates imagined {when}. The marked row is "
        "the future that was kept; the others are those that differ most. The last row is what the camera then saw at "
        "the same steps. Imagined images blur where the decoder cannot tell; rows that look alike say that the "
        "candidates agreed.",
    )
