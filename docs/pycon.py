"""Extension of Griffe for mkdocs.yml: the examples of docstrings (`>>>`) become code on the pages of the site."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"(?<!```pycon\n)^>>> .*(?:\n.+)*", re.MULTILINE)


class Examples(griffe.Extension):
    """Fence the examples in every docstring; Markdown would take them for quotations."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite the docstring of a loaded module, class, function or value."""
        if obj.docstring:
            obj.docstring.value = EXAMPLE.sub(r"```pycon\n\g<0>\n```", obj.docstring.value)
