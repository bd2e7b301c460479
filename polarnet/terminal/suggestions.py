"""Suggestions for words that are mistyped."""

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The end of a message about an unknown word: the closest known one, or nothing if none is close.

    >>> from polarnet.terminal.suggestions import did_you_mean
    >>> did_you_mean("recovr", ["inspect", "recover"])
    "; did you mean 'recover'?"
    """
    return "".join(f"; did you mean {close!r}?" for close in difflib.get_close_matches(word, list(known), n=1))
