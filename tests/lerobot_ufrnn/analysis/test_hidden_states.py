import numpy as np
import pandas as pd
import pytest
import torch
from lerobot.policies.factory import make_policy
from sklearn.decomposition import PCA
from small import batch_of, small_config, train

from lerobot_ufrnn.analysis import hidden_picture, lyapunov_picture
from lerobot_ufrnn.analysis.hidden_picture import HiddenPaths
from lerobot_ufrnn.analysis.hidden_states import Plane, read_demonstrations, states_along
from lerobot_ufrnn.analysis.lyapunov import exponents_over_time
from lerobot_ufrnn.analysis.trial import Attempt, TrialHistory
from lerobot_ufrnn.networks import HiddenState


def test_the_plane_is_that_of_principal_component_analysis():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(40, 6, generator=generator, dtype=torch.float64) * torch.arange(1, 7) + 3
    plane, expected = Plane.fit(points), PCA(2).fit(points.numpy())
    signs = np.sign(np.sum(expected.components_ * plane.axes.numpy(), axis=1))
    np.testing.assert_allclose(plane.project(points), expected.transform(points.numpy()) * signs, atol=1e-9)
    np.testing.assert_allclose(plane.shares, expected.explained_variance_ratio_)


def test_the_plane_does_not_flip():
    points = torch.randn(40, 6, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(Plane.fit(points).axes, Plane.fit(points.flip(0)).axes, atol=1e-4, rtol=0)


@pytest.mark.parametrize("exploration", ["none", "noise", "foresight"])
def test_states_are_found_along_demonstrations_of_any_length(uneven_dataset, exploration):
    policy = make_policy(small_config(exploration=exploration), ds_meta=uneven_dataset.meta)
    train(policy, [batch_of(0, 1, 2)] * 3)
    policy.eval()
    demonstrations = read_demonstrations(policy, uneven_dataset.root)
    states = states_along(policy, demonstrations)
    assert [len(state.h_shared) for state in states] == [7, 12, 9]
    exponents = exponents_over_time(policy.model.network, states, num_steps=2)
    assert [values.shape for values in exponents] == [(7,), (12,), (9,)]
    if exploration == "none":
        (alone,) = states_along(policy, demonstrations[2:])
        torch.testing.assert_close(states[2], alone)


def test_a_folder_without_a_dataset_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no meta/info\.json"):
        read_demonstrations(None, tmp_path)


# ── Pictures ──────────────────────────────────────────────────────────


def some_states(length: int, batch_size: tuple[int, ...] = ()) -> HiddenState:
    return HiddenState(*(torch.randn(length, *batch_size, 4) for _ in HiddenState._fields))


def some_paths(label: str, held: list[int]) -> HiddenPaths:
    attempts = [Attempt(3, "push"), Attempt(5, "pull")]
    history = TrialHistory("pull", ("joint",), attempts=attempts, held=held, success=True)
    history.states = [HiddenState(*values) for values in zip(*some_states(8, (1,)), strict=True)]
    return HiddenPaths.of(label, ["push", "slide"], [some_states(9), some_states(7)], history)


@pytest.mark.parametrize("held", [[], [3, 4, 5]])
def test_hidden_states_are_drawn_and_written(held, tmp_path):
    models = [some_paths("first", held), some_paths("second", [])]
    hidden_picture.draw(models, tmp_path / "folder" / "hidden.png")
    assert (tmp_path / "folder" / "hidden.png").read_bytes().startswith(b"\x89PNG")
    table = hidden_picture.to_table(models)
    assert table.columns.tolist() == ["model", "path", "kind", "step", "pc1", "pc2", "tried", "held"]
    assert len(table) == 2 * (9 + 7 + 8)
    tried = table[table["tried"] != ""][["path", "kind", "step", "tried"]]
    assert tried.to_numpy().tolist() == [["trial", "pull", 3, "push"], ["trial", "pull", 5, "pull"]] * 2
    assert table["step"][table["held"] == 1].tolist() == held
    trial = table[(table["model"] == "second") & (table["path"] == "trial")]
    np.testing.assert_array_equal(trial[["pc1", "pc2"]], models[1].trial)


def test_exponents_are_drawn_and_written(tmp_path):
    curves = {"model": [np.array([0.1, 0.2]), np.array([0.3, 0.4, 0.5])]}
    mean, deviation = lyapunov_picture.statistics(curves["model"])
    np.testing.assert_allclose(mean, [0.2, 0.3, 0.5])
    np.testing.assert_allclose(deviation, [0.1, 0.1, 0.0], atol=1e-12)
    for phases in ({}, {"grasp": [0, 1]}):
        lyapunov_picture.draw(curves, phases, 10, tmp_path / "folder" / "lyapunov.png")
    assert (tmp_path / "folder" / "lyapunov.png").read_bytes().startswith(b"\x89PNG")
    expected = pd.DataFrame(
        {
            "model": "model",
            "demonstration": [0, 0, 1, 1, 1],
            "step": [0, 1, 0, 1, 2],
            "exponent": [0.1, 0.2, 0.3, 0.4, 0.5],
        }
    )
    pd.testing.assert_frame_equal(lyapunov_picture.to_table(curves), expected)
