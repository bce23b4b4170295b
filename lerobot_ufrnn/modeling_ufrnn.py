"""UFRNNPolicy: LeRobot batches on one side, the networks on the other."""

import logging
import threading
from pathlib import Path
from typing import Any, TypeVar

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE, OBS_STR
from torch import Generator, Tensor, nn

from .augmentation import augment_images, drifting_noise, hold_end, stall_indices
from .checkpoint import find_weights, read_weights
from .configuration_ufrnn import UFRNNConfig
from .demonstrations import Demonstrations, Moments
from .episodes import Episode, EpisodeStore
from .foresight import ForesightTrace, Memory
from .kernels import make_model
from .networks import ImageEncoder, Prediction, RangeScaler, gaussian_nll
from .recall import Recall

logger = logging.getLogger(__name__)

T = TypeVar("T", bound="UFRNNPolicy")

ENCODER_PREFIX = "image_encoder."
MEMORY_PREFIX = "demonstrations."
OLD_MEMORY_PREFIX = "rest."  # of version 0.1, which remembered only where demonstrations began and ended
FPS = 10.0  # control steps a second, unless the data set or the checkpoint says otherwise


class UFRNNPolicy(PreTrainedPolicy):
    """Uncertainty-driven Foresight RNN (UF-RNN), and its baselines SH-RNN+noise and SH-RNN.

    **Acting.** `select_action` encodes the cameras, scales the measured joints, advances the hidden state by one step
    and returns absolute joint targets. When contradicted, it goes back to a fork and carries out another demonstrated
    way, chosen by foresight among remembered states (`recall.py`); without recall, foresight refines the state at every
    step. The hidden state lives from `reset` to `reset`; `memory`, `last_trace` (of foresight at every step, so without
    recall) and `recall.events` show what happened.

    **Training** with stock `lerobot-train` goes through two phases, counted in updates and saved with the checkpoint:
    first the autoencoder (`autoencoder.steps` updates on frames of the batch's episodes), then, with its features
    computed once and kept, the recurrent network on whole episodes, which are remembered for acting (`demonstrations`).
    An item of a batch only *names* an episode.

    Args:
        config (`UFRNNConfig`):
            Policy configuration, with input and output features filled in (`make_policy` does).
        dataset_stats (`dict[str, dict[str, Tensor]]`, *optional*):
            Dataset statistics; the smallest and largest joint state and action set the scaling.
        dataset_meta (`LeRobotDatasetMetadata`, *optional*):
            Dataset metadata; needed for training.
        **kwargs:
            Whatever else LeRobot's factory passes; ignored.

    Raises:
        ValueError: If the features do not suit the policy or the dataset is empty.
    """

    config_class = UFRNNConfig
    name = "ufrnn"

    config: UFRNNConfig
    updates: Tensor
    noise_seed: Tensor

    def __init__(
        self,
        config: UFRNNConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: Any = None,
        **kwargs: Any,
    ):
        super().__init__(config)
        config.validate_features()
        self.image_encoder = ImageEncoder(config.cameras, config.autoencoder)
        self.joint_scaler = RangeScaler(config.joint_dim)
        self.model = make_model(config)
        fps = FPS if dataset_meta is None else dataset_meta.fps
        self.demonstrations = Demonstrations(config.joint_dim, config.image_dim, fps)
        self.recall = Recall(self.model, config, self.demonstrations) if config.recall.enabled else None
        # Training noise is a function of this seed and the update, so that a resumed run goes on exactly as if whole.
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        self.register_buffer("noise_seed", torch.randint(2**31, ()))
        if dataset_stats is not None:
            self._fit_joint_scaler(dataset_stats)
        self.episodes: EpisodeStore | None = None
        if dataset_meta is not None:
            self.episodes = EpisodeStore(dataset_meta, config.cameras, self.image_encoder)
            config.drop_n_last_frames = _frames_to_drop(self.episodes.lengths)
        self.reset()

    # ── Acting ────────────────────────────────────────────────────────

    def reset(self) -> None:
        """Forgets the episode: the next `select_action` starts from the zero state, with any batch size."""
        self.memory: Memory | None = None
        self.last_trace: ForesightTrace | None = None
        if self.recall is not None:
            self.recall.reset()
            if not self.training:
                self.demonstrations.moments(self.model.network)  # now, not in the first step of the episode
        self._thread = threading.get_ident()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Advances every episode of the batch by one step and returns the next joint targets.

        Args:
            batch (`dict[str, Tensor]`):
                `observation.state` (B, D_j) in the dataset's units and every camera (B, 3, height, width) in [0, 1].

        Returns:
            `Tensor`: absolute joint targets, (B, D_j), in the dataset's units.

        Raises:
            ValueError: If an input is missing, has another shape or holds NaN, or the batch size changes mid-episode.
            RuntimeError: If two threads share the policy, it was never trained, or its weights are not finite.
        """
        if threading.get_ident() != self._thread:
            raise RuntimeError(
                "UF-RNN carries its hidden state from step to step, so one policy cannot run several environments in "
                "threads. Set --env.max_parallel_tasks=1 (and use --eval.batch_size for parallel episodes)."
            )
        self._check_observation(batch)
        joints = self.joint_scaler.scale(batch[OBS_STATE])
        features = self.image_encoder({camera: batch[camera] for camera in self.config.cameras})
        if self.memory is None:
            self.memory = self.model.initial_memory(len(joints))
        stepper = self.model if self.recall is None else self.recall
        self.memory, self.last_trace = stepper.advance(torch.cat((joints, features), dim=-1), self.memory)
        if not torch.isfinite(torch.cat(self.memory.prediction, dim=-1)).all():
            raise RuntimeError("The policy predicts NaN or infinity: its weights are broken; train or load it anew.")
        return self.joint_scaler.unscale(self.memory.prediction.command)

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """One-step chunk (B, 1, D_j) of `select_action`; the policy re-plans at every step by design."""
        return self.select_action(batch).unsqueeze(1)

    def _check_observation(self, batch: dict[str, Tensor]) -> None:
        wanted = (OBS_STATE, *self.config.cameras)
        missing = [key for key in wanted if key not in batch]
        if missing:
            raise ValueError(
                f"The observation lacks {missing}; it has {sorted(key for key in batch if key.startswith(OBS_STR))}. "
                "Give the cameras the names they had in training, or map them with --rename_map."
            )
        batch_size = len(batch[OBS_STATE])
        for key in wanted:
            value = batch[key]
            shape = tuple(self.config.input_features[key].shape)
            # Images may come in any size: the encoder resizes them.
            expected = (batch_size, *shape) if key == OBS_STATE else (batch_size, 3, *tuple(value.shape[-2:]))
            if tuple(value.shape) != expected:
                raise ValueError(
                    f"'{key}' must have shape (batch, {', '.join(map(str, shape))}), got {tuple(value.shape)}."
                )
            # A sum that is finite clears all, ten times cheaper than asking each pixel.
            if value.is_floating_point() and not torch.isfinite(value.sum()):
                rows = (~torch.isfinite(value.flatten(1))).any(dim=1).nonzero().flatten().tolist()
                if rows:
                    raise ValueError(f"'{key}' holds NaN or infinite values in batch row(s) {rows}; check the sensor.")
        if self.memory is not None and (running := len(self.memory.state.h_joint)) != batch_size:
            raise ValueError(
                f"The batch size changed from {running} to {batch_size} in mid-episode; call reset() at the start of "
                "each episode."
            )

    # ── Training ──────────────────────────────────────────────────────

    @property
    def trains_autoencoder(self) -> bool:
        """`bool`: whether training is still in its first phase."""
        return self.config.autoencoder.path is None and int(self.updates) < self.config.autoencoder.steps

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Parameter groups; the recurrent network first, so that its learning rate is the one LeRobot logs."""
        return [
            {"params": list(self.model.parameters())},
            {"params": list(self.image_encoder.parameters()), "lr": self.config.autoencoder.lr},
        ]

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Training loss of the current phase.

        Args:
            batch (`dict[str, Tensor]`):
                A LeRobot batch; only `episode_index` (B,) is read.

        Returns:
            `tuple[Tensor, dict[str, float]]`: the loss and what to log.

        Raises:
            RuntimeError: If the policy was built without a dataset.
            ValueError: If the batch names no episodes, or an episode is broken.
        """
        if self.episodes is None:
            raise RuntimeError(
                "Training needs the dataset: build the policy with `make_policy(cfg, ds_meta=dataset.meta)`, as "
                "lerobot-train does."
            )
        if "episode_index" not in batch:
            raise ValueError(f"A training batch must hold 'episode_index' (B,), got {sorted(batch)}.")
        if int(self.updates) == 0 and self.config.autoencoder.path is not None and self.training:
            self._load_autoencoder(self.config.autoencoder.path)
        if not self.trains_autoencoder:
            self.episodes.encode()
        indices = batch["episode_index"].flatten().tolist()
        episodes = [self.episodes[index] for index in indices]
        generator = torch.Generator(self.updates.device).manual_seed(int(self.noise_seed) + int(self.updates))
        if self.trains_autoencoder:
            return self._autoencoder_loss(episodes, generator)
        if self.training:
            for index, episode in zip(indices, episodes, strict=True):
                self.demonstrations.remember(index, *self._scaled(episode))
        return self._recurrent_loss(episodes, generator)

    def update(self) -> None:
        """Counts an update; `lerobot-train` calls it after each optimiser step. Closes the autoencoder's phase."""
        was_training_autoencoder = self.trains_autoencoder
        self.updates += 1
        if was_training_autoencoder and not self.trains_autoencoder and self.episodes is not None:
            self._finish_autoencoder(self.episodes)

    def _finish_autoencoder(self, store: EpisodeStore) -> None:
        """Encodes all frames once and sets the range of the features."""
        store.encode()
        features = torch.cat([episode.features for episode in store.loaded.values()])
        self.image_encoder.scaler.fit(features.amin(0), features.amax(0))
        logger.info("Autoencoder done: %d frames encoded; the recurrent network trains now.", len(features))

    def _autoencoder_loss(self, episodes: list[Episode], generator: Generator) -> tuple[Tensor, dict[str, float]]:
        config, device = self.config.autoencoder, self.updates.device
        picks = torch.randint(2**31, (config.batch_size,), generator=generator, device=device).tolist()
        errors = []
        for camera, autoencoder in self.image_encoder.by_camera():
            if int(self.updates) == 0 and self.training:
                all_frames = torch.cat([episode.images[camera] for episode in episodes])
                autoencoder.fit_background(self.image_encoder.resize(all_frames.to(device)))
            sources = [episodes[row % len(episodes)].images[camera] for row in range(len(picks))]
            frames = torch.stack([source[pick % len(source)] for source, pick in zip(sources, picks, strict=True)])
            clean = self.image_encoder.resize(frames.to(device))
            noisy = clean
            if self.training:
                noisy = augment_images(clean, config.image_shift, config.image_jitter, config.image_noise, generator)
            errors.append((autoencoder.decode(autoencoder.encode(noisy)) - clean).square().mean())
        loss = torch.stack(errors).mean()
        return loss, {"autoencoder_mse": loss.item()}

    def _recurrent_loss(self, episodes: list[Episode], generator: Generator) -> tuple[Tensor, dict[str, float]]:
        inputs, targets, commands, mask = self._sequences(episodes, generator)
        if self.training:
            noise = self.config.augmentation
            inputs = inputs + drifting_noise(inputs, noise.input_noise, noise.input_noise_correlation, generator)
        prediction, trace = self.model(inputs, generator)
        nll = gaussian_nll(targets, prediction.mean, prediction.log_variance).sum(-1)  # (B, L)
        loss = nll[mask].mean()
        joint_dim = self.model.network.joint_dim
        if self.config.command_target == "action":
            # A command is as uncertain as the joints that it leads to, which it must not make more or less certain.
            log_variance = prediction.log_variance[..., :joint_dim].detach()
            loss = loss + gaussian_nll(commands, prediction.command, log_variance).sum(-1)[mask].mean()
        variance = self.model.modality_variance(prediction)[mask].detach()  # (M, 2)
        if self.training:
            self.model.foresight.schedule.observe(variance)
        error = (targets - prediction.mean).detach().square()[mask]
        logs = {
            "nll": nll[mask].mean().item(),
            "command_rmse": (commands - prediction.command).detach()[mask].square().mean().sqrt().item(),
            "joint_rmse": error[:, :joint_dim].mean().sqrt().item(),
            "feature_rmse": error[:, joint_dim:].mean().sqrt().item(),
            "joint_variance": variance[:, 0].mean().item(),
            "feature_variance": variance[:, 1].mean().item(),
        }
        if trace is not None:
            # How much calmer the kept future is than the average candidate's: 0 would mean that selection does nothing.
            logs["foresight_gain"] = (1 - trace.final.amin(1) / trace.final.mean(1)).mean().item()
            if self.config.foresight.horizon_mode == "learned":
                loss = loss + _horizon_loss(prediction, trace, self.config.foresight.horizon, mask)
        return loss, logs

    def _sequences(self, episodes: list[Episode], generator: Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Scaled inputs and targets (B, L, D), commands (B, L, D_j) and the mask (B, L) of the steps that exist."""
        sequences = [self._sequence(episode) for episode in episodes]
        stalls = self.config.augmentation
        if self.training and stalls.stall_probability > 0:
            longest = int(max(len(inputs) for inputs, *_ in sequences) * stalls.stall_stretch)
            cpu = torch.Generator().manual_seed(generator.initial_seed())
            for row, values in enumerate(sequences):
                index = stall_indices(len(values[0]), stalls.stall_probability, stalls.stall_steps, longest, cpu)
                index = index.to(values[0].device)
                sequences[row] = (values[0][index], values[1][index], values[2][index])
        lengths = torch.tensor([len(inputs) for inputs, *_ in sequences], device=self.updates.device)
        inputs, targets, commands = (
            nn.utils.rnn.pad_sequence(list(rows), batch_first=True) for rows in zip(*sequences, strict=True)
        )
        return inputs, targets, commands, torch.arange(inputs.shape[1], device=inputs.device) < lengths[:, None]

    def _sequence(self, episode: Episode) -> tuple[Tensor, Tensor, Tensor]:
        """Inputs and what they lead to (L - 1, D), and the commands in between (L - 1, D_j), all scaled.

        In training L counts the steps for which the last moment is held on.
        """
        sensed, actions = self._scaled(episode)
        if self.training:
            sensed, actions = (
                hold_end(values, self.config.augmentation.hold_end_steps) for values in (sensed, actions)
            )
        return sensed[:-1], sensed[1:], actions[:-1]

    def _scaled(self, episode: Episode) -> tuple[Tensor, Tensor]:
        """What was sensed (L, D) and commanded (L, D_j), scaled."""
        device = self.updates.device
        joints = self.joint_scaler.scale(episode.states.to(device))
        features = self.image_encoder.scaler.scale(episode.features.to(device))
        return torch.cat((joints, features), -1), self.joint_scaler.scale(episode.actions.to(device))

    def _fit_joint_scaler(self, stats: dict[str, dict[str, Tensor]]) -> None:
        """One range for measured and commanded joints: a command fed back must mean what a measurement means."""
        try:
            bounds = [torch.as_tensor(stats[key][bound]) for bound in ("min", "max") for key in (OBS_STATE, ACTION)]
        except KeyError as error:
            raise ValueError(
                f"The dataset's statistics lack {error} (min and max of '{OBS_STATE}' and '{ACTION}' are needed). "
                "Record the dataset with a current LeRobot, which writes meta/stats.json."
            ) from error
        state_low, action_low, state_high, action_high = bounds
        low, high = torch.minimum(state_low, action_low), torch.maximum(state_high, action_high)
        # A joint that hardly moves is not worth following to a fraction of a degree.
        self.joint_scaler.fit(low, high, relative_floor=0.25)

    # ── Saving and loading ───────────────────────────────────────────────────────

    def _save_pretrained(self, save_directory: Path, *args: Any, **kwargs: Any) -> None:
        """Says in training which demonstrations the network has not learned to follow by itself."""
        super()._save_pretrained(save_directory, *args, **kwargs)
        moments = Moments.of(self.demonstrations, self.model.network) if self.training else None
        if moments is not None:
            left = self.demonstrations.indices[moments.not_followed(self.model.network)].tolist()
            logger.info("Demonstrations that the network does not follow yet: %s of %d.", left or "none", moments.size)

    @classmethod
    def _load_as_safetensor(cls: type[T], model: T, model_file: str, map_location: str, strict: bool) -> T:
        """Loads weights and refuses a broken or foreign file: random layers would look like a bad policy."""
        expected = {key: value for key, value in model.state_dict().items() if not key.startswith(MEMORY_PREFIX)}
        weights = read_weights(model_file, expected, of_any_size=(MEMORY_PREFIX, OLD_MEMORY_PREFIX))
        model.load_state_dict(weights, strict=False)  # `read_weights` has checked all but the memory
        if model.recall is not None and not any(key.startswith(MEMORY_PREFIX) for key in weights):
            logger.warning(
                "'%s' holds no memory of demonstrations: the policy cannot go back and acts as SH-RNN. Train it "
                "anew, or go on with its training for an epoch.",
                model_file,
            )
        return model

    def _load_autoencoder(self, path: str) -> None:
        """Takes image encoder and feature range over from another `ufrnn` checkpoint."""
        file = find_weights(path)
        self.image_encoder.load_state_dict(
            read_weights(file, expected=self.image_encoder.state_dict(), prefix=ENCODER_PREFIX)
        )
        if not self.image_encoder.scaler.is_fitted:
            raise ValueError(
                f"The autoencoder in '{path}' is not trained to its end; take a checkpoint of a run with at least "
                "`autoencoder.steps` updates."
            )
        logger.info("Autoencoder taken over from %s.", path)


def _frames_to_drop(lengths: list[int]) -> int:
    """Frames at each episode's end that LeRobot's sampler leaves out.

    Every frame that it may draw stands for its whole episode. Equal lengths: all frames but the first are left out, so
    that an epoch holds each episode once. Unequal lengths: dropping such a count from all would favour the long
    episodes by far more than their length, so only the last frame is left out, which has no next one to predict:
    episodes come up in proportion to their length, and the sampler skips one of a single frame with a warning.
    """
    return lengths[0] - 1 if len(set(lengths)) == 1 else 1


def _horizon_loss(prediction: Prediction, trace: ForesightTrace, horizon: int, mask: Tensor) -> Tensor:
    """Teaches the step scalars at which imagined step of T the kept future was least uncertain, as a fraction of T."""
    assert trace.calmest is not None
    calmest = trace.calmest.gather(1, trace.chosen.unsqueeze(1)).squeeze(1)  # (L, B)
    target = (calmest / horizon).T.to(prediction.step)  # (B, L)
    loss = nn.functional.binary_cross_entropy_with_logits(
        prediction.step, target[..., None].expand_as(prediction.step), reduction="none"
    )
    return loss.mean(-1)[mask].mean()
