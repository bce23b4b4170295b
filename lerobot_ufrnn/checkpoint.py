"""Weights on disk: found, read, and checked against what is expected of them."""

from pathlib import Path

from huggingface_hub import hf_hub_download
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor


def find_weights(path: str) -> Path:
    """`model.safetensors` of a checkpoint folder or a Hub repository `user/name`, downloaded where needed."""
    folder = Path(path).expanduser()
    if folder.is_dir():
        return folder / SAFETENSORS_SINGLE_FILE
    if folder.exists() or path.count("/") != 1 or path.startswith((".", "/", "~")):
        raise ValueError(
            f"`autoencoder.path` must be a checkpoint folder or a Hub repository 'user/name', got '{path}'."
        )
    return Path(hf_hub_download(path, SAFETENSORS_SINGLE_FILE))


def read_weights(
    file: str | Path, expected: dict[str, Tensor], prefix: str = "", of_any_size: tuple[str, ...] = ()
) -> dict[str, Tensor]:
    """Weights whose names begin with `prefix`, without it; refused unless names and shapes are those `expected`.

    What begins with one of `of_any_size` may be there or not, in any shape.
    """
    try:
        weights = load_file(file)
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"There are no weights at '{file}'; give the folder that holds model.safetensors."
        ) from error
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"'{file}' is broken or not a safetensors file ({error}); copy or download it again."
        ) from error
    weights = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
    wrong = [f"missing {key}" for key in sorted(expected.keys() - weights.keys())]
    unknown = sorted(weights.keys() - expected.keys())
    wrong += [f"unknown {key}" for key in unknown if not key.startswith(of_any_size)]
    wrong += [
        f"{key} has shape {tuple(weights[key].shape)} instead of {tuple(expected[key].shape)}"
        for key in sorted(expected.keys() & weights.keys())
        if expected[key].shape != weights[key].shape
    ]
    if wrong:
        raise ValueError(
            f"'{file}' does not fit this policy's configuration: {'; '.join(wrong[:5])}"
            f"{' ...' if len(wrong) > 5 else ''}. Load weights with the config.json they were saved with."
        )
    return weights
