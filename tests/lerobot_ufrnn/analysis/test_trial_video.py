import numpy as np
import pytest
from PIL import Image, ImageSequence

from lerobot_ufrnn.analysis.trial import Attempt, TrialHistory
from lerobot_ufrnn.analysis.trial_video import BAR_HEIGHT, annotate, captions, write_gif


def filmed(success: bool) -> TrialHistory:
    """Eight steps in which push is tried, then pull; the scene gets brighter with each."""
    film = [np.full((64, 240, 3), 20 * number, dtype=np.uint8) for number in range(9)]
    tries = [Attempt(1, "push"), Attempt(5, "pull")]
    return TrialHistory("pull", (), attempts=tries, returns=[3], states=[None] * 8, success=success, film=film)


@pytest.mark.parametrize("success", [True, False])
def test_captions_tell_what_is_tried_and_when_it_goes_back_from_the_picture_after_that_step(success):
    waits, push, back, pull = "push, pull or slide?", "tries to push", "contradicted: goes back", "tries to pull"
    expected = [waits, waits, push, push, back, back, pull, pull]
    assert captions(filmed(success)) == [*expected, "opened" if success else pull]


def test_each_picture_stands_above_a_bar_that_lists_what_was_tried_so_far():
    pictures = [np.asarray(picture) for picture in annotate(filmed(True))]
    assert {picture.shape for picture in pictures} == {(64 + BAR_HEIGHT, 240, 3)}
    assert all((picture[:64] == 20 * number).all() for number, picture in enumerate(pictures))
    lists = [picture[64 + BAR_HEIGHT // 2 :] for picture in pictures]
    changes = [number for number in range(1, 9) if (lists[number] != lists[number - 1]).any()]
    assert changes == [2, 6]


def test_the_animation_shows_the_pictures_in_order_and_rests_at_the_end(tmp_path):
    write_gif(annotate(filmed(True)), tmp_path / "folder" / "film.gif")
    with Image.open(tmp_path / "folder" / "film.gif") as animation:
        assert animation.info["loop"] == 0
        frames = [(frame.convert("RGB"), frame.info["duration"]) for frame in ImageSequence.Iterator(animation)]
    for (frame, _), number in zip(frames, range(9), strict=True):
        assert np.abs(np.asarray(frame)[:64].astype(int) - 20 * number).max() <= 4
    assert [duration for _, duration in frames] == [100] * 8 + [3000]
