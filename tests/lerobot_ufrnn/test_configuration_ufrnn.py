import json
from dataclasses import dataclass
from pathlib import Path

import draccus
import pytest
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import EnvConfig
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.utils.import_utils import register_third_party_plugins

from env_door.configuration_door import DoorEnvConfig
from lerobot_ufrnn.commands.demo import DemoConfig
from lerobot_ufrnn.configuration_ufrnn import (
    AugmentationConfig,
    AutoencoderConfig,
    ForesightConfig,
    RecallConfig,
    UFRNNConfig,
)
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy


def test_lerobot_discovers_the_plugin():
    register_third_party_plugins()
    assert EnvConfig.get_choice_class("door") is DoorEnvConfig
    assert PreTrainedConfig.get_choice_class("ufrnn") is UFRNNConfig
    assert get_policy_class("ufrnn") is UFRNNPolicy
    assert make_policy_config("ufrnn", shared_hidden_dim=7).shared_hidden_dim == 7


def test_the_defaults_are_the_papers():
    config = UFRNNConfig()
    foresight = config.foresight
    assert (foresight.num_samples, foresight.horizon, foresight.noise_range) == (5, 10, (0.05, 0.15))
    assert (config.joint_hidden_dim, config.image_hidden_dim, config.shared_hidden_dim) == (50, 50, 20)
    assert config.autoencoder.feature_dim == 10


def test_a_saved_configuration_loads_equal(tmp_path):
    config = UFRNNConfig(
        foresight=ForesightConfig(noise_range=(0.1, 0.2)),
        recall=RecallConfig(enabled=False),
        autoencoder=AutoencoderConfig(conv_channels=(8, 8)),
        exploration="noise",
        device="cpu",
    )
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


@pytest.mark.parametrize(
    ("group", "field", "value", "allowed"),
    [
        (UFRNNConfig, "exploration", "curiosity", "foresight"),
        (ForesightConfig, "noise_unit", "metres", "variance"),
        (ForesightConfig, "noise_scale", "cubic", "log"),
        (ForesightConfig, "perturbed_states", "everything", "hidden_and_cell"),
        (ForesightConfig, "variance_baseline", "mine", "candidate"),
        (ForesightConfig, "variance_aggregation", "max", "entropy"),
        (ForesightConfig, "horizon_mode", "infinite", "learned"),
        (UFRNNConfig, "command_target", "torque", "next_state"),
        (ForesightConfig, "num_samples", 0, "at least 1"),
        (ForesightConfig, "horizon", -3, "at least 1"),
        (UFRNNConfig, "shared_hidden_dim", 0, "at least 1"),
        (AutoencoderConfig, "steps", 0, "at least 1"),
        (AugmentationConfig, "stall_steps", 0, "at least 1"),
        (AutoencoderConfig, "image_shift", -1, "at least 0"),
        (AugmentationConfig, "input_noise", -0.1, "at least 0"),
        (AugmentationConfig, "input_noise_correlation", 1.0, "below 1"),
        (AutoencoderConfig, "image_noise", 1.5, "below 1"),
        (RecallConfig, "horizon", 0.0, "above 0"),
        (RecallConfig, "horizon", float("inf"), "above 0"),
        (RecallConfig, "patience", -0.1, "above 0"),
        (RecallConfig, "stay", 1.0, "above 1"),
        (RecallConfig, "stay", float("inf"), "above 1"),
        (RecallConfig, "strange", 1.0, "above 1"),
        (RecallConfig, "strange", float("nan"), "above 1"),
        (AugmentationConfig, "hold_end_steps", -1, "at least 0"),
        (AugmentationConfig, "stall_probability", 1.2, "at most 1"),
        (AugmentationConfig, "stall_stretch", 0.5, "at least 1"),
        (UFRNNConfig, "optimizer_lr", 0.0, "above 0"),
        (UFRNNConfig, "optimizer_lr", float("nan"), "above 0"),
        (ForesightConfig, "noise_range", (0.2, 0.1), "low <= high"),
        (ForesightConfig, "noise_range", (-0.1, 0.1), "at least 0"),
        (ForesightConfig, "noise_range", (0.1,), "two numbers"),
        (UFRNNConfig, "log_variance_range", (3.0, -9.0), "low < high"),
        (AutoencoderConfig, "image_size", (8, 128), "at least 16 pixels"),
        (AutoencoderConfig, "conv_channels", (8,) * 9, "halved"),
        (AutoencoderConfig, "conv_channels", (), "halved"),
        (AutoencoderConfig, "conv_first_stride", 0, "at least 1"),
        (AutoencoderConfig, "conv_first_stride", 200, "at most 128"),
    ],
)
def test_a_value_out_of_range_is_refused_with_what_is_allowed(group, field, value, allowed):
    with pytest.raises(ParsingError, match=f"`{field}` must .*{allowed}"):
        group(**{field: value})


TRAIN = ["--dataset.repo_id=a/b", "--policy.type=ufrnn"]


def test_the_command_line_says_what_is_wrong():
    """draccus replaces a ValueError by "Couldn't instantiate class"; ours must come through."""
    with pytest.raises(ParsingError, match="`horizon` must be at least 1, got 0"):
        draccus.parse(TrainPipelineConfig, args=[*TRAIN, "--policy.foresight.horizon=0"])
    with pytest.raises(ParsingError, match="must be one of push, pull"):
        draccus.parse(EvalConfig, args=["--env.type=door", "--env.task=lift"])


def test_fields_in_groups_have_flags():
    args = [*TRAIN, "--policy.recall.enabled=false", "--policy.autoencoder.steps=7"]
    policy = draccus.parse(TrainPipelineConfig, args=args).policy
    assert (policy.recall.enabled, policy.autoencoder.steps) == (False, 7)


def test_configurations_of_before_the_groups_are_refused(tmp_path):
    UFRNNConfig(device="cpu")._save_pretrained(tmp_path)
    file = tmp_path / "config.json"
    old = json.loads(file.read_text())
    del old["recall"]
    file.write_text(json.dumps({**old, "recall": True, "recall_samples": 60}))
    message = "`recall`: Failed when parsing .* of type .*RecallConfig"
    with pytest.raises(ParsingError, match=message):
        PreTrainedConfig.from_pretrained(tmp_path)
    with pytest.raises(ParsingError, match=message):
        draccus.parse(TrainPipelineConfig, args=[*TRAIN, "--policy.recall=false"])


@dataclass
class EvalConfig:
    env: EnvConfig


STATE = {"observation.state": PolicyFeature(FeatureType.STATE, (7,))}
IMAGE = {"observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 64, 64))}
ACTION = {"action": PolicyFeature(FeatureType.ACTION, (7,))}


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        (IMAGE, ACTION, "needs 'observation.state'"),
        (STATE, ACTION, "at least one camera"),
        (STATE | IMAGE, {}, "needs 'action'"),
        (STATE | IMAGE, {"action": PolicyFeature(FeatureType.ACTION, (6,))}, "the same joints"),
        (STATE | {"observation.images.d": PolicyFeature(FeatureType.VISUAL, (1, 64, 64))}, ACTION, "colour image"),
    ],
)
def test_unsuitable_features_are_refused(inputs, outputs, message):
    config = UFRNNConfig(input_features=inputs, output_features=outputs)
    with pytest.raises(ValueError, match=message):
        config.validate_features()


CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize(
    ("name", "exploration"), [("ufrnn_paper", "foresight"), ("sh_rnn_noise_paper", "noise"), ("sh_rnn_paper", "none")]
)
def test_the_three_models_have_the_papers_values(name, exploration):
    config = draccus.parse(TrainPipelineConfig, CONFIGS / f"{name}.yaml", args=[])
    policy = config.policy
    assert policy.exploration == exploration
    assert (policy.foresight.num_samples, policy.foresight.horizon) == (5, 10)
    assert (policy.optimizer_lr, config.batch_size) == (1e-4, 5)
    # 15 demonstrations in batches of 5 are 3 updates an epoch.
    assert config.steps - policy.autoencoder.steps == 3 * 3000


def test_our_own_configuration_is_the_default():
    config = draccus.parse(TrainPipelineConfig, CONFIGS / "ufrnn.yaml", args=[])
    assert config.policy == UFRNNConfig()
    demo = DemoConfig()
    assert config.batch_size == demo.batch_size
    assert demo.autoencoder_steps == config.policy.autoencoder.steps
