"""The description that package indexes show: README.md, with links that lead somewhere from there, too."""

import re
from pathlib import Path

from setuptools import setup

PROJECT = "ls3-torchrl/ls3-torchrl"


def absolute(link: re.Match) -> str:
    """A link to a file of this repository as one to the file on GitHub; to a picture, as one to the picture."""
    picture, text, target = link.groups()
    root = f"https://raw.githubusercontent.com/{PROJECT}/main" if picture else f"https://github.com/{PROJECT}/blob/main"
    return f"{picture}[{text}]({root}/{target})"


readme = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
setup(
    long_description=re.sub(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]+)\)", absolute, readme),
    long_description_content_type="text/markdown",
)
