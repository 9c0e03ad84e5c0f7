"""What a replay came to, as one page that holds everything it shows: it can be sent on, or opened in the console."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from rich.table import Table

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>
body {{ margin: 0 auto; max-width: 72rem; padding: clamp(1rem, 4vw, 2.5rem); font: 1rem/1.5 system-ui, sans-serif;
  background: light-dark(#f4f5f7, #0f1317); color: light-dark(#18212b, #e8edf2); }}
h1 {{ font-size: clamp(1.5rem, 4vw, 2.2rem); line-height: 1.2; margin: 0 0 1.5rem; text-wrap: balance; }}
section, figure {{ background: light-dark(#fff, #181e25); border: 1px solid light-dark(#d9dee4, #2c353f);
  border-radius: 10px; padding: 1rem 1.25rem; margin: 0 0 1.25rem; overflow-x: auto; }}
h2 {{ font-size: 1.05rem; margin: 0 0 .6rem; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
th, td {{ text-align: right; padding: .3rem 1.2rem .3rem 0; border-bottom: 1px solid light-dark(#d9dee4, #2c353f); }}
th:first-child, td:first-child {{ text-align: left; }}
th, p {{ font-weight: 500; color: light-dark(#55606c, #a5b1bd); font-size: .9rem; }}
figure {{ background: #fff; }}
img {{ display: block; max-width: 100%; height: auto; margin: 0 auto; }}
</style>
</head>
<body>
<main>
<h1>{title}</h1>
{parts}
</main>
</body>
</html>
"""


def write_page(folder: Path, title: str, tables: Sequence[Table], pictures: Sequence[Path]) -> Path:
    """Write `index.html`: the tables as the terminal shows them, and PNG files."""
    parts = [*map(_table, tables), *map(_picture, pictures)]
    path = folder / "index.html"
    path.write_text(_PAGE.format(title=escape(title), parts="\n".join(parts)), encoding="utf-8")
    return path


def _table(table: Table) -> str:
    head = _row("th scope=col", (str(column.header) for column in table.columns))
    rows = [_row("td", map(str, cells)) for cells in zip(*(column.cells for column in table.columns), strict=True)]
    body = f"<table>\n<thead>{head}</thead>\n<tbody>{''.join(rows)}</tbody>\n</table>"
    caption = "" if table.caption is None else f"\n<p>{escape(str(table.caption))}</p>"
    return f"<section tabindex=0>\n<h2>{escape(str(table.title))}</h2>\n{body}{caption}\n</section>"


def _row(cell: str, texts: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<{cell}>{escape(text)}</{cell.split(maxsplit=1)[0]}>' for text in texts)}</tr>"


def _picture(path: Path) -> str:
    uri = f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"
    return f'<figure><img src="{uri}" alt="{path.stem.replace("_", " ")}"></figure>'
