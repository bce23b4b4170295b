import threading
from dataclasses import replace

import pytest
import torch
from lerobot.datasets import dataset_reader
from lerobot.policies.factory import make_policy, make_pre_post_processors
from oracle import Oracle
from safetensors.torch import load_file, save_file
from small import batch_of, make_dataset, observation, remember_ways, small_config, train

from lerobot_ufrnn.configuration_ufrnn import RecallConfig
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy


def make_trained(dataset, **overrides) -> UFRNNPolicy:
    torch.manual_seed(0)
    policy = make_policy(small_config(**overrides), ds_meta=dataset.meta)
    train(policy, [batch_of(0, 1, 2)] * 5)
    return policy.eval()


@pytest.fixture
def trained(dataset) -> UFRNNPolicy:
    """A policy that has been through both phases."""
    return make_trained(dataset)


# ── Acting ────────────────────────────────────────────────────────────


def test_actions_have_the_shape_and_the_range_of_the_joints(trained):
    for _ in range(3):
        action = trained.select_action(observation(4))
        assert action.shape == (4, 3)
        # Tanh reaches at most 1 / 0.8 of the range seen in the data, which is within [-1, 1].
        assert action.abs().max() <= 1.25 + 1e-6


def test_a_batch_of_environments_is_a_batch_of_independent_episodes(dataset):
    policy = make_policy(small_config(exploration="none"), ds_meta=dataset.meta)
    train(policy, [batch_of(0, 1)] * 4)
    policy.eval()
    steps = [observation(3), {key: value.flip(0) for key, value in observation(3).items()}]
    together = [policy.select_action(step) for step in steps]
    for row in range(3):
        policy.reset()
        for step, expected in zip(steps, together, strict=True):
            alone = policy.select_action({key: value[row : row + 1] for key, value in step.items()})
            torch.testing.assert_close(alone[0], expected[row])


def test_reset_forgets_the_episode(trained):
    torch.manual_seed(1)
    first = trained.select_action(observation())
    trained.select_action(observation())
    trained.reset()
    assert trained.memory is None
    torch.manual_seed(1)
    torch.testing.assert_close(trained.select_action(observation()), first)


def test_a_command_fed_back_means_the_same_as_a_measurement(dataset):
    """An arm that follows its command exactly measures what the network predicted: closed loop = imagination."""
    policy = make_trained(dataset, command_target="next_state", exploration="none")
    action = policy.select_action(observation(1))
    imagined = Oracle(policy.model.network).imagine([value[0].numpy() for value in policy.memory.state], 1)[0][0]
    mean = policy.memory.prediction.mean
    torch.testing.assert_close(policy.joint_scaler.scale(action), mean[:, :3], atol=1e-6, rtol=0)
    inputs = torch.cat((policy.joint_scaler.scale(action), mean[:, 3:]), dim=-1)
    memory, _ = policy.model.advance(inputs, policy.memory)
    torch.testing.assert_close(
        memory.prediction.mean[0], torch.tensor(imagined, dtype=torch.float32), atol=1e-5, rtol=0
    )


def test_state_and_action_share_one_scaling(dataset):
    policy = make_policy(small_config(), ds_meta=dataset.meta)
    stats = dataset.meta.stats
    for bound, reduce in (("low", torch.minimum), ("high", torch.maximum)):
        key = {"low": "min", "high": "max"}[bound]
        expected = reduce(*(torch.as_tensor(stats[name][key]) for name in ("observation.state", "action")))
        torch.testing.assert_close(getattr(policy.joint_scaler, bound), expected.float())


def test_the_pipelines_leave_values_alone(trained, dataset):
    preprocess, postprocess = make_pre_post_processors(trained.config, dataset_stats=dataset.meta.stats)
    batch = observation(2)
    for key, value in preprocess(dict(batch)).items():
        if key in batch:
            assert torch.equal(value, batch[key])
    action = torch.rand(2, 3) * 9
    assert torch.equal(postprocess(action), action)


def test_foresight_shows_what_it_saw(dataset):
    policy = make_trained(dataset, recall={"enabled": False})
    policy.select_action(observation(2))
    trace = policy.last_trace
    with pytest.raises(RuntimeError, match="kernel='reference'"):
        _ = trace.imagined
    assert trace.final.shape == (3, 2)
    assert torch.equal(trace.chosen, trace.final.argmin(0))


def test_the_baselines_run_in_the_same_code(dataset):
    for exploration in ("noise", "none"):
        policy = make_trained(dataset, exploration=exploration, recall={"enabled": False})
        first, second = (policy.select_action(observation()) for _ in range(2))
        policy.reset()
        repeated = policy.select_action(observation())
        assert policy.last_trace is None
        assert torch.equal(first, repeated) == (exploration == "none")
        assert not torch.equal(first, second)


@pytest.mark.parametrize("exploration", ["foresight", "noise", "none"])
def test_with_recall_a_policy_that_is_never_contradicted_acts_without_noise(dataset, exploration):
    calm = make_trained(dataset, exploration=exploration, recall={"stay": 1e9, "strange": 1e9})
    plain = make_trained(dataset, exploration="none", recall={"enabled": False})
    plain.load_state_dict(calm.state_dict())
    for _ in range(15):
        assert torch.equal(calm.select_action(observation()), plain.select_action(observation()))
    assert calm.last_trace is None
    assert calm.recall.events == [[], []]


@pytest.mark.parametrize("enabled", [True, False])
def test_an_arm_that_is_held_where_ways_part_goes_back_until_it_is_reset_unless_told_not_to(dataset, enabled):
    policy = make_trained(dataset, recall={"enabled": enabled})
    remember_ways(policy, observation(1)["observation.state"][0])
    for _ in range(20):
        assert torch.isfinite(policy.select_action(observation(1))).all()
    if not enabled:
        assert policy.recall is None
        return
    assert policy.recall.events[0]
    policy.reset()
    assert not policy.recall.events


def bad_observations():
    nan_state, nan_image, flat = observation(), observation(), observation()
    nan_state["observation.state"][1, 0] = float("nan")
    nan_image["observation.images.front"][0, 0, 3, 3] = float("inf")
    flat["observation.state"] = flat["observation.state"][0]
    grey = {**observation(), "observation.images.front": torch.rand(2, 1, 32, 32)}
    blind = {"observation.state": torch.rand(2, 3)}
    long = {**observation(), "observation.state": torch.rand(2, 4)}
    fewer = {**observation(), "observation.images.front": torch.rand(1, 3, 32, 32)}
    return [
        (nan_state, r"'observation.state' holds NaN .* row\(s\) \[1\]"),
        (nan_image, r"'observation.images.front' holds NaN .* row\(s\) \[0\]"),
        (flat, "must have shape"),
        (grey, "must have shape"),
        (blind, r"lacks \['observation.images.front'\]"),
        (long, "must have shape"),
        (fewer, "must have shape"),
    ]


@pytest.mark.parametrize(("batch", "message"), bad_observations())
def test_a_bad_observation_is_refused(trained, batch, message):
    with pytest.raises(ValueError, match=message):
        trained.select_action(batch)
    assert trained.memory is None


def test_a_batch_size_that_changes_in_mid_episode_is_refused(trained):
    trained.select_action(observation(2))
    with pytest.raises(ValueError, match="from 2 to 3 in mid-episode"):
        trained.select_action(observation(3))


def test_two_threads_cannot_share_a_hidden_state(trained):
    errors = []

    def act():
        try:
            trained.select_action(observation())
        except RuntimeError as error:
            errors.append(str(error))

    thread = threading.Thread(target=act)
    thread.start()
    thread.join()
    assert len(errors) == 1
    assert "max_parallel_tasks=1" in errors[0]


def test_an_untrained_policy_says_so(dataset):
    policy = UFRNNPolicy(make_policy(small_config(), ds_meta=dataset.meta).config)
    with pytest.raises(RuntimeError, match="no data range yet"):
        policy.select_action(observation())


@pytest.mark.parametrize("name", ["joint_head.bias", "command_head.bias", "image_cell.weight_ih"])
def test_a_policy_whose_weights_are_nan_sends_nothing_to_the_robot(trained, name):
    trained.model.network.get_parameter(name).data.fill_(float("nan"))
    with pytest.raises(RuntimeError, match="its weights are broken"):
        trained.select_action(observation())


# ── Training ──────────────────────────────────────────────────────────


def test_training_goes_through_both_phases_and_encodes_each_frame_once(dataset, monkeypatch):
    policy = make_policy(small_config(autoencoder={"steps": 3}), ds_meta=dataset.meta)
    encoded = []
    encode = policy.image_encoder.encode
    monkeypatch.setattr(
        policy.image_encoder,
        "encode",
        lambda images: encoded.append(len(images[policy.config.cameras[0]])) or encode(images),
    )
    recurrent = [value.clone() for value in policy.model.parameters()]
    train(policy, [batch_of(0, 1, 2)] * 3)
    assert all(torch.equal(old, new) for old, new in zip(recurrent, policy.model.parameters(), strict=True))
    assert sum(encoded) == 36
    autoencoder = [value.clone() for value in policy.image_encoder.parameters()]
    train(policy, [batch_of(0, 1, 2)] * 4)
    assert all(torch.equal(old, new) for old, new in zip(autoencoder, policy.image_encoder.parameters(), strict=True))
    assert not all(torch.equal(old, new) for old, new in zip(recurrent, policy.model.parameters(), strict=True))
    assert sum(encoded) == 36
    assert all(not episode.images for episode in policy.episodes.loaded.values())


def test_once_the_features_are_kept_the_loader_decodes_no_video(tmp_path, monkeypatch):
    dataset = make_dataset(tmp_path / "dataset", (5, 5), use_videos=True)
    decoded = []
    decode = dataset_reader.decode_video_frames
    monkeypatch.setattr(
        dataset_reader, "decode_video_frames", lambda *args, **kwargs: decoded.append(1) or decode(*args, **kwargs)
    )
    policy = make_policy(small_config(autoencoder={"steps": 2}), ds_meta=dataset.meta)
    loader = torch.utils.data.DataLoader(torch.utils.data.Subset(dataset, [0, 5]), batch_size=2)
    counts = []
    for _ in range(5):
        train(policy, list(loader))
        counts.append(len(decoded))
    # Two whole episodes and two frames, two frames, and from then on none.
    assert counts == [4, 6, 6, 6, 6]


def test_the_loss_falls(dataset):
    torch.manual_seed(0)
    policy = make_policy(small_config(optimizer_lr=1e-2), ds_meta=dataset.meta)
    losses = train(policy, [batch_of(0, 1, 2)] * 60)[2:]
    assert sum(losses[-5:]) / 5 < losses[0] - 3


def test_padding_does_not_count(uneven_dataset):
    """The loss of a batch is the average over existing steps: the same as of its episodes one by one."""
    policy = make_policy(small_config(exploration="none"), ds_meta=uneven_dataset.meta)
    train(policy, [batch_of(0, 1, 2)] * 3)
    policy.eval()
    lengths = [6, 11, 8]
    alone = [policy.forward(batch_of(index))[0].item() for index in range(3)]
    expected = sum(loss * steps for loss, steps in zip(alone, lengths, strict=True)) / sum(lengths)
    assert policy.forward(batch_of(0, 1, 2))[0].item() == pytest.approx(expected, rel=1e-5)


def test_targets_are_the_next_sensor_values(dataset):
    policy = make_policy(small_config(), ds_meta=dataset.meta)
    train(policy, [batch_of(0, 1, 2)] * 3)
    policy.eval()
    episode = replace(policy.episodes[1], actions=torch.rand(12, 3))
    inputs, targets, commands = policy._sequence(episode)
    assert inputs.shape == targets.shape == (11, 7)
    assert torch.equal(targets[:-1], inputs[1:])
    torch.testing.assert_close(policy.joint_scaler.unscale(inputs[:, :3]), episode.states[:-1])
    torch.testing.assert_close(policy.joint_scaler.unscale(targets[:, :3]), episode.states[1:])
    torch.testing.assert_close(policy.joint_scaler.unscale(commands), episode.actions[:-1])


def test_training_holds_the_last_moment_on(dataset):
    policy = make_policy(small_config(augmentation={"hold_end_steps": 3}), ds_meta=dataset.meta)
    train(policy, [batch_of(0, 1, 2)] * 3)
    episode = policy.episodes[1]
    longer = policy.train()._sequence(episode)
    for recorded, held in zip(policy.eval()._sequence(episode), longer, strict=True):
        assert len(held) == len(recorded) + 3
        assert torch.equal(held[: len(recorded)], recorded)
    inputs, targets, commands = (values[-3:] for values in longer)
    last = torch.cat(
        (policy.joint_scaler.scale(episode.states[-1]), policy.image_encoder.scaler.scale(episode.features[-1]))
    )
    assert torch.equal(inputs, last.expand(3, -1))
    assert torch.equal(targets, last.expand(3, -1))
    assert torch.equal(commands, policy.joint_scaler.scale(episode.actions[-1]).expand(3, -1))


def test_commands_that_lead_nowhere_near_are_learned_all_the_same(tmp_path):
    """A gripper that squeezes is commanded far from where it will be measured."""

    def squeeze(frame, step):
        return {**frame, "action": -frame["action"]}

    data = make_dataset(tmp_path / "data", (12, 12), broken={0: squeeze, 1: squeeze})
    errors = {}
    for target in ("action", "next_state"):
        torch.manual_seed(0)
        policy = make_policy(small_config(optimizer_lr=1e-2, command_target=target), ds_meta=data.meta)
        train(policy, [batch_of(0, 1)] * 100)
        errors[target] = policy.eval().forward(batch_of(0, 1))[1]
    # Commanding the next state is off by twice its size: a sine of amplitude 0.8 has a root mean square of 0.57.
    assert errors["next_state"]["command_rmse"] > 0.9
    assert errors["action"]["command_rmse"] < 0.3
    assert errors["action"]["joint_rmse"] < 0.3


def test_each_episode_is_one_item_of_the_sampler(dataset, uneven_dataset):
    assert make_policy(small_config(), ds_meta=dataset.meta).config.drop_n_last_frames == 11
    # Unequal lengths: every frame that has a next one stands for its episode, so that none is skipped.
    assert make_policy(small_config(), ds_meta=uneven_dataset.meta).config.drop_n_last_frames == 1


def test_a_resumed_training_ends_with_the_same_weights(dataset, tmp_path):
    """Stop after any update, save, load, go on: bit for bit the run that was not stopped."""
    torch.manual_seed(7)
    whole = make_policy(small_config(autoencoder={"steps": 2}), ds_meta=dataset.meta)
    torch.manual_seed(7)
    first = make_policy(small_config(autoencoder={"steps": 2}), ds_meta=dataset.meta)
    batches = [batch_of(0, 1), batch_of(1, 2), batch_of(2, 0), batch_of(0, 1), batch_of(1, 2)]
    optimizers = {}

    def updates(policy, some):
        optimizer = optimizers.setdefault(
            id(policy), policy.config.get_optimizer_preset().build(policy.get_optim_params())
        )
        policy.train()
        for batch in some:
            policy.forward(batch)[0].backward()
            optimizer.step()
            optimizer.zero_grad()
            policy.update()
        return optimizer

    updates(whole, batches)
    state = updates(first, batches[:3]).state_dict()
    first.save_pretrained(tmp_path)
    torch.manual_seed(99)
    config = first.config
    config.pretrained_path = tmp_path
    second = make_policy(config, ds_meta=dataset.meta)
    optimizers[id(second)] = second.config.get_optimizer_preset().build(second.get_optim_params())
    optimizers[id(second)].load_state_dict(state)
    updates(second, batches[3:])
    for (name, value), other in zip(whole.state_dict().items(), second.state_dict().values(), strict=True):
        assert torch.equal(value, other), name


def test_a_learned_horizon_trains_its_step_heads(dataset):
    policy = make_policy(
        small_config({"horizon_mode": "learned", "horizon": 6}, recall={"enabled": False}), ds_meta=dataset.meta
    )
    before = policy.model.network.joint_head.bias[-1].item()
    train(policy, [batch_of(0, 1, 2)] * 6)
    assert policy.model.network.joint_head.bias[-1].item() != before
    policy.eval().select_action(observation())
    assert ((policy.last_trace.horizon >= 1) & (policy.last_trace.horizon <= 6)).all()


def test_a_trained_autoencoder_can_be_given(dataset, trained, tmp_path):
    trained.save_pretrained(tmp_path)
    policy = make_policy(small_config(autoencoder={"path": str(tmp_path)}), ds_meta=dataset.meta)
    losses = train(policy, [batch_of(0, 1, 2)] * 2)
    assert len(losses) == 2
    for ours, theirs in zip(
        policy.image_encoder.state_dict().values(), trained.image_encoder.state_dict().values(), strict=True
    ):
        assert torch.equal(ours, theirs)


def test_training_needs_a_dataset(trained):
    orphan = UFRNNPolicy(trained.config)
    with pytest.raises(RuntimeError, match="Training needs the dataset"):
        orphan.forward(batch_of(0))


def test_a_batch_must_name_its_episodes(policy):
    with pytest.raises(ValueError, match="'episode_index'"):
        policy.forward({"observation.state": torch.zeros(2, 3)})


def test_statistics_without_a_range_are_refused(policy):
    with pytest.raises(ValueError, match="statistics lack 'max'"):
        policy._fit_joint_scaler({"observation.state": {"min": [0.0] * 3}, "action": {"min": [0.0] * 3}})


# ── Broken data sets ──────────────────────────────────────────────────


def test_an_episode_of_one_frame_is_refused(tmp_path):
    data = make_dataset(tmp_path / "data", (5, 1))
    policy = make_policy(small_config(), ds_meta=data.meta)
    with pytest.raises(ValueError, match=r"Episode 1 .* has 1 frame"):
        policy.forward(batch_of(1))


def test_nan_in_a_dataset_is_found_and_placed(tmp_path):
    def spoil(frame, step):
        if step == 3:
            frame["action"] = frame["action"] * float("nan")
        return frame

    data = make_dataset(tmp_path / "data", (5, 5), broken={1: spoil})
    stats = {key: {"min": torch.full((3,), -1.0), "max": torch.ones(3)} for key in ("observation.state", "action")}
    data.meta.stats.update(stats)
    policy = make_policy(small_config(), ds_meta=data.meta)
    with pytest.raises(ValueError, match=r"Episode 1 .* 'action' at frame\(s\) \[3\]"):
        policy.forward(batch_of(0, 1))


def test_a_camera_that_the_dataset_lacks_is_named(dataset, uneven_dataset):
    config = make_policy(small_config(), ds_meta=uneven_dataset.meta).config
    with pytest.raises(ValueError, match=r"lacks \['observation.images.wrist'\]"):
        UFRNNPolicy(config, dataset_stats=dataset.meta.stats, dataset_meta=dataset.meta)


def test_an_episode_that_does_not_exist_is_refused(policy):
    with pytest.raises(ValueError, match="Episode 3 does not exist"):
        policy.forward(batch_of(3))


# ── Checkpoints ───────────────────────────────────────────────────────


def test_a_checkpoint_acts_as_the_policy_that_wrote_it(trained, tmp_path):
    trained.save_pretrained(tmp_path)
    loaded = UFRNNPolicy.from_pretrained(tmp_path)
    for policy in (trained, loaded):
        policy.reset()
        torch.manual_seed(3)
        policy.actions = [policy.select_action(observation()) for _ in range(3)]
    for ours, theirs in zip(trained.actions, loaded.actions, strict=True):
        assert torch.equal(ours, theirs)


def test_a_checkpoint_without_memory_acts_as_sh_rnn_and_says_so(trained, tmp_path, caplog):
    trained.save_pretrained(tmp_path)
    file = tmp_path / "model.safetensors"
    weights = {key: value for key, value in load_file(file).items() if not key.startswith("demonstrations.")}
    save_file(weights, file)
    loaded = UFRNNPolicy.from_pretrained(tmp_path)
    assert "holds no memory of demonstrations" in caplog.text
    plain = UFRNNPolicy(replace(trained.config, exploration="none", recall=RecallConfig(enabled=False)))
    plain.load_state_dict(loaded.state_dict())
    for _ in range(20):
        assert torch.equal(loaded.select_action(observation()), plain.eval().select_action(observation()))
    assert loaded.recall.events == []


def test_only_the_memory_may_have_another_size_or_be_missing(trained, tmp_path):
    trained.save_pretrained(tmp_path)
    file = tmp_path / "model.safetensors"
    weights = load_file(file)
    for change, message in (
        ({"joint_scaler.low": torch.zeros(2)}, r"joint_scaler.low has shape \(2,\) instead of \(3,\)"),
        ({"demonstration": torch.zeros(2)}, "unknown demonstration"),
    ):
        save_file(weights | change, file)
        with pytest.raises(ValueError, match=message):
            UFRNNPolicy.from_pretrained(tmp_path)


@pytest.mark.parametrize("content", [b"", b"not a safetensors file", b"\x10\x00\x00\x00\x00\x00\x00\x00{broken"])
def test_a_broken_checkpoint_is_refused(trained, tmp_path, content):
    trained.save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="broken or not a safetensors file"):
        UFRNNPolicy.from_pretrained(tmp_path)


def test_a_truncated_checkpoint_is_refused(trained, tmp_path):
    trained.save_pretrained(tmp_path)
    file = tmp_path / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match="broken or not a safetensors file"):
        UFRNNPolicy.from_pretrained(tmp_path)


def test_a_missing_checkpoint_is_named(trained, tmp_path):
    trained.save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"no weights at .*model\.safetensors"):
        UFRNNPolicy.from_pretrained(tmp_path)


def test_weights_of_another_network_are_refused(trained, dataset, tmp_path):
    trained.save_pretrained(tmp_path)
    other = make_policy(small_config(shared_hidden_dim=9), ds_meta=dataset.meta).config
    with pytest.raises(ValueError, match="does not fit this policy's configuration"):
        UFRNNPolicy.from_pretrained(tmp_path, config=other)


@pytest.mark.parametrize("path", ["/nowhere/at/all", "./missing", "just_a_word"])
def test_a_wrong_autoencoder_path_is_refused(dataset, path):
    policy = make_policy(small_config(autoencoder={"path": path}), ds_meta=dataset.meta)
    policy.train()
    with pytest.raises(ValueError, match=r"`autoencoder\.path` must be a checkpoint folder"):
        policy.forward(batch_of(0))


def test_an_autoencoder_of_another_size_is_refused(dataset, trained, tmp_path):
    trained.save_pretrained(tmp_path)
    policy = make_policy(small_config(autoencoder={"feature_dim": 5, "path": str(tmp_path)}), ds_meta=dataset.meta)
    policy.train()
    with pytest.raises(ValueError, match="does not fit"):
        policy.forward(batch_of(0))
