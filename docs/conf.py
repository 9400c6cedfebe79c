"""The documentation site, built by Sphinx from the Markdown beside this file and from the docstrings."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import inspect

project = "ls3-torchrl"
author = "The ls3-torchrl developers"
copyright = f"2026, {author}"
release = version = version_of(project)
HERE = Path(__file__).parent
REPOSITORY = f"https://github.com/{project}/{project}"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
templates_path = ["_templates"]

# What a docstring or a page refers to must be there. Not known are other projects' names, whose inventories would have
# to be downloaded, and those of this project's bases and types that are not public: they are shown as they are.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:class", r"(?!ls3_).*"),
    (r"py:(obj|exc|data|func)", r"(?!ls3_|[A-Z]\w*$).*"),
    (
        r"py:class",
        r"ls3_\w+\.\w+\.(\w+\.)?"
        r"(RowStore|HeadLoss|LaggedTargetLoss|Imagination|Deadline|Bar)",
    ),
]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autosummary_ignore_module_all = False
autosummary_imported_members = True
autodoc_default_options = {"members": True, "private-members": "_AcceptedKeys", "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "ls3-torchrl"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"source_repository": REPOSITORY, "source_branch": "main", "source_directory": "docs/"}
html_show_sourcelink = False


def public_package(path: Path, name: str) -> str:
    """The package that what is defined in a file is imported from: the one the file is in, or the one above."""
    parts = [part for part in path.with_suffix("").parts if part != "envs"][:-1]
    return next(
        package
        for package in (".".join(parts[:depth]) for depth in range(1, len(parts) + 1))
        if hasattr(import_module(package), name)
    )


def adapt_links(app: Any, name: str, source: list[str]) -> None:
    """Links as GitHub shows them, in Markdown, made links of this site.

    A name that is linked to its source file leads to its page here, any other file of the repository to GitHub, and
    a page that is called by its file's name is called by its title.
    """
    here = Path(app.env.doc2path(name)).parent

    def adapt(link: re.Match[str]) -> str:
        text, target = link.groups()
        outside = (here / target).resolve()
        if outside.is_relative_to(HERE):
            return f"[]({target})" if re.fullmatch(r"[\w/]+\.md", text) else link[0]
        path = outside.relative_to(HERE.parent)
        if path.name == "card.md":
            return f"[{text}](/agents/{path.parent.name}.md)"
        if path.suffix == ".py" and re.fullmatch(r"`[A-Z]\w+`", text):
            return f"{{py:obj}}`~{public_package(path, text[1:-1])}.{text[1:-1]}`"
        return f"[{text}]({REPOSITORY}/blob/main/{path})"

    source[0] = re.sub(r"\[([^\]]*)\]\((?!https?:|#)([^)#]+)\)", adapt, source[0])


def keep_letters(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """An argument that is described by one letter, as ``horizon: H.``, is no beginning of a list."""
    lines[:] = [re.sub(r"^(\s+\w+: )([A-Z])\.$", r"\1\2\\.", line) for line in lines]


def own_signature(app: Any, what: str, name: str, obj: Any, options: Any, signature: str, returns: str) -> Any:
    """The arguments of a class's ``__init__``, which TorchRL's metaclasses hide."""
    if what != "class" or signature != "(*args, **kwargs)":
        return None
    without_self = inspect.signature(obj.__init__, bound_method=True)
    return inspect.stringify_signature(without_self, show_annotation=False, show_return_annotation=False), returns


def no_return_type(app: Any, domain: str, kind: str, content: nodes.Element) -> None:
    """A class has no return type; that of its ``__init__`` would stand there."""
    if kind == "class":
        for field in [*content.findall(nodes.field)]:
            if field[0].astext() == "rtype":
                field.parent.remove(field)


def visit_math(translator: Any, node: nodes.math) -> None:
    """An equation within a line, as MathML: every browser draws it, without a script from elsewhere."""
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def visit_displayed_math(translator: Any, node: nodes.math_block) -> None:
    """An equation on lines of its own."""
    translator.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", adapt_links)
    app.connect("autodoc-process-docstring", keep_letters, priority=400)  # before Napoleon makes lists of arguments
    app.connect("autodoc-process-signature", own_signature)
    app.connect("object-description-transform", no_return_type, priority=600)  # behind autodoc's own
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displayed_math, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
