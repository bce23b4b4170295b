"""LeRobot's pre- and post-processing pipelines for the `ufrnn` policy."""

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from .configuration_ufrnn import UFRNNConfig


def make_ufrnn_pre_post_processors(
    config: UFRNNConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Creates the pipelines: batch dimension and device on the way in, device on the way out.

    Observations and actions pass in their own units (radians, pixels in [0, 1]). The one scaling that measured joints,
    commanded joints and imagined joints share belongs to the policy and is saved with its weights; a second,
    separately configurable normalisation here could silently disagree with it.

    Args:
        config (`UFRNNConfig`):
            Policy configuration.
        dataset_stats (`dict[str, dict[str, Tensor]]`, *optional*):
            Dataset statistics, kept by the (identity) normalisation steps as LeRobot expects.

    Returns:
        `tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]`: pre- and post-processor.
    """
    return make_default_pre_post_processors(config, dataset_stats)
