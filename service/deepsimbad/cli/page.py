"""What the pages that commands write share: one HTML file with everything in it, no script, both colour themes."""

from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def write_html(file: Path, template: str, **values: Any) -> Path:
    """Render a template beside this file."""
    page = Environment(
        loader=PackageLoader("deepsimbad.cli", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    text = page.get_template(template).render(**values)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    return file
