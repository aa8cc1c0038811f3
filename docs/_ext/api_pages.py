"""The index of the API: the pages of entries, and each entry with what it is in one line."""

import inspect
import pkgutil
import re
from pathlib import Path

import docstrings
from docutils import nodes
from sphinx.util.docutils import SphinxDirective

ENTRY = re.compile(r"^\.\. (?:auto\w+|py:data):: (\S+)$(?:\n\n   (.*(?:\n   .*)*))?", re.MULTILINE)


class ApiPages(SphinxDirective):
    """Links to the pages that it names, under each of them a table of its entries.

    Without a page it is the table of the page that it stands on.
    """

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Written as reStructuredText, which is then parsed."""
        if not self.content:
            return self.parse_text_to_nodes("\n".join(self._table(self.env.docname)))
        folder = self.env.docname.rpartition("/")[0]
        lines = [".. toctree::", "   :hidden:", "", *(f"   {page}" for page in self.content)]
        for page in self.content:
            lines += ["", f".. rubric:: :doc:`{page}`", "", *self._table(f"{folder}/{page}")]
        return self.parse_text_to_nodes("\n".join(lines))

    def _table(self, page: str) -> list[str]:
        path = Path(self.env.doc2path(page))
        self.env.note_dependency(str(path))
        lines = [".. list-table::", "   :widths: 3 7", ""]
        for name, told in ENTRY.findall(path.read_text(encoding="utf-8")):
            summary = " ".join(told.split()).partition(". ")[0] if told else summary_of(name)
            lines += [f"   * - :py:obj:`~{name}`", f"     - {summary}"]
        return lines


def summary_of(name: str) -> str:
    """The first paragraph of a docstring."""
    text = inspect.getdoc(pkgutil.resolve_name(name)) or ""
    return " ".join(" ".join(docstrings.to_rst(text.partition("\n\n")[0].split("\n"))).split())
