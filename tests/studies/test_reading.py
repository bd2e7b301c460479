from studies.house import ROOT, tracked_texts
from studies.reading import MAX_WORDS, figures, paragraphs, prose, sentences

PAGE = """# A heading

First sentence of two. `--rate` starts the second, see [Fig. 3](a.md)!

- an item

| a table | is not |
|---|---|
| read | at all. |

```bash
neither is code
```

<!-- results:x -->

Nor what a command wrote.

<!-- /results:x -->
"""


def test_pages_are_read_by_sentence_without_tables_code_and_generated_parts():
    texts = [sentence for paragraph in paragraphs(PAGE) for sentence in sentences(paragraph)]
    assert texts == ["A heading", "First sentence of two.", "`code` starts the second, see Fig. 3!", "an item"]


def test_docstrings_count_and_other_strings_do_not():
    module = '"""One two three."""\nX = "no sentence"\n\ndef f():\n    """Four five."""\n    return "not this"\n'
    found_words = [sentence.words for sentence in prose({"polarnet/a.py": module, "tests/b.py": module})]
    assert found_words == [3, 2]


def test_the_text_of_polarnet_reads_easily():
    texts = dict(tracked_texts(ROOT))
    measured = figures(texts)
    assert [sentence for sentence in prose(texts) if sentence.words > MAX_WORDS] == []
    assert measured["median_sentence_words"] <= 18
    assert measured["retired_words"] == 0
