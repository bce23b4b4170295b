from pathlib import Path

import pytest
import yaml
from epochs import AUTOENCODER_STEPS, Schedule, read_model

from lerobot_ufrnn.configuration_ufrnn import AutoencoderConfig

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
PAPER = Schedule(autoencoder_steps=900, epoch_steps=3, steps=9900)


def settings(steps: int, batch_size: int, **policy) -> dict:
    return {"steps": steps, "batch_size": batch_size, "policy": policy}


def test_the_default_stated_without_importing_it_is_true():
    assert AutoencoderConfig().steps == AUTOENCODER_STEPS


@pytest.mark.parametrize(
    ("model", "first", "last_epoch"),
    [
        (settings(9900, 5, type="ufrnn", autoencoder={"steps": 900}), 903, 3000),
        (settings(404, 4, type="ufrnn"), 404, 1),  # the last batch of an epoch may be smaller
        (settings(30, 5, type="ufrnn", autoencoder={"path": "me/door"}), 3, 10),
        (settings(2820, 8, type="act"), 282, 10),
        (settings(90, 75, type="diffusion", autoencoder={"steps": 900}), 30, 3),
    ],
)
def test_an_epoch_is_a_pass_of_the_data_loader_after_the_autoencoder(model, first, last_epoch):
    schedule = Schedule.of(model, num_episodes=15, num_frames=2250)
    assert (schedule.step_of(1), schedule.last_epoch) == (first, last_epoch)
    assert schedule.step_of(last_epoch) == model["steps"]


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_the_models_of_this_repository_end_with_an_epoch(path):
    model = read_model(path).settings
    schedule = Schedule.of(model, num_episodes=15, num_frames=2250)
    assert schedule.save_freq([schedule.last_epoch], model["save_freq"]) == model["save_freq"]


@pytest.mark.parametrize(("steps", "fitting"), [(901, 903), (9901, 9900), (899, 903)])
def test_a_training_that_ends_within_an_epoch_is_refused_with_one_that_does_not(steps, fitting):
    model = settings(steps, 5, type="ufrnn", autoencoder={"steps": 900})
    with pytest.raises(ValueError, match=rf"900 updates .* such as {fitting}; got {steps}"):
        Schedule.of(model, 15, 2250)


@pytest.mark.parametrize("epoch", [0, 3001])
def test_an_epoch_that_training_does_not_reach_is_refused(epoch):
    with pytest.raises(ValueError, match=rf"from 1 to 3000.*got {epoch}"):
        PAPER.step_of(epoch)


@pytest.mark.parametrize(
    ("epochs", "save_freq"), [([3000], 300), ([100, 500, 3000], 300), ([150], 150), (range(100, 3001, 100), 300)]
)
def test_every_wanted_epoch_has_a_checkpoint(epochs, save_freq):
    found = PAPER.save_freq(epochs, 300)
    assert found == save_freq
    assert all(PAPER.step_of(epoch) % found == 0 or epoch == PAPER.last_epoch for epoch in epochs)


def test_epochs_that_need_too_many_checkpoints_are_refused_with_what_is_allowed():
    with pytest.raises(ValueError, match=r"\[7, 100\] .* \[921, 1200\] .* every 3 updates.*divisor of at least 50"):
        PAPER.save_freq([100, 7], 300)


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
