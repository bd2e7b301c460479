"""Extras of pyproject.toml: packages that polarnet needs for some tasks only."""


def installation(extra: str) -> str:
    """Advice for an error about a missing package; polarnet is on no package index, so it names the clone."""
    return f"run pip install -e '.[{extra}]' in the clone"
