"""Fixtures: small data sets and an untrained policy."""

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy
from small import make_dataset, small_config


@pytest.fixture(scope="session")
def dataset(tmp_path_factory) -> LeRobotDataset:
    """Three episodes of 12 frames."""
    return make_dataset(tmp_path_factory.mktemp("equal") / "dataset", (12, 12, 12))


@pytest.fixture(scope="session")
def uneven_dataset(tmp_path_factory) -> LeRobotDataset:
    """Episodes of unequal lengths, two cameras."""
    return make_dataset(tmp_path_factory.mktemp("uneven") / "dataset", (7, 12, 9), ("front", "wrist"))


@pytest.fixture
def policy(dataset):
    """An untrained policy that knows the data set."""
    torch.manual_seed(0)
    return make_policy(small_config(), ds_meta=dataset.meta)
