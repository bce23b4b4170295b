"""A picture of one foresight step: what the robot saw, what it imagined, and which future it kept."""

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from ..foresight import ForesightTrace
from ..modeling_ufrnn import UFRNNPolicy


@dataclass
class TrialHistory:
    """One trial, step by step.

    Attributes:
        door_kind (`str`): kind of the door.
        images (`list[np.ndarray]`): first camera at each step, uint8 (height, width, 3).
        joints (`list[np.ndarray]`): measured joints at each step, (D_j,).
        variances (`list[np.ndarray]`): mean predicted variance of joints and image features after each step, (2,).
        traces (`list[ForesightTrace]`): what foresight saw at each step.
        first_try (`int | None`): step at which the door was first tried, if it was.
        attempts (`tuple[str, ...]`): directions tried, in order.
        success (`bool`): whether the door was opened.
    """

    door_kind: str
    images: list[np.ndarray]
    joints: list[np.ndarray]
    variances: list[np.ndarray]
    traces: list[ForesightTrace]
    first_try: int | None
    attempts: tuple[str, ...]
    success: bool

    @property
    def branch_step(self) -> int:
        """`int`: where the imagined futures part most in the 2 s before the first try (before the end, without one)."""
        stop = (self.first_try if self.first_try is not None else len(self.traces) - 1) + 1
        start = max(0, stop - 20)
        spreads = [trace.imagined.mean[-1, :, 0].std(dim=0).mean().item() for trace in self.traces[start:stop]]
        return start + int(np.argmax(spreads))


def draw(policy: UFRNNPolicy, history: TrialHistory, joint_names: tuple[str, ...], path: Path) -> None:
    """Draws foresight at the branch of a trial and writes it to `path`.

    Top: the camera, its reconstruction, and each candidate's imagined image at the horizon. Below: the imagined
    paths of the joint that the candidates disagree most about, and the predicted variance over the whole trial.

    Args:
        policy (`UFRNNPolicy`):
            The policy that ran the trial.
        history (`TrialHistory`):
            The trial.
        joint_names (`tuple[str, ...]`):
            Names of the joints, for the axis label.
        path (`Path`):
            Where to write the PNG.
    """
    step = history.branch_step
    trace = history.traces[step]
    camera = policy.config.cameras[0]
    joint_dim = policy.model.network.joint_dim
    chosen = int(trace.chosen[0])
    num_samples = trace.final.shape[0]
    imagined = _decode(policy, trace.imagined.mean[-1, :, 0, joint_dim:], camera)  # (N, height, width, 3)
    image = torch.from_numpy(history.images[step]).permute(2, 0, 1)[None].to(trace.imagined.mean.device)
    with torch.no_grad():
        seen = policy.image_encoder(dict.fromkeys(policy.config.cameras, image))
    reconstruction = _decode(policy, seen, camera)[0]

    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(2 * (num_samples + 2), 6), layout="constrained")
        top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(1, 1.1)))
        panels = top.subplots(1, num_samples + 2)
        titles = [f"camera, step {step}", "reconstruction"]
        titles += [f"future {n + 1}\nuncertainty {trace.final[n, 0]:.3g}" for n in range(num_samples)]
        for index, (panel, picture, title) in enumerate(
            zip(panels, [history.images[step], reconstruction, *imagined], titles, strict=True)
        ):
            kept = index - 2 == chosen
            panel.imshow(picture)
            panel.set_title(title + (" (kept)" if kept else ""), fontsize=9, color="C3" if kept else "black")
            panel.set_xticks([])
            panel.set_yticks([])
            for spine in panel.spines.values():
                spine.set(visible=kept, color="C3", linewidth=3)
        paths, uncertainties = bottom.subplots(1, 2)
        _draw_paths(paths, policy, history, trace, step, joint_names)
        _draw_uncertainty(uncertainties, history, step)
        tried = ", ".join(history.attempts) or "nothing"
        result = "opened" if history.success else "not opened"
        figure.suptitle(f"Foresight at the branch (in truth a {history.door_kind} door; tried: {tried}; {result})")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)


def _draw_paths(axes, policy, history, trace, step, joint_names) -> None:
    joint_dim = policy.model.network.joint_dim
    imagined = policy.joint_scaler.unscale(trace.imagined.mean[:, :, 0, :joint_dim]).cpu().numpy()  # (T, N, D_j)
    # The joint whose imagined paths spread most, relative to its range.
    joint = int(trace.imagined.mean[-1, :, 0, :joint_dim].std(dim=0).argmax())
    start = max(0, step - 20)
    measured = np.array([joints[joint] for joints in history.joints[start:]])
    axes.plot(np.arange(start, start + len(measured)), measured, color="black", linewidth=1.5, label="what happened")
    future = np.arange(step + 2, step + 2 + len(imagined))
    chosen = int(trace.chosen[0])
    others = np.delete(imagined[:, :, joint], chosen, axis=1)
    if others.size:
        axes.plot(future, others[:, 0], color="C0", linewidth=1, label="imagined")
        axes.plot(future, others[:, 1:], color="C0", linewidth=1)
    axes.plot(future, imagined[:, chosen, joint], color="C3", linewidth=2.5, label="imagined and kept")
    axes.axvline(step, color="grey", linewidth=0.8, linestyle=":")
    axes.set(xlabel="step (10 Hz)", ylabel=f"{joint_names[joint]} (rad)", xlim=(start, step + len(imagined) + 25))
    axes.set_title("Where the imagined futures part", fontsize=10)
    axes.legend(frameon=False)


def _draw_uncertainty(axes, history: TrialHistory, step: int) -> None:
    variances = np.array(history.variances)
    for column, name in enumerate(("joints", "image features")):
        axes.semilogy(variances[:, column], color=f"C{column}", label=name)
    axes.axvline(step, color="grey", linewidth=0.8, linestyle=":")
    if history.first_try is not None:
        axes.axvline(history.first_try, color="C3", linewidth=0.8)
        axes.annotate(" first try", (history.first_try, variances.max()), color="C3", va="top", fontsize=8)
    axes.set(xlabel="step (10 Hz)", ylabel="mean predicted variance")
    axes.set_title("Uncertainty over the trial", fontsize=10)
    axes.legend(frameon=False)


@torch.no_grad()
def _decode(policy: UFRNNPolicy, scaled_features: Tensor, camera: str) -> np.ndarray:
    images = policy.image_encoder.decode(scaled_features)[camera]
    return images.clamp(0, 1).permute(0, 2, 3, 1).cpu().numpy()
