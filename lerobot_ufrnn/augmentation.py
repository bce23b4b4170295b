"""Training-time augmentation of images (for the autoencoder) and of whole episodes (for the recurrent network)."""

import math

import torch
from torch import Generator, Tensor


def augment_images(
    images: Tensor, max_shift: int, colour_jitter: float, noise_std: float, generator: Generator | None = None
) -> Tensor:
    """Shifts, recolours and roughens images (B, 3, height, width) in [0, 1]; the clean ones are to be reconstructed.

    Shifts are of up to `max_shift` pixels along both axes, with borders repeated; jitter is the largest relative change
    of each image's brightness and of each of its colour channels.
    """
    batch_size, _, height, width = images.shape

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=images.device) * 2 - 1

    if max_shift > 0:
        padded = torch.nn.functional.pad(images, (max_shift,) * 4, mode="replicate")
        shifts = torch.randint(0, 2 * max_shift + 1, (batch_size, 2), generator=generator, device=images.device)
        # Cutting out windows one by one is several times as fast as gathering pixels by index.
        corners = zip(padded, shifts.tolist(), strict=True)
        images = torch.stack([image[:, top : top + height, left : left + width] for image, (top, left) in corners])
    gain = 1 + colour_jitter * (uniform(batch_size, 1, 1, 1) + uniform(batch_size, 3, 1, 1)) / 2
    # One image of noise serves the whole batch: drawing normal numbers would take longer than all the rest.
    noise = noise_std * torch.randn(images.shape[1:], generator=generator, device=images.device)
    return torch.addcmul(noise, images, gain).clamp_(0, 1)


def drifting_noise(like: Tensor, std: float, correlation: float, generator: Generator | None = None) -> Tensor:
    """Noise that drifts over an episode: a stationary first-order autoregressive process in each dimension.

    A network that reads its inputs (B, L, D) with it, and must still predict what was demonstrated, learns to lead back
    to the demonstrated way from beside it. Independent noise does not teach that: it averages out over a few steps.
    The correlation falls to 1/e over `-1 / log(correlation)` steps.
    """
    white = std * torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)
    steps = [white[:, 0]]
    for fresh in white[:, 1:].unbind(1):
        steps.append(correlation * steps[-1] + math.sqrt(1 - correlation**2) * fresh)
    return torch.stack(steps, dim=1)


def hold_end(values: Tensor, num_steps: int) -> Tensor:
    """Goes on with an episode's last moment: (L, D) -> (L + num_steps, D).

    Recordings often stop as soon as the task is done, while the arm still moves. A network that has never seen what
    comes after slows down on its way there; one that has learned to stay where a demonstration ended is led to it.
    """
    return torch.cat((values, values[-1:].expand(num_steps, -1)))


def stall_indices(
    length: int, probability: float, max_steps: int, max_length: int, generator: Generator | None = None
) -> Tensor:
    """Time index of an episode that stalls now and then: the same moment is seen for several steps.

    Inputs and targets read through the same index, so that while the observation stands still its target waits too:
    the next move depends on what is seen, not on how much time has passed.

    A stall begins at any step with `probability` and lasts 1 to `max_steps` steps, uniformly; once stalls have used up
    `max_length - length` steps, no further one begins. The indices are non-decreasing, from 0 to `length` - 1, each at
    least once.
    """
    begins = torch.rand(length, generator=generator) < probability
    extra = torch.randint(1, max_steps + 1, (length,), generator=generator) * begins
    # Stalls spend a budget from a random place in the episode, so that a short budget does not favour the beginning.
    start = int(torch.randint(0, length, (1,), generator=generator))
    order = (torch.arange(length) + start) % length
    spent = extra[order].cumsum(0)
    granted = (spent.clamp(max=max(max_length - length, 0))).diff(prepend=torch.zeros(1, dtype=spent.dtype))
    repeats = torch.ones(length, dtype=torch.long)
    repeats[order] += granted
    return torch.arange(length).repeat_interleave(repeats)
