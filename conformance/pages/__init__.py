"""Pages: templates on one base. Whatever comes into a template is escaped, and a name that is not given is an error."""

import base64
import functools
import hashlib
import re

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from conformance.pages import tex

_INLINE = re.compile(r"`(?P<code>[^`]+)`|\*\*(?P<b>[^*]+)\*\*|(?<!\w)\*(?P<i>[^*\s](?:[^*]*[^*\s])?)\*(?!\w)")


def render(package: str, template: str, /, **values: object) -> str:
    """A template of a package, from its folder `templates`, with these values.

    At hand is base.html, which a page extends.

    Raises:
      jinja2.UndefinedError: the template has a name that is not among the values.
    """
    return _environment(package).get_template(template).render(values)


@functools.cache
def _environment(package: str) -> Environment:
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader(__name__)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"breakable": breakable, "prose": prose, "sha256": sha256}
    return environment


def prose(text: str) -> Markup:
    """A line of Markdown: code, bold and italics, links as their words, and formulas as plain text."""
    text = tex.plain(text)
    parts, end = [], 0
    for found in _INLINE.finditer(text):
        tag = found.lastgroup or ""
        parts += [text[end : found.start()], Markup("<{0}>{1}</{0}>").format(tag, found[tag])]
        end = found.end()
    return Markup("").join([*parts, text[end:]])


def breakable(name: str) -> Markup:
    """A name that may go on in a new line after a slash or an underscore."""
    return Markup("<wbr>").join(re.split("(?<=[/_])", name))


def sha256(script: str) -> str:
    """A script as a content security policy names it."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}"
