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
from lerobot_ufrnn import UFRNNConfig
from lerobot_ufrnn.commands.demo import DemoConfig
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy


def test_lerobot_discovers_the_plugin():
    register_third_party_plugins()
    assert EnvConfig.get_choice_class("door") is DoorEnvConfig
    assert PreTrainedConfig.get_choice_class("ufrnn") is UFRNNConfig
    assert get_policy_class("ufrnn") is UFRNNPolicy
    assert make_policy_config("ufrnn", num_samples=7).num_samples == 7


def test_the_defaults_are_the_papers():
    config = UFRNNConfig()
    assert (config.num_samples, config.horizon, config.noise_range) == (5, 10, (0.05, 0.15))
    assert (config.joint_hidden_dim, config.image_hidden_dim, config.shared_hidden_dim, config.feature_dim) == (
        50,
        50,
        20,
        10,
    )


def test_a_saved_configuration_loads_equal(tmp_path):
    config = UFRNNConfig(noise_range=(0.1, 0.2), conv_channels=(8, 8), exploration="noise", device="cpu")
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("exploration", "curiosity", "foresight"),
        ("noise_unit", "metres", "variance"),
        ("noise_scale", "cubic", "log"),
        ("perturbed_states", "everything", "hidden_and_cell"),
        ("variance_baseline", "mine", "candidate"),
        ("variance_aggregation", "max", "entropy"),
        ("horizon_mode", "infinite", "learned"),
        ("command_target", "torque", "next_state"),
        ("num_samples", 0, "at least 1"),
        ("horizon", -3, "at least 1"),
        ("shared_hidden_dim", 0, "at least 1"),
        ("autoencoder_steps", 0, "at least 1"),
        ("stall_steps", 0, "at least 1"),
        ("image_shift", -1, "at least 0"),
        ("input_noise", -0.1, "from 0"),
        ("input_noise_correlation", 1.0, "below 1"),
        ("image_noise", 1.5, "below 1"),
        ("recall_samples", 0, "at least 1"),
        ("recall_horizon", 0, "at least 1"),
        ("surprise_threshold", 1.0, "above 1"),
        ("surprise_threshold", float("inf"), "above 1"),
        ("recall_commitment", -1, "at least 0"),
        ("hold_end_steps", -1, "at least 0"),
        ("recall_commitment", 61, "at most"),
        ("recall_memory", -1.0, "at least 0"),
        ("recall_memory", float("nan"), "at least 0"),
        ("recall_noise", (0.2, 0.1), "low <= high"),
        ("recall_noise", (-0.1, 0.1), "low <= high"),
        ("recall_noise", (0.1, 0.2, 0.3), "two numbers"),
        ("stall_probability", 1.2, "from 0 to 1"),
        ("stall_stretch", 0.5, "at least 1"),
        ("optimizer_lr", 0.0, "above 0"),
        ("optimizer_lr", float("nan"), "above 0"),
        ("noise_range", (0.2, 0.1), "low <= high"),
        ("noise_range", (-0.1, 0.1), "low <= high"),
        ("noise_range", (0.1,), "two numbers"),
        ("log_variance_range", (3.0, -9.0), "low < high"),
        ("image_size", (8, 128), "at least 16 x 16"),
        ("conv_channels", (8,) * 9, "halved"),
        ("conv_channels", (), "halved"),
        ("conv_first_stride", 0, "at least 1"),
        ("conv_first_stride", 200, "side"),
    ],
)
def test_a_value_out_of_range_is_refused_with_what_is_allowed(field, value, allowed):
    with pytest.raises(ParsingError, match=f"`{field}` must .*{allowed}"):
        UFRNNConfig(**{field: value})


def test_the_command_line_says_what_is_wrong():
    """draccus replaces a ValueError by "Couldn't instantiate class"; ours must come through."""
    with pytest.raises(ParsingError, match="`horizon` must be at least 1, got 0"):
        draccus.parse(TrainPipelineConfig, args=["--dataset.repo_id=a/b", "--policy.type=ufrnn", "--policy.horizon=0"])
    with pytest.raises(ParsingError, match="must be one of push, pull"):
        draccus.parse(EvalConfig, args=["--env.type=door", "--env.task=lift"])


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
    assert (policy.num_samples, policy.horizon, policy.optimizer_lr, config.batch_size) == (5, 10, 1e-4, 5)
    # 15 demonstrations in batches of 5 are 3 updates an epoch.
    assert config.steps - policy.autoencoder_steps == 3 * 3000


def test_our_own_configuration_is_the_default():
    config = draccus.parse(TrainPipelineConfig, CONFIGS / "ufrnn.yaml", args=[])
    assert config.policy == UFRNNConfig()
    demo = DemoConfig()
    assert config.batch_size == demo.batch_size
    assert demo.autoencoder_steps == config.policy.autoencoder_steps
