import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_policy
from sklearn.decomposition import PCA
from small import batch_of, small_config, train

from lerobot_ufrnn.analysis.hidden_picture import HiddenPaths, draw
from lerobot_ufrnn.analysis.hidden_states import Plane, read_demonstrations, states_along
from lerobot_ufrnn.analysis.lyapunov import exponents_over_time
from lerobot_ufrnn.analysis.trial import Attempt, TrialHistory
from lerobot_ufrnn.networks import HiddenState


def test_the_plane_is_that_of_principal_component_analysis_and_does_not_flip():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(40, 6, generator=generator, dtype=torch.float64) * torch.arange(1, 7) + 3
    plane, expected = Plane.fit(points), PCA(2).fit(points.numpy())
    signs = np.sign(np.sum(expected.components_ * plane.axes.numpy(), axis=1))
    np.testing.assert_allclose(plane.project(points), expected.transform(points.numpy()) * signs, atol=1e-9)
    np.testing.assert_allclose(plane.shares, expected.explained_variance_ratio_)
    torch.testing.assert_close(Plane.fit(points.flip(0)).axes, plane.axes)


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


def some_states(length: int, batch_size: tuple[int, ...] = ()) -> HiddenState:
    return HiddenState(*(torch.randn(length, *batch_size, 4) for _ in HiddenState._fields))


@pytest.mark.parametrize("held", [[], [3, 4, 5]])
def test_hidden_states_are_drawn_and_written(held, tmp_path):
    history = TrialHistory("pull", (), attempts=[Attempt(3, "push"), Attempt(5, "pull")], held=held, success=True)
    history.states = [HiddenState(*values) for values in zip(*some_states(8, (1,)), strict=True)]
    demonstrations = [some_states(9), some_states(7)]
    paths = HiddenPaths.of(["push", "slide"], demonstrations, history)
    draw({"first": paths, "second": paths}, tmp_path / "folder" / "hidden.png")
    assert (tmp_path / "folder" / "hidden.png").read_bytes().startswith(b"\x89PNG")
    table = paths.table
    assert table.columns.tolist() == ["path", "kind", "step", "pc1", "pc2", "tried", "held"]
    lengths = table.groupby(["path", "kind"]).size().to_dict()
    assert lengths == {("0", "push"): 9, ("1", "slide"): 7, ("trial", "pull"): 8}
    tried = table[table["tried"] != ""][["path", "kind", "step", "tried"]]
    assert tried.to_numpy().tolist() == [["trial", "pull", 3, "push"], ["trial", "pull", 5, "pull"]]
    assert table[table["held"] == 1][["path", "step"]].to_numpy().tolist() == [["trial", step] for step in held]
    plane = Plane.fit(torch.cat([states.h_shared for states in demonstrations]))
    trial = plane.project(torch.cat([state.h_shared for state in history.states]))
    np.testing.assert_array_equal(table.loc[table["path"] == "trial", ["pc1", "pc2"]], trial)
