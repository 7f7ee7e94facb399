"""The page: one file, everything inside, nothing from elsewhere, nothing unescaped."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from mitsuba_avatar.reporting.figures import save_image
from mitsuba_avatar.reporting.page import Figure, Section, write_page
from mitsuba_avatar.reporting.video import write_video


class Tags(HTMLParser):
    """Counts tags, collects sources, and checks that every tag is closed."""

    def __init__(self, text: str):
        super().__init__()
        self.counts, self.sources, self.open, self.text = {}, [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.sources += [value for name, value in attributes if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def page(tmp_path):
    save_image(tmp_path / "a.png", np.zeros((4, 6, 3), np.uint8))
    write_video(tmp_path / "b.mp4", [np.zeros((16, 16, 3), np.uint8)] * 2, 10.0)
    cells = (["split", "method", "PSNR"], [["test", "a<b", "1.0"], ["test", "c&d", "2.0", "*"]])
    sections = [
        Section("Pictures <1>", [Figure(tmp_path / "a.png", 'a "picture"'), Figure(tmp_path / "b.mp4", "a video")]),
        Section("Numbers", tables={"caption": cells}, text_columns=2, is_folded=True),
        Section("Nothing"),
    ]
    write_page(tmp_path / "page.html", "Run & more", ["a fact"], {"PSNR": "27.1"}, sections)
    return tmp_path / "page.html"


def test_everything_is_inside_and_closed(page):
    tags = Tags(page.read_text())
    assert tags.open == [] and tags.counts["img"] == 1 and tags.counts["video"] == 1 and tags.counts["table"] == 1
    assert all(source.startswith("data:") for source in tags.sources)
    assert "http://" not in page.read_text() and "https://" not in page.read_text() and "script" not in tags.counts
    assert "default-src 'none'" in page.read_text()
    assert re.search(r'src="data:video/mp4;base64,[A-Za-z0-9+/]{100,}', page.read_text())


def test_text_is_escaped_and_shown(page):
    text = Tags(page.read_text()).text
    for shown in ("Run & more", "a fact", "27.1", "Pictures <1>", "a<b", "c&d"):
        assert shown in text
    assert "Nothing" not in text, "an empty section has no heading"
    assert '<tr class="changed">' in page.read_text() and ">*<" not in page.read_text()


def test_a_missing_figure_is_refused_and_leaves_no_page(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a figure at"):
        write_page(tmp_path / "page.html", "t", [], {}, [Section("s", [Figure(tmp_path / "gone.png", "c")])])
    assert not (tmp_path / "page.html").exists()
