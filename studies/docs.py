"""Write the result blocks of README.md and docs/*.md from docs/results/NAME.json: python -m studies.docs [--check].

A block lies between `<!-- results:NAME -->` and `<!-- /results:NAME -->`; studies/blocks.py lists the names.
"""

import argparse
import re
import sys
from pathlib import Path

from studies.blocks import BLOCKS

MARKER = re.compile(r"<!-- (?P<end>/?)results:(?P<name>[\w-]+) -->")


def update_results_blocks(root: Path, check: bool) -> list[Path]:
    """Rewrite every block from its committed results, and return the changed files.

    With `check` nothing is written, and the list names the outdated files. ValueError for a block that is not closed or
    is not in studies/blocks.py.
    """
    changed = []
    for path in [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").glob("*.md"))]:
        if not path.exists():
            continue
        old = path.read_text(encoding="utf-8")
        new = _with_blocks(old, path, root / "docs" / "results")
        if new != old:
            changed.append(path)
            if not check:
                path.write_text(new, encoding="utf-8")
    return changed


def block_text(name: str, results: Path) -> str:
    """Markdown of the block NAME; the command that measures it while its figures are missing."""
    block = BLOCKS[name]
    known = block.results(results)
    if block.section not in known:
        return f"Not measured yet; `python -m {block.module}` measures it."
    return block.text(known)


def _with_blocks(text: str, path: Path, results: Path) -> str:
    parts, position = [], 0
    markers = list(MARKER.finditer(text))
    for start, stop in zip(markers[::2], [*markers[1::2], None], strict=False):
        name = start["name"]
        if start["end"] or stop is None or not stop["end"] or stop["name"] != name:
            raise ValueError(f"{path}: expected <!-- results:{name} --> ... <!-- /results:{name} -->; close each block")
        if name not in BLOCKS:
            raise ValueError(f"{path}: there is no block results:{name}; expected one of {', '.join(BLOCKS)}")
        parts += [text[position : start.end()], "\n\n", block_text(name, results), "\n\n"]
        position = stop.start()
    return "".join([*parts, text[position:]])


def main() -> int:
    """Update the blocks, or with --check only name the files that are out of date; the status says whether any is."""
    parser = argparse.ArgumentParser(prog="python -m studies.docs", description=(__doc__ or "").split(":")[0])
    parser.add_argument("--check", action="store_true", help="change nothing; fail if a table is out of date")
    check = parser.parse_args().check
    changed = update_results_blocks(Path(__file__).resolve().parents[1], check)
    for path in changed:
        print(f"{path}: {'out of date; run `python -m studies.docs`' if check else 'updated'}")
    return 1 if changed and check else 0


if __name__ == "__main__":
    sys.exit(main())
