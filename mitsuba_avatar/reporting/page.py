"""One HTML file that shows a run: video, comparison, tables, curves, previews, settings. Everything is embedded; it loads nothing.

The page forbids itself any connection by its content security policy, so that it can be mailed, archived and opened anywhere.
"""

import base64
import html
import mimetypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mitsuba_avatar.files import atomic_path

_POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
_STYLE = """
body { margin: 0 auto; max-width: 1180px; padding: 1.5rem; font: 15px/1.5 system-ui, sans-serif; color: #1c1e21; background: #fff; }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.1rem; margin: 2rem 0 .6rem; border-bottom: 1px solid #ddd; padding-bottom: .2rem; }
.facts { color: #555; } .scroll { overflow-x: auto; }
.numbers { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1rem 0; }
.numbers div { background: #f3f5f8; border-radius: 6px; padding: .5rem .9rem; } .numbers b { display: block; font-size: 1.3rem; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .7rem; text-align: right; }
th { border-bottom: 1.5px solid #333; } tr.first td { border-top: 1px solid #ddd; } .names { text-align: left; }
img, video { max-width: 100%; height: auto; border-radius: 4px; } figure { margin: 0 0 1rem; } figcaption { color: #555; font-size: 13px; }
.media { display: flex; flex-wrap: wrap; gap: 1rem; } img.drawing { width: 560px; }
.changed td { background: #fff6da; } summary { cursor: pointer; }
"""


@dataclass(frozen=True)
class Figure:
    """A picture or video of a page: a file and what it shows."""

    path: Path
    caption: str


@dataclass(frozen=True)
class Section:
    """A part of a page.

    Attributes:
        title: heading.
        figures: pictures and videos, in order.
        tables: caption -> headings and rows of cells; the first `text_columns` are set left.
        is_folded: shown only when opened.
    """

    title: str
    figures: Sequence[Figure] = ()
    tables: Mapping[str, tuple[Sequence[str], Sequence[Sequence[str]]]] | None = None
    text_columns: int = 3
    is_folded: bool = False


def write_page(path: Path, title: str, facts: Sequence[str], numbers: Mapping[str, str], sections: Sequence[Section]) -> None:
    """Write the page, whole or not at all.

    Args:
        path: file to write, ending in `.html`.
        title: of the run.
        facts: lines below the title.
        numbers: what stands out -> label and value.
        sections: in order; empty ones are left out.

    Raises:
        FileNotFoundError: a figure's file is not there.
    """
    boxes = "".join(f"<div><b>{html.escape(value)}</b>{html.escape(label)}</div>" for label, value in numbers.items())
    parts = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head><body>',
        f"<h1>{html.escape(title)}</h1>",
        *(f'<div class="facts">{html.escape(fact)}</div>' for fact in facts),
        f'<div class="numbers">{boxes}</div>' if boxes else "",
        *(_section(section) for section in sections if section.figures or section.tables),
        "</body></html>\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(part for part in parts if part), encoding="utf-8")


def _section(section: Section) -> str:
    body = [f'<div class="media">{"".join(_figure(figure) for figure in section.figures)}</div>'] if section.figures else []
    body += [_table(caption, *cells, section.text_columns) for caption, cells in (section.tables or {}).items()]
    content = "\n".join(body)
    if section.is_folded:
        return f"<h2>{html.escape(section.title)}</h2>\n<details><summary>show</summary>\n{content}\n</details>"
    return f"<h2>{html.escape(section.title)}</h2>\n{content}"


def _figure(figure: Figure) -> str:
    if not figure.path.is_file():
        raise FileNotFoundError(f"write_page(): expected a figure at {figure.path}; there is none. Draw it first.")
    kind = mimetypes.guess_type(figure.path.name)[0] or "application/octet-stream"
    source = f"data:{kind};base64,{base64.b64encode(figure.path.read_bytes()).decode()}"
    caption = html.escape(figure.caption)
    if kind.startswith("video/"):
        media = f'<video controls loop muted autoplay playsinline src="{source}"></video>'
    else:
        drawing = ' class="drawing"' if kind == "image/svg+xml" else ""
        media = f'<img{drawing} alt="{caption}" src="{source}">'
    return f"<figure>{media}<figcaption>{caption}</figcaption></figure>"


def _table(caption: str, headings: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int) -> str:
    """A table; a rule is drawn where a text column but the last changes, and a row with a further cell `*` is marked."""

    def cells(kind: str, values: Sequence[str]) -> str:
        return "".join(
            f"<{kind}{' class=names' if column < text_columns else ''}>{html.escape(value)}</{kind}>" for column, value in enumerate(values)
        )

    lines, previous = [], None
    for row in rows:
        is_marked = bool(row) and row[-1] == "*"
        shown = row[: len(headings)]
        classes = [name for name, holds in (("first", previous not in (None, row[: text_columns - 1])), ("changed", is_marked)) if holds]
        lines.append(f'<tr class="{" ".join(classes)}">{cells("td", shown)}</tr>')
        previous = row[: text_columns - 1]
    title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    return f'<div class="scroll"><table>{title}<thead><tr>{cells("th", headings)}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'
