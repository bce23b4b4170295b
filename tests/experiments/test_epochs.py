from pathlib import Path

import pytest
import yaml
from epochs import AUTOENCODER_STEPS, find_checkpoints, read_model

from lerobot_ufrnn.configuration_ufrnn import AutoencoderConfig

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
DATA = 15, 2250  # episodes and frames of the demonstrations


def settings(steps: int, batch_size: int, save_freq: int = 0, **policy) -> dict:
    return {"steps": steps, "batch_size": batch_size, "save_freq": save_freq, "policy": policy}


PAPER = settings(9900, 5, save_freq=300, type="ufrnn", autoencoder={"steps": 900})


def test_the_default_stated_without_importing_it_is_true():
    assert AutoencoderConfig().steps == AUTOENCODER_STEPS


@pytest.mark.parametrize(
    ("model", "first", "last_epoch"),
    [
        (settings(150, 5, type="ufrnn", autoencoder={"steps": 90}), 93, 20),
        (settings(404, 4, type="ufrnn"), 404, 1),  # the last batch of an epoch may be smaller
        (settings(30, 5, type="ufrnn", autoencoder={"path": "me/door"}), 3, 10),
        (settings(2820, 8, type="act"), 282, 10),
        (settings(90, 75, type="diffusion", autoencoder={"steps": 900}), 30, 3),
    ],
)
def test_an_epoch_is_a_pass_of_the_data_loader_after_the_autoencoder(model, first, last_epoch):
    assert find_checkpoints({**model, "save_freq": 0}, *DATA, []) == ({last_epoch: model["steps"]}, model["steps"])
    assert find_checkpoints(model, *DATA, [1])[0] == {1: first}
    for epoch in (0, last_epoch + 1):
        with pytest.raises(ValueError, match=rf"from 1 to {last_epoch}.*got \[{epoch}\]"):
            find_checkpoints(model, *DATA, [epoch])


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_the_models_of_this_repository_end_with_an_epoch(path):
    model = read_model(path).settings
    step_of, save_freq = find_checkpoints(model, *DATA, [])
    assert (list(step_of.values()), save_freq) == ([model["steps"]], model["save_freq"])


@pytest.mark.parametrize(("steps", "fitting"), [(901, 903), (9901, 9900), (899, 903)])
def test_a_training_that_ends_within_an_epoch_is_refused_with_one_that_does_not(steps, fitting):
    with pytest.raises(ValueError, match=rf"900 updates .* such as {fitting}; got {steps}"):
        find_checkpoints({**PAPER, "steps": steps}, *DATA, [])


@pytest.mark.parametrize(
    ("epochs", "save_freq"), [([3000], 300), ([100, 500, 3000], 300), ([150], 150), (range(100, 3001, 100), 300)]
)
def test_every_wanted_epoch_has_a_checkpoint(epochs, save_freq):
    step_of, found = find_checkpoints(PAPER, *DATA, epochs)
    assert (list(step_of), found) == (sorted(epochs), save_freq)
    assert all(step % found == 0 or step == 9900 for step in step_of.values())


def test_epochs_that_need_too_many_checkpoints_are_refused_with_what_is_allowed():
    with pytest.raises(ValueError, match=r"\[7, 100\] .* \[921, 1200\] .* every 3 updates.*divisor of at least 50"):
        find_checkpoints(PAPER, *DATA, [100, 7])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("policy: [", "is not YAML"),
        ("steps: 3", "must state `policy.type`"),
        ("policy: {type: act}\nsteps: 3", "must state `batch_size`, a whole number of at least 1, got None"),
        ("policy: {type: act}\nsteps: 0\nbatch_size: 2", "must state `steps`"),
        (
            yaml.safe_dump({**settings(4, 2, type="act"), "dataset": {"episodes": [0]}}),
            "states `dataset.episodes`, but",
        ),
    ],
)
def test_a_model_without_what_must_be_known_is_refused(tmp_path, text, message):
    (tmp_path / "model.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_model(tmp_path / "model.yaml")
