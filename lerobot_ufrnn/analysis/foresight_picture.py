"""A picture of one foresight step: what the robot saw, what it imagined, and which future it kept."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from torch import Tensor

from ..foresight import uncertainty
from ..modeling_ufrnn import UFRNNPolicy
from .picture import picture
from .trial import Imagination, TrialHistory

MOST_SHOWN = 5


def draw(policy: UFRNNPolicy, history: TrialHistory, path: Path) -> None:
    """Draws what was imagined at a decisive step of a trial and writes it to `path`.

    Top: the camera, its reconstruction, and imagined images at the horizon. Below: the imagined paths of the joint that
    the candidates disagree most about, and the predicted variance over the whole trial.
    """
    joint_dim = policy.model.network.joint_dim
    imagined = decisive(history, joint_dim)
    ends, photo = imagined.futures.mean[-1], history.images[imagined.step]
    shown = _representatives(ends[:, :joint_dim], imagined.chosen)
    image = torch.from_numpy(photo).permute(2, 0, 1)[None].to(ends.device)
    with torch.no_grad():
        seen = policy.image_encoder(dict.fromkeys(policy.config.cameras, image))
        decoded = policy.image_encoder.decode(torch.cat((seen, ends[shown, joint_dim:])))[policy.config.cameras[0]]
    pictures = [photo, *decoded.clamp(0, 1).permute(0, 2, 3, 1).cpu().numpy()]
    with picture(path, 2 * len(pictures), 6, dpi=110) as figure:
        top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(1, 1.1)))
        panels = top.subplots(1, len(pictures))
        titles = [f"camera, step {imagined.step}", "reconstruction"]
        titles += [_title(policy, imagined, number) for number in shown]
        for panel, shot, title, number in zip(panels, pictures, titles, [None, None, *shown], strict=True):
            kept = number == imagined.chosen
            panel.imshow(shot)
            panel.set_title(title, fontsize=9, color="C3" if kept else "black")
            panel.set(xticks=[], yticks=[])
            for spine in panel.spines.values():
                spine.set(visible=kept, color="C3", linewidth=3)
        paths, uncertainties = bottom.subplots(1, 2)
        _draw_paths(paths, policy, history, imagined)
        _draw_uncertainty(uncertainties, history, imagined)
        tried, result = history.outcome
        figure.suptitle(f"What was imagined (in truth a {history.door_kind} door; tried: {tried}; {result})")


def decisive(history: TrialHistory, joint_dim: int) -> Imagination:
    """The step at which what was imagined mattered most.

    With recall the last time that the trial went back, which a door that was opened was opened by. With foresight at
    every step the one whose futures part most in the 2 s before the first try (before the end, without one).

    Raises:
        ValueError: If nothing was imagined in the trial.
    """
    if not history.imaginations:
        raise ValueError(
            "Nothing was imagined in this trial: the policy has no foresight, or was never contradicted. Take a trial "
            "in which the first try is wrong: another --kind or --seed."
        )
    if history.imaginations[0].refuted is not None:
        return history.imaginations[-1]
    last = history.first_try if history.first_try is not None else len(history.states) - 1
    near = [imagined for imagined in history.imaginations if last - 20 < imagined.step <= last]
    return max(near, key=lambda imagined: imagined.futures.mean[-1].std(dim=0).mean().item())


def _representatives(ends: Tensor, chosen: int) -> list[int]:
    """The kept candidate of (N, D_j) and others that differ: each next one is the farthest from those before."""
    shown = [chosen]
    while len(shown) < min(MOST_SHOWN, len(ends)):
        distance = torch.cdist(ends, ends[shown]).amin(1)
        distance[shown] = -1
        shown.append(int(distance.argmax()))
    return sorted(shown)


def _title(policy: UFRNNPolicy, imagined: Imagination, number: int) -> str:
    kept = " (kept)" if number == imagined.chosen else ""
    if imagined.refuted is not None:
        return f"future {number + 1}{kept}\nrefuted by {imagined.refuted[number]:.1f}"
    aggregation = policy.config.foresight.variance_aggregation
    final = uncertainty(imagined.futures.log_variance[-1, number], policy.model.network.joint_dim, aggregation)
    return f"future {number + 1}{kept}\nuncertainty {final:.3g}"


def _draw_paths(axes: Axes, policy: UFRNNPolicy, history: TrialHistory, imagined: Imagination) -> None:
    joint_dim, step, chosen = policy.model.network.joint_dim, imagined.step, imagined.chosen
    paths = policy.joint_scaler.unscale(imagined.futures.mean[..., :joint_dim]).cpu().numpy()  # (T, N, D_j)
    # The joint whose imagined paths spread most, relative to its range.
    joint = int(imagined.futures.mean[-1, :, :joint_dim].std(dim=0).argmax())
    start = max(0, step - 20)
    measured = np.array([joints[joint] for joints in history.joints[start:]])
    axes.plot(np.arange(start, start + len(measured)), measured, color="black", linewidth=1.5, label="what happened")
    future = np.arange(step + imagined.ahead, step + imagined.ahead + len(paths))
    for number, other in enumerate(np.delete(paths[:, :, joint], chosen, axis=1).T):
        alpha = 1.0 if paths.shape[1] <= 10 else 0.35
        axes.plot(future, other, color="C0", linewidth=1, alpha=alpha, label=None if number else "imagined")
    axes.plot(future, paths[:, chosen, joint], color="C3", linewidth=2.5, label="imagined and kept")
    axes.axvline(step, color="grey", linewidth=0.8, linestyle=":")
    axes.set(xlabel="step (10 Hz)", ylabel=f"{history.joint_names[joint]} (rad)", xlim=(start, step + len(paths) + 25))
    axes.set_title("Where the imagined futures part", fontsize=10)
    axes.legend(frameon=False)


def _draw_uncertainty(axes: Axes, history: TrialHistory, imagined: Imagination) -> None:
    variances = np.array(history.variances)
    for column, name in enumerate(("joints", "image features")):
        axes.semilogy(variances[:, column], color=f"C{column}", label=name)
    for other in history.imaginations if imagined.refuted is not None else [imagined]:
        axes.axvline(other.step, color="grey", linewidth=0.8, linestyle=":")
    if history.first_try is not None:
        axes.axvline(history.first_try, color="C3", linewidth=0.8)
        axes.annotate(" first try", (history.first_try, variances.max()), color="C3", va="top", fontsize=8)
    axes.set(xlabel="step (10 Hz)", ylabel="mean predicted variance")
    axes.set_title("Uncertainty over the trial", fontsize=10)
    axes.legend(frameon=False)
