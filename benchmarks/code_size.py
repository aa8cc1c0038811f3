"""How large the library is: public names, the most arguments of a call, lines of code.

    python -m benchmarks.code_size [CHECKOUT ...]

reads the source of one checkout or several, without importing it, and prints a table. Lines of code
of the library, the tests and the benchmarks are those beside docstrings, comments and blank ones. A
public name is one that `mpfjax`, or one of its public modules, exports. Arguments of a class are
its fields, unless it has an `__init__`.
"""

import ast
from pathlib import Path

from benchmarks.harness import ROOT, Folders, command, table

MODULES = ("", "exact", "metrics", "plotting", "smoothing", "tuning", "vision")


@command()
def main(checkouts: Folders = (ROOT,)) -> None:
    """A line for each checkout."""
    rows = []
    for checkout in checkouts:
        package = checkout / "mpfjax"
        if not package.is_dir():
            raise FileNotFoundError(f"CHECKOUT: {checkout} holds no mpfjax")
        trees = {path: ast.parse(path.read_text("utf-8")) for path in sorted(package.rglob("*.py"))}
        names = public_names(package, trees)
        name, most = most_arguments(trees, names)
        rows.append({
            "checkout": checkout, "files": len(trees),
            **{folder: lines_in(checkout / folder) for folder in ("mpfjax", "tests", "benchmarks")},
            "public names": len(names), "most arguments of a call": f"{most} ({name})",
        })  # fmt: skip
    print(table(None, rows))


def lines_in(folder: Path) -> int:
    """Lines of code of all files in a folder."""
    texts = (path.read_text(encoding="utf-8") for path in folder.rglob("*.py"))
    return sum(lines_of_code(text, ast.parse(text)) for text in texts)


def lines_of_code(text: str, tree: ast.Module) -> int:
    """Lines that are neither blank, nor a comment, nor in a docstring."""
    docstring_lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and node.body:
            first = node.body[0]
            if ast.get_docstring(node) is not None:
                docstring_lines |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    lines = enumerate(text.splitlines(), 1)
    return sum(
        bool(line.strip()) and not line.strip().startswith("#") and number not in docstring_lines
        for number, line in lines
    )


def public_names(package: Path, trees: dict[Path, ast.Module]) -> set[str]:
    """What the public modules import under a name of their own, or define."""
    names: set[str] = set()
    for module in MODULES:
        for path in (package / module / "__init__.py", package / f"{module}.py"):
            for node in trees[path].body if path in trees else ():
                if isinstance(node, ast.ImportFrom):
                    names |= {alias.asname or "_" for alias in node.names}
                elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                    names.add(node.name)
    return {name for name in names if not name.startswith("_")} - set(MODULES)


def most_arguments(trees: dict[Path, ast.Module], names: set[str]) -> tuple[str, int]:
    """The public function or class that takes the most, and how many."""
    counts = {
        node.name: num_arguments(node)
        for tree in trees.values()
        for node in tree.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name in names
    }
    name = max(counts, key=lambda name: counts[name])
    return name, counts[name]


def num_arguments(node: ast.FunctionDef | ast.ClassDef) -> int:
    """Of a function, or of the making of an object; `self` does not count."""
    if isinstance(node, ast.FunctionDef):
        return len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
    for inner in node.body:
        if isinstance(inner, ast.FunctionDef) and inner.name == "__init__":
            return num_arguments(inner) - 1
    return sum(isinstance(inner, ast.AnnAssign) for inner in node.body)


if __name__ == "__main__":
    raise SystemExit(main())
