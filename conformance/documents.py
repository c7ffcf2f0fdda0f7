"""The pages that messages name, such as docs/editions.md and spec/07-returns.md: where this installation has them."""

from importlib import metadata, resources
from pathlib import Path


def pages() -> dict[str, Path]:
    """Name of a page, as messages write it -> its file. In a checkout those of its folders; a wheel installs copies."""
    spec = [Path(str(page)) for page in resources.files("spec").iterdir() if page.name.endswith(".md")]
    found = {f"docs/{page.name}": page for page in _docs()} | {f"spec/{page.name}": page for page in spec}
    return dict(sorted(found.items()))


def _docs() -> list[Path]:
    checkout = Path(__file__).resolve().parent.parent
    if (checkout / "pyproject.toml").is_file():
        return list((checkout / "docs").glob("*.md"))
    installed = metadata.files("dreamer-spec") or []  # pyproject.toml: data-files
    return [Path(str(file.locate())).resolve() for file in installed if file.match("share/doc/dreamer-spec/docs/*.md")]
