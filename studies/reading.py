"""Length of the sentences in README, docs and docstrings: python -m studies.reading [--longest N] [--write]

A sentence ends at a full stop, a question mark or the end of its paragraph, list item or heading. Tables, code blocks
and generated parts of pages are left out. A piece of code inside a sentence counts as one word. --write puts the
figures into docs/results/report.json.
"""

import ast
import inspect
import itertools
import json
import re
from collections.abc import Iterator, Mapping
from statistics import median
from typing import Any, NamedTuple

from markdown_it import MarkdownIt

from studies.house import ROOT, retired_uses, total, tracked_texts
from studies.measure import arguments_of, command_line, machine_record, write_section

MAX_WORDS = 40
GENERATED = re.compile(r"<!-- results:.*?<!-- /results:[\w-]+ -->", re.DOTALL)
SENTENCE_END = re.compile(r"(?<=[.!?])[)\"']*\s+(?=[A-Z\"'(`]|polarnet\b|v2e\b)")
EXAMPLE = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)
ABBREVIATION = re.compile(r"\b(?:e\.g|i\.e|vs|Eq|Eqs|Fig|Figs|Sec|Ref|et al|approx|No|resp)\.$")
WORD = re.compile(r"\S*\w\S*")


class Sentence(NamedTuple):
    """A sentence and the file that holds it."""

    path: str
    text: str

    @property
    def words(self) -> int:
        """Number of words."""
        return len(WORD.findall(self.text))


def paragraphs(markdown: str) -> Iterator[str]:
    """Plain text of every paragraph, heading and list item, each piece of code as one word."""
    tokens = MarkdownIt().enable("table").parse(GENERATED.sub("", markdown))
    for before, token in itertools.pairwise(tokens):
        if token.children and before.type not in ("th_open", "td_open"):
            parts = {"text": None, "code_inline": "`code`", "softbreak": " ", "hardbreak": " "}
            words = [parts[one.type] or one.content for one in token.children if one.type in parts]
            yield "".join(words)


def sentences(text: str) -> Iterator[str]:
    """Sentences of a paragraph."""
    start = 0
    for end in SENTENCE_END.finditer(text):
        if not ABBREVIATION.search(text[start : end.start()]):
            yield text[start : end.start()].strip()
            start = end.end()
    if rest := text[start:].strip():
        yield rest


def docstrings(source: str) -> Iterator[str]:
    """Docstrings of a module, its classes and functions, and the strings below its fields."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value


def prose(texts: Mapping[str, str]) -> Iterator[Sentence]:
    """Every sentence of pages (.md) and of the package's docstrings, by path of the file."""
    for path, text in texts.items():
        if path.endswith(".md"):
            written = [text]
        elif path.startswith("polarnet/") and path.endswith(".py"):
            written = [EXAMPLE.sub("", inspect.cleandoc(one)) for one in docstrings(text)]
        else:
            continue
        for one in written:
            for paragraph in paragraphs(one):
                yield from (Sentence(path, sentence) for sentence in sentences(paragraph))


def figures(texts: Mapping[str, str]) -> dict[str, Any]:
    """Median and longest number of words, sentences above `MAX_WORDS`, and uses of retired words."""
    lengths = [sentence.words for sentence in prose(texts)]
    pages = (text for path, text in texts.items() if path.endswith((".md", ".py")))
    return {
        "sentences": len(lengths),
        "median_sentence_words": median(lengths),
        "longest_sentence_words": max(lengths),
        "sentences_too_long": sum(length > MAX_WORDS for length in lengths),
        "retired_words": sum(total(map(retired_uses, pages)).values()),
    }


def main() -> None:
    """Print the figures and the longest sentences, and write the figures if asked."""
    parser = command_line(__doc__, "docs/results/report.json")
    parser.add_argument("--longest", type=int, default=0, metavar="N", help="print the N longest sentences")
    options = arguments_of(parser)
    texts = dict(tracked_texts(ROOT))
    for sentence in sorted(prose(texts), key=lambda one: -one.words)[: options.longest]:
        print(f"{sentence.words:3} {sentence.path}: {sentence.text}")
    measured = figures(texts)
    print(json.dumps(measured, indent=2))
    if options.write:
        print(f"wrote {write_section(ROOT, 'report', 'reading', measured, machine_record(ROOT))}")


if __name__ == "__main__":
    main()
