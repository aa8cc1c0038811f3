"""The extension of Sphinx for this site: docstrings, links from code to the API, MathML."""

import inspect
import pkgutil
import re
import types
import typing
from typing import Any

import docstrings
from api_names import public_names
from api_pages import ApiPages
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform
from sphinx.util import logging
from sphinx.util.inspect import stringify_signature
from sphinx.writers.html5 import HTML5Translator

LOGGER = logging.getLogger(__name__)
_ACCENTED = re.compile(r"\\(hat|bar|tilde|dot)(\{[^{}]*\}| ?[A-Za-z])(?=_)")


def target_of(code: str) -> str | None:
    """The full name of what a piece of code names, `Merge` say, or `mpfjax.Merge(2.0)`."""
    found = re.fullmatch(r"([A-Za-z_][\w.]*)(\(.*\))?", code, re.DOTALL)
    if found is None:
        return None
    name, names = found[1], public_names()
    if name in names:
        return names[name]
    owner, _, member = name.rpartition(".")
    if owner in names and member and not member.startswith("_"):
        holder = names[owner]
        kind = pkgutil.resolve_name(holder)
        if member in getattr(kind, "__dataclass_fields__", ()):
            return holder  # in whose text fields are
        if member in vars(kind):
            return f"{holder}.{member}"
    return None


class LinkCode(SphinxTransform):
    """Code that names something public becomes a link to the API, which is checked."""

    default_priority = 210

    def apply(self, **options: Any) -> None:
        """Wrap each such piece of code in a reference; a wrong name of ours is a warning."""
        for literal in list(self.document.findall(nodes.literal)):
            inside = (nodes.reference, addnodes.pending_xref, addnodes.desc_signature, nodes.title)
            if any(isinstance(each, inside) for each in _ancestors(literal)):
                continue
            code = literal.astext()
            target = target_of(code)
            if target is None:
                if re.fullmatch(r"mpfjax(\.\w+)*\.[A-Z]?\w*(\(.*\))?", code) and not _exists(code):
                    LOGGER.warning("mpfjax has no %s", code, location=literal)
                continue
            reference = addnodes.pending_xref(
                "", refdomain="py", reftype="obj", reftarget=target, refexplicit=True, refwarn=True,
                refdoc=self.env.docname,
            )  # fmt: skip
            literal.replace_self(reference)
            reference += literal


def _ancestors(node: nodes.Node) -> list[nodes.Node]:
    found = []
    while (node := node.parent) is not None:
        found.append(node)
    return found


def _exists(code: str) -> bool:
    """Whether a dotted name is a module, or can be reached from one."""
    try:
        pkgutil.resolve_name(re.sub(r"\(.*", "", code, flags=re.DOTALL))
    except (ImportError, AttributeError):
        return False
    return True


def process_docstring(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Every docstring as reStructuredText."""
    lines[:] = docstrings.to_rst(lines)


def forget_rules(app: Sphinx, obj: Any, bound_method: bool) -> None:
    """Types alone are shown, without the rules that `mpfjax.checks` finds beside them."""
    function = getattr(obj, "__func__", obj)  # of a method of the class
    if isinstance(function, types.FunctionType):
        hints = typing.get_type_hints(function)
        function.__annotations__ = inspect.unwrap(function).__annotations__ = hints


def process_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str | None, str | None]:
    """Signatures in words that Python reads, and `Array` without the private name of its module."""
    if signature and hasattr(obj, "__signature__"):  # a class of equinox, which had no event
        forget_rules(app, obj.__init__, True)
        signature = stringify_signature(
            obj.__signature__, show_return_annotation=False, unqualified_typehints=True
        )
    shown = []
    for part in (signature, returns):
        part = part and re.sub(r"\bjaxlib\._jax\.", "", part)
        shown.append(part and re.sub(r"<(?:function )?(\w+)[^<>]*>", r"\1", part))
    return shown[0], shown[1]


def shorten_types(app: Sphinx, doctree: nodes.document) -> None:
    """The same in the types of properties, which are no signatures."""
    for text in list(doctree.findall(nodes.Text)):
        if "jaxlib._jax." in text:
            text.parent.replace(text, nodes.Text(text.replace("jaxlib._jax.", "")))


def _mathml(self: HTML5Translator, node: nodes.Element, as_block: bool) -> None:
    # docutils would write the index of a letter with an accent below the letter.
    formula = _ACCENTED.sub(r"\g<0>{}", node.astext())
    try:
        self.body.append(tex2mathml(formula, as_block=as_block))
    except Exception as error:
        LOGGER.warning("no MathML of %r: %s", node.astext(), error, location=node)
    raise nodes.SkipNode


def keep_marks(app: Sphinx, doctree: nodes.document) -> None:
    """A formula within a line keeps the comma after it, which browsers would let begin a line."""
    for formula in doctree.findall(nodes.math):
        text = formula.next_node(descend=False, siblings=True)
        if isinstance(text, nodes.Text) and (found := re.match("[,.;:)]+", text)):
            formula["mark"] = found[0]
            text.parent.replace(text, nodes.Text(text[found.end() :]))


def visit_math(self: HTML5Translator, node: nodes.Element) -> None:
    """A formula within a line."""
    self.body.append('<span class="formula">')
    try:
        _mathml(self, node, as_block=False)
    except nodes.SkipNode:
        self.body.append(node.get("mark", "") + "</span>")
        raise


def visit_math_block(self: HTML5Translator, node: nodes.Element) -> None:
    """A formula on a line of its own, which scrolls where it is too wide."""
    self.body.append(self.starttag(node, "div", CLASS="math"))
    try:
        _mathml(self, node, as_block=True)
    except nodes.SkipNode:
        self.body.append("</div>\n")
        raise


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    app.add_transform(LinkCode)
    app.add_directive("api-pages", ApiPages)
    app.connect("autodoc-process-docstring", process_docstring)
    app.connect("autodoc-before-process-signature", forget_rules)
    app.connect("autodoc-process-signature", process_signature)
    app.connect("doctree-read", shorten_types)
    app.connect("doctree-read", keep_marks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
