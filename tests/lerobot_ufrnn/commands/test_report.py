from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from env_door.trials import Trial
from lerobot_ufrnn.analysis.results import count_by_door
from lerobot_ufrnn.commands import main
from lerobot_ufrnn.commands.report import PARTS

MEDIA = [name for name in PARTS if not name.endswith(".csv")]


class Page(HTMLParser):
    """What is in a page: each tag with its attributes, the text, and the rows of its tables."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.rows = "", []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag == "tr":
            self.rows.append([])

    def handle_data(self, data):
        self.text += data
        if data.strip() and self.tags[-1][0] in ("td", "th"):
            self.rows[-1].append(data.strip())

    def attributes(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder in which nothing is missing, with a name that would be markup."""
    folder = tmp_path / "<b>results & 'more'"
    (folder / "videos").mkdir(parents=True)
    fields = {"steps": 90, "opening": 1.0, "door_offset": 0.0}
    trials = [Trial(seed, "pull", True, attempts=("push", "pull")[seed:], **fields) for seed in (0, 1)]
    count_by_door(trials).to_csv(folder / "results.csv")
    for name in MEDIA:
        Image.new("RGB", (40, 30)).save(folder / name)
    for name in ("b", "a"):
        (folder / "videos" / f"{name}.mp4").write_bytes(name.encode())
    return folder


def report(folder: Path) -> Page:
    assert main(["report", f"--folder={folder}"]) == 0
    return Page((folder / "report.html").read_text())


def test_the_page_holds_all_that_is_in_the_folder_and_needs_nothing_else(folder):
    page = report(folder)
    assert [b64decode(image["src"].split(",")[1]) for image in page.attributes("img")] == [
        (folder / name).read_bytes() for name in MEDIA
    ]
    assert all(image["src"].startswith("data:image/") and image["alt"] for image in page.attributes("img"))
    assert [b64decode(video["src"].split(",")[1]) for video in page.attributes("video")] == [b"a", b"b"]
    assert not {"script", "link", "iframe", "object", "b"} & {tag for tag, _ in page.tags}
    assert page.text.count(str(folder.name)) >= 1  # hostile names are text
    everything = "2/2 = 100% [34%, 100%]"
    assert ["pull", everything, everything, "1/2 = 50% [9%, 91%]", "1/1 = 100% [21%, 100%]", "0"] in page.rows
    assert "over the trials of one network" in page.text
    assert "There is no" not in page.text


def test_whatever_is_missing_is_named_with_the_command_that_makes_it(tmp_path):
    page = report(tmp_path)
    for name in PARTS:
        assert f"There is no {tmp_path / name};" in page.text
    for command in ("results", "video", "foresight", "hidden", "lyapunov"):
        assert f"ufrnn {command} --" in page.text
    assert not page.attributes("img") + page.attributes("video") + page.attributes("table")


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"kind,trials\npull,ten\n"])
def test_a_broken_file_ends_with_a_message_and_leaves_the_last_page(folder, name, content, capsys):
    (folder / "report.html").write_text("the last page")
    (folder / name).write_bytes(content)
    assert main(["report", f"--folder={folder}"]) == 1
    message = capsys.readouterr().err
    assert str(folder / name) in message
    assert "make it anew or remove it" in message
    assert (folder / "report.html").read_text() == "the last page"


def test_a_folder_that_is_not_there_is_refused(capsys):
    assert main(["report", "--folder=/nowhere"]) == 1
    assert "--folder: there is no folder '/nowhere'" in capsys.readouterr().err
