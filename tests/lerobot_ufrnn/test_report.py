import json
import shutil
import subprocess
from base64 import b64decode
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from small import observation, small_config

from lerobot_ufrnn.analysis.evaluation_table import InterferenceRow, ProtocolRow, to_csv
from lerobot_ufrnn.analysis.foresight_picture import draw_strip
from lerobot_ufrnn.analysis.trial import Attempt, Imagination, TrialHistory, run_trial
from lerobot_ufrnn.analysis.trial_video import BAR_HEIGHT, annotate, encode
from lerobot_ufrnn.commands import main
from lerobot_ufrnn.modeling_ufrnn import UFRNNPolicy
from lerobot_ufrnn.networks import Prediction

HOSTILE = """<script>alert("'")</script>$\\bad$&amp;"""
PICTURES = ("hidden.png", "held.png", "lyapunov.png", "foresight.png")
STEPS = 6


class Page(HTMLParser):
    """What is in a page: each tag with its attributes, ids, text, and the rows of its tables."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.rows, self.in_cell = "", [], False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self.in_cell = True
        elif tag == "br":
            self.handle_data(" ")

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self.in_cell = False

    def handle_data(self, data):
        self.text += data
        if self.in_cell:
            self.rows[-1][-1] += data

    def attributes(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    def row(self, *names: str) -> list[str]:
        """Cells of the first row that begins so."""
        rows = [[" ".join(cell.split()) for cell in row] for row in self.rows]
        return next(row for row in rows if row[: len(names)] == list(names))


def media(source: str, media_type: str) -> bytes:
    head, _, content = source.partition(",")
    assert head == f"data:{media_type};base64"
    return b64decode(content, validate=True)


def evaluations(model: str, opened: int) -> list[ProtocolRow]:
    return [
        ProtocolRow(model, seed, epoch, kind, 10, opened // 2, opened, 6, opened // 2)
        for seed in (0, 1)
        for epoch in (100, 200)
        for kind in ("push", "pull", "slide")
    ]


@pytest.fixture
def results(tmp_path) -> Path:
    """A folder of results in which nothing is missing."""
    folder = tmp_path / "results"
    folder.mkdir()
    rows = [*evaluations("ufrnn", 8), *evaluations("sh_rnn", 3), *evaluations(HOSTILE, 2)]
    (folder / "door_protocol.csv").write_text(to_csv(rows))
    (folder / "ablation.csv").write_text(to_csv(evaluations("ufrnn_blind", 5)))
    held = [InterferenceRow("ufrnn", seed, 200, "pull", 10, 8, 6, number) for seed, number in ((0, 1), (1, 0))]
    (folder / "door_interference.csv").write_text(to_csv(held))
    for number, name in enumerate(PICTURES):
        cv2.imwrite(str(folder / name), np.full((40, 60 + 40 * number, 3), 200, dtype=np.uint8))
    return folder


def untrained(joint_dim: int, image_size: int, **settings) -> UFRNNPolicy:
    """A policy that has learned nothing, and imagines at every step."""
    torch.manual_seed(0)
    camera = PolicyFeature(FeatureType.VISUAL, (3, image_size, image_size))
    policy = UFRNNPolicy(
        small_config(
            input_features={
                "observation.state": PolicyFeature(FeatureType.STATE, (joint_dim,)),
                "observation.images.front": camera,
            },
            output_features={"action": PolicyFeature(FeatureType.ACTION, (joint_dim,))},
            kernel="reference",
            recall=False,
            **settings,
        )
    )
    policy.joint_scaler.fit(torch.full((joint_dim,), -3.0), torch.full((joint_dim,), 3.0))
    policy.image_encoder.scaler.fit(torch.full((4,), -1.0), torch.full((4,), 1.0))
    return policy


@pytest.fixture
def door_policy(tmp_path) -> Path:
    """An untrained policy for the door."""
    untrained(7, 128).save_pretrained(tmp_path / "policy")
    return tmp_path / "policy"


@pytest.fixture
def recoveries(monkeypatch):
    """Trials count as recoveries, which an untrained policy knows nothing of."""

    def recovered(*arguments):
        history = run_trial(*arguments)
        wrong = "push" if history.door_kind == "pull" else "pull"
        history.attempts, history.success = [Attempt(2, wrong), Attempt(4, history.door_kind)], True
        return history

    monkeypatch.setattr("lerobot_ufrnn.commands.report.run_trial", recovered)


def report(results: Path, *flags: str) -> Page:
    output = results.parent / "pages" / "report.html"
    assert main(["report", f"--results_dir={results}", f"--output={output}", *flags]) == 0
    assert [path.name for path in output.parent.iterdir()] == ["report.html"]
    return Page(output.read_text())


def film_flags(policy: Path, kinds: str) -> list[str]:
    return [f"--policy_path={policy}", f"--kinds=[{kinds}]", f"--num_steps={STEPS}", "--trials_per_kind=2"]


# ── The page ──────────────────────────────────────────────────────────


def test_the_page_needs_nothing_else_and_all_in_it_is_sound(results, door_policy, recoveries):
    page = report(results, *film_flags(door_policy, "pull,slide"))
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(set(ids)) == len(ids)
    references = [
        attributes[name] for _, attributes in page.tags for name in ("href", "src", "poster") if name in attributes
    ]
    links = [reference for reference in references if reference.startswith("#")]
    assert len(links) == 8
    assert {link[1:] for link in links} <= set(ids)
    assert {attributes["aria-labelledby"] for attributes in page.attributes("section")} <= set(ids)
    assert all(reference.startswith("data:") for reference in references if reference not in links)
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in page.tags}

    assert len(page.attributes("img")) == len(PICTURES) + 2  # the curve and the strip
    for attributes in page.attributes("img"):
        image = cv2.imdecode(np.frombuffer(media(attributes["src"], "image/png"), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape[:2] == (int(attributes["height"]), int(attributes["width"]))
        assert attributes["alt"]
    assert len(page.attributes("video")) == 2
    for attributes in page.attributes("video"):
        with av.open(BytesIO(media(attributes["src"], "video/mp4"))) as container:
            stream = container.streams.video[0]
            assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 10)
            assert (stream.height, stream.width) == (int(attributes["height"]), int(attributes["width"]))
            assert len(list(container.decode(stream))) == STEPS + 1
        assert media(attributes["poster"], "image/png").startswith(b"\x89PNG")
    assert "Pull door, seed 2000. Tried push at 0.3 s, pull at 0.5 s; opened at 0.6 s." in page.text
    assert 'class="note"' not in (results.parent / "pages" / "report.html").read_text()


def test_tables_pool_the_last_epoch_and_compare_models(results):
    page = report(results)
    assert page.row("model", "opened in 30 s")[2:] == [
        "recovered from a wrong guess",
        "opened, first guess right",
        "opened in 15 s",
        "epoch",
        "seeds",
    ]
    rates = ["80 % [68, 88] 48/60", "67 % [50, 80] 24/36", "40 % [29, 53] 24/60", "40 % [29, 53] 24/60"]
    assert page.row("ufrnn", rates[0]) == ["ufrnn", *rates, "200", "2"]
    assert page.row("ufrnn", "slide")[2] == "80 % [58, 92] 16/20"
    assert page.row("ufrnn − sh_rnn")[1:3] == ["+50 [+33, +63]", "+50 [+28, +66]"]  # noqa: RUF001 (minus signs)
    assert page.row("ufrnn_blind")[1] == "50 % [38, 62] 30/60"
    held = ["80 % [58, 92] 16/20", "75 % [51, 90] 12/16", "6 % [1, 28] 1/16"]
    assert page.row("ufrnn", held[0])[1:] == [*held, "200", "2"]
    assert "+50" not in page.row("ufrnn_blind")


def test_a_rate_of_no_trials_is_a_dash(results):
    rows = [ProtocolRow("ufrnn", 0, 1, "push", 10, 5, 10, 0, 0), ProtocolRow("other", 0, 1, "push", 10, 5, 10, 2, 2)]
    (results / "door_protocol.csv").write_text(to_csv(rows))
    page = report(results)
    assert page.row("ufrnn", "100 % [72, 100] 10/10")[2] == "– 0/0"  # noqa: RUF001 (a dash)
    assert page.row("ufrnn − other")[2] == "–"  # noqa: RUF001 (a minus sign and a dash)


def test_a_hostile_name_is_text(results):
    page = report(results)
    assert "script" not in {tag for tag, _ in page.tags}
    assert page.row(HOSTILE)[0] == HOSTILE
    assert page.text.count(HOSTILE) == 6  # alone, three doors, two differences


def test_whatever_is_missing_is_named_with_the_command_that_makes_it(tmp_path):
    page = report(tmp_path / "nowhere")
    for name in ("door_protocol.csv", "door_interference.csv", "ablation.csv", *PICTURES):
        assert f"There is no {tmp_path / 'nowhere' / name}." in page.text
    for command in ("protocol", "hidden", "lyapunov", "foresight", "report"):
        assert f"ufrnn {command} --" in page.text
    assert not page.attributes("img")
    assert not page.attributes("video")


HEADER = "model,train_seed,epoch,kind,trials,opened_150,opened_300,first_try_wrong,recovered\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("door_protocol.csv", b"model,kind\n", "first line must be model,"),
        ("door_protocol.csv", b"\xff\xfe\x00", "door_protocol.csv is not a text file"),
        ("door_protocol.csv", HEADER.encode(), "has no rows"),
        ("door_protocol.csv", f"{HEADER}ufrnn,0,1,pull,ten,3,5,6,2\n".encode(), "line 2 is no row"),
        ("door_protocol.csv", f"{HEADER}ufrnn,0,1,pull,0,0,0,0,0\n".encode(), "line 2 counts 0 trials"),
        ("door_protocol.csv", f"{HEADER}ufrnn,0,1,pull,9,3,10,6,2\n".encode(), "'opened in 30 s' would be 10 of 9"),
        ("ablation.csv", f"{HEADER}ufrnn,0,1,pull,9,3,5,6,7\n".encode(), "'recovered from a wrong guess' would be 7"),
        ("ablation.csv", HEADER.encode() + b"ufrnn,0,1,pull,9,3,5,6,2\n" * 2, "line 3 repeats"),
        ("door_interference.csv", HEADER.encode(), "first line must be model,train_seed,epoch,kind,trials,held"),
        ("hidden.png", b"", "hidden.png is not a PNG picture"),
    ],
)
def test_a_broken_file_ends_with_a_message_and_leaves_the_last_page(results, name, content, message, capsys):
    output = results.parent / "report.html"
    output.write_text("the last page")
    (results / name).write_bytes(content)
    assert main(["report", f"--results_dir={results}", f"--output={output}"]) == 1
    assert message in capsys.readouterr().err
    assert output.read_text() == "the last page"


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--kinds=[push,lift]", "--kinds must be one or more of"),
        ("--trials_per_kind=0", "--trials_per_kind must be at least 1"),
        ("--dataset_dir=/nowhere", "there is no folder '/nowhere'"),
        ("--policy_path=/nowhere", "/nowhere"),
    ],
)
def test_a_bad_flag_ends_with_a_message(results, flag, message, capsys):
    assert main(["report", f"--results_dir={results}", f"--output={results / 'report.html'}", flag]) == 1
    assert message in capsys.readouterr().err


# ── Trials ────────────────────────────────────────────────────────────


def test_without_a_recovery_the_page_says_so(results, door_policy):
    page = report(results, *film_flags(door_policy, "push"))
    assert not page.attributes("video")
    assert "No recovery with a push door in 2 trials (seeds 2000 to 2001): 0 opened" in page.text
    assert "A trial with a push door (tried: nothing): what candidates imagined in the 2 s before" in page.text


@pytest.mark.parametrize(
    ("attempts", "success", "recovered"),
    [([], False, False), (["pull"], True, False), (["push", "pull"], True, True), (["push", "pull"], False, False)],
)
def test_a_recovery_opens_a_door_after_a_wrong_try(attempts, success, recovered):
    tries = [Attempt(step, way) for step, way in enumerate(attempts)]
    assert TrialHistory("pull", (), attempts=tries, success=success).recovered is recovered


def test_a_video_tells_what_was_tried_from_then_on():
    history = TrialHistory("pull", (), attempts=[Attempt(3, "push")], states=[None] * 8, success=True)
    frames = [np.full((64, 96, 3), 100, dtype=np.uint8)] * 9
    annotated = annotate(frames, history)
    assert {frame.shape for frame in annotated} == {(64 + BAR_HEIGHT, 96, 3)}
    second_lines = [frame[BAR_HEIGHT // 2 : BAR_HEIGHT] for frame in annotated]
    changes = [number for number in range(1, 9) if (second_lines[number] != second_lines[number - 1]).any()]
    assert changes == [4]  # the picture after step 3
    assert all((frame[BAR_HEIGHT:] == 100).all() for frame in annotated)
    with av.open(BytesIO(encode(annotated))) as container:
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(decoded) == 9
    assert np.abs(decoded[-1].astype(int) - annotated[-1]).mean() < 6


@pytest.mark.parametrize("length", [STEPS, 30])
@pytest.mark.parametrize("refuted", [None, np.linspace(0, 1, 9)])
def test_a_strip_is_drawn_also_where_the_trial_ends_before_the_horizon(length, refuted, tmp_path):
    policy = untrained(3, 32, horizon=10, num_samples=9)
    history = TrialHistory("pull", ("a", "b", "c"))
    for step in range(length):
        policy.select_action(observation(1))
        history.states.append(policy.memory.state)
        history.images.append(np.full((32, 32, 3), 90, dtype=np.uint8))
        futures = Prediction(*(values[:, :, 0] for values in policy.last_trace.imagined))
        history.imaginations.append(Imagination(step, 2, futures, int(policy.last_trace.chosen[0]), refuted))
    draw_strip(policy, history, tmp_path / "strip.png")
    assert cv2.imread(str(tmp_path / "strip.png")) is not None


# ── In a browser ──────────────────────────────────────────────────────

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
PROBE = """<script>
addEventListener("load", () => {
  const all = (name) => [...document.querySelectorAll(name)];
  document.body.dataset.seen = JSON.stringify({
    images: all("img").map((image) => image.naturalWidth),
    videos: all("video").map((video) => [video.readyState, video.videoWidth, video.duration]),
    targets: all("nav a").filter((link) => !document.querySelector(link.hash)).length,
    overflow: document.documentElement.scrollWidth - innerWidth,
    background: getComputedStyle(document.body).backgroundColor,
  });
});
</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed (Debian: apt-get install chromium)")
@pytest.mark.parametrize(("width", "scheme"), [(1200, "light"), (390, "dark")])
def test_a_browser_shows_the_page(results, door_policy, recoveries, width, scheme, tmp_path):
    report(results, *film_flags(door_policy, "pull"))
    text = (tmp_path / "pages" / "report.html").read_text()
    # The policy that forbids the page all but what is in it stays, but for the probe.
    text = text.replace("default-src 'none';", "default-src 'none'; script-src 'unsafe-inline';", 1)
    (tmp_path / "probed.html").write_text(text.replace("</body>", PROBE))
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={tmp_path / 'browser'}",
        f"--window-size={width},900",
        f"--blink-settings=preferredColorScheme={0 if scheme == 'dark' else 1}",
        "--dump-dom",
        (tmp_path / "probed.html").as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    (body,) = Page(done.stdout).attributes("body")
    seen = json.loads(body["data-seen"])
    assert len(seen["images"]) == len(PICTURES) + 2
    assert all(seen["images"])
    ((ready, video_width, seconds),) = seen["videos"]
    assert ready >= 2  # it has decoded a frame
    assert (video_width, seconds) == (384, pytest.approx((STEPS + 1) / 10))
    assert seen["targets"] == 0
    assert seen["overflow"] <= 0
    assert seen["background"] == ("rgb(20, 23, 26)" if scheme == "dark" else "rgb(255, 255, 255)")
