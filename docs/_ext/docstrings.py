"""Docstrings of mpfjax, which are Markdown with equations in plain text, as reStructuredText.

Equations become formulas, `code` becomes ``code``, and lists get the blank lines that
reStructuredText asks for. What is no equation by the rules below stays text, so that a
docstring never breaks the build.
"""

import re
from collections.abc import Iterator

from docutils.utils.math.latex2mathml import tex2mathml

SUPERSCRIPTS = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻ᵀ", [*"0123456789+-", r"\top"], strict=True))
SYMBOLS = {
    "½": r"\tfrac{1}{2}", "√": r"\surd ", "·": r"\cdot ", "⊥": r"\bot ", "∈": r"\in ", "≤": r"\le ",
    "≥": r"\ge ", "≠": r"\ne ", "∝": r"\propto ", "∞": r"\infty ", "∂": r"\partial ",
    "∇": r"\nabla ", "∩": r"\cap ", "Σ": r"\sum ", "Π": r"\prod ", "ℓ": r"\ell ", "Ẑ": r"\hat{Z}",
    "x̄": r"\bar{x}", "μ̄": r"\bar{\mu}", "Σ̄": r"\bar{\Sigma}", "x̃": r"\tilde{x}", "...": r"\ldots ",
    "α": r"\alpha ", "γ": r"\gamma ", "ε": r"\epsilon ", "θ": r"\theta ", "Θ": r"\Theta ",
    "λ": r"\lambda ", "Λ": r"\Lambda ", "μ": r"\mu ", "π": r"\pi ", "ρ": r"\rho ", "σ": r"\sigma ",
    "τ": r"\tau ", "φ": r"\phi ", "ψ": r"\psi ", "ω": r"\omega ", "<=": r"\le ", ">=": r"\ge ",
    "~": r"\sim ", "|": r"\mid ", "⟨": r"\langle ", "⟩": r"\rangle ",
}  # fmt: skip
FUNCTIONS = {"log", "exp", "min", "max", "det"}
# What no English word holds: such a token is a formula, or part of one.
STRONG = re.compile(r"(?<![A-Z])[A-Za-zα-ωℓ][̄̃]?_[A-Za-z0-9{]|[α-ωΘΛΣΠ²³⁻ᵀ½√·⊥∈≤≥≠∝∞∂∇∩ℓẐ̄̃]|\^\{")
# What may stand in one, beside that.
WEAK = re.compile(
    r"[=+\-/<>~|]|<=|>=|\d+(\.\d+)?|[A-Z]\d?\|?|[b-z]|log|exp|sqrt|min|max"
    r"|(diag|log|exp|sqrt|[A-Za-z])\(.*|\|.*"
)
OPERATOR = re.compile(r"[=+\-/·~∝]")
CODE = re.compile(r"`([^`]+)`")
LIST = re.compile(r"^(\s*)(- |\d+\. )")


def latex(formula: str) -> str:
    """LaTeX of an equation in plain text, such as Σ_i w_i² or N(x_t; x_{t-1}, σ²)."""
    # A capital sigma or pi that nothing follows to be summed over is a matrix, or a set.
    alone = r"(?!̄)(?=(_\w+)?([⁻ᵀ),;]| [=+]|$))"
    formula = re.sub("Σ" + alone, r"\\Sigma ", formula)
    formula = re.sub("Π" + alone, r"\\Pi ", formula)
    formula = re.sub(r"(?<=[=∈] ){([^{}]*)}", r"\\{\1\\}", formula)
    formula = re.sub(r"(?<![A-Za-z]{3})_([A-Za-z0-9]{2,})", r"_{\1}", formula)
    formula = re.sub(r"\|(\S[^|]*?(?<=\S))\|", r"\\vert \1\\vert ", formula)
    formula = re.sub(r"(?<=\w)\*", "^{*}", formula)
    formula = re.sub(r"(?<=\w)\.\.(?=\w)", r"\\ldots ", formula)
    for plain in sorted(SYMBOLS, key=len, reverse=True):
        formula = formula.replace(plain, SYMBOLS[plain])
    formula = re.sub(
        f"[{''.join(SUPERSCRIPTS)}]+",
        lambda found: "^{" + "".join(SUPERSCRIPTS[each] for each in found[0]) + "}",
        formula,
    )
    formula = re.sub(r"(?<![\\A-Za-z])[A-Za-z]{3,}(?:_[a-z]{3,})*", _word, formula)
    formula = re.sub(r"\\mathrm\{sqrt\}\(([^()]*(?:\([^()]*\)[^()]*)*)\)", r"\\sqrt{\1}", formula)
    return formula.replace("%", r"\%").strip()


def _word(found: re.Match[str]) -> str:
    word = found[0]
    if word in FUNCTIONS:
        return rf"\{word} " if found.string[found.end() :].startswith("(") else rf"\{word} \,"
    return r"\mathrm{" + word.replace("_", r"\_") + "}"


def _depth(text: str) -> int:
    return sum(text.count(each) for each in "([{") - sum(text.count(each) for each in ")]}")


def runs(text: str) -> Iterator[tuple[bool, str]]:
    """The text in pieces, each with whether it is a formula."""
    tokens = re.split(r"(\s+)", text)
    start = position = 0
    while position < len(tokens):
        end = _end_of_formula(tokens, position) if tokens[position].strip() else None
        if end is None:
            position += 1
            continue
        before, formula, after = _trimmed("".join(tokens[position:end]))
        if before or formula:
            yield False, "".join(tokens[start:position]) + before
            yield True, formula
            tokens[end - 1] = after
            start = end - 1
        position = end
    yield False, "".join(tokens[start:])


def _end_of_formula(tokens: list[str], start: int) -> int | None:
    """Where the formula that starts with a token ends, or None where none starts."""
    strong, depth, position = False, 0, start
    last = None
    while position < len(tokens):
        token = tokens[position]
        if not token.strip():
            position += 1
            continue
        bare = token.strip("()[]{},.;:")
        is_strong = bool(STRONG.search(token)) and not re.search(r"[A-Za-z]{3,}_", token)
        is_weak = bool(WEAK.fullmatch(bare)) or bare == "" or bool(re.match(r"\(?a[,)]", token))
        if strong and not is_strong and _is_factor(tokens, position):
            is_weak = True
        if not (is_strong or is_weak or (depth > 0 and strong)):
            break
        if position == start and (not is_strong and not re.match(r"[\dA-Za-z(|]", token)):
            break
        strong |= is_strong
        depth += _depth(token)
        position += 1
        if is_strong or is_weak:
            last = position
        if depth <= 0 and token[-1] in ",.;:":
            break
    if not strong or last is None or not re.search(r"\w|ℓ", "".join(tokens[start:last])):
        return None
    return last


def _is_factor(tokens: list[str], position: int) -> bool:
    """Whether a word stands between an operator and what can only be a formula."""
    near = [
        tokens[place] if 0 <= place < len(tokens) else "" for place in (position - 2, position + 2)
    ]
    return bool(OPERATOR.fullmatch(near[0]) and STRONG.search(near[1]))


def _trimmed(formula: str) -> tuple[str, str, str]:
    """Punctuation and operators around a formula, which belong to the sentence."""
    before = after = ""
    while formula:
        if formula[-1] in ",.;: \n":
            cut = 3 if formula.endswith("...") and _depth(formula) == 0 else 1
            formula, after = formula[:-cut], formula[-cut:] + after
        elif formula[-1] == ")" and _depth(formula) < 0:
            formula, after = formula[:-1], ")" + after
        elif formula[0] == "(" and _depth(formula) > 0:
            before, formula = before + "(", formula[1:]
        elif (
            formula[0] == "("
            and formula[-1] == ")"
            and _depth(formula[1:-1]) == 0
            and ("," not in formula)
        ):
            before, formula, after = before + "(", formula[1:-1], ")" + after
        elif re.search(r"\s[-=+/<>~|]$", formula):
            formula, after = formula[:-1], formula[-1] + after
        else:
            break
    return before, formula, after


def _text(text: str) -> str:
    """Text of a docstring with its formulas, the rest escaped."""
    pieces = []
    for is_formula, piece in runs(text):
        if is_formula and _depth(piece) == 0 and _renders(piece):
            joined = r"\ " if pieces and pieces[-1] and not pieces[-1][-1].isspace() else ""
            pieces.append(joined + f":math:`{latex(' '.join(piece.split()))}`" + r"\ ")
        else:
            piece = piece.replace("\\", "\\\\").replace("|", r"\|")
            parts = re.split(r"(\*\w[^*\n]*\*)", piece)  # the odd ones are emphasised
            parts[::2] = [part.replace("*", r"\*") for part in parts[::2]]
            pieces.append(re.sub(r"_(?=\W|$)", r"\\_", "".join(parts)))
    return "".join(pieces)


def _renders(formula: str) -> bool:
    try:
        tex2mathml(latex(" ".join(formula.split())))
    except Exception:  # whatever it is that the converter does not know
        return False
    return True


def _inline(paragraph: str) -> str:
    pieces = CODE.split(paragraph)
    turned = []
    for place, piece in enumerate(pieces):
        if place % 2 == 0:
            turned.append(_text(piece))
            continue
        before, after = pieces[place - 1][-1:], pieces[place + 1][:1]
        code = f"``{' '.join(piece.split())}``"
        turned.append(r"\ " * before.isalnum() + code + r"\ " * after.isalnum())
    return "".join(turned)


def to_rst(lines: list[str]) -> list[str]:
    """The lines of a docstring as lines of reStructuredText."""
    blocks: list[tuple[str, list[str]]] = []  # what it is: text, or an indented block
    for line in lines:
        is_item = LIST.match(line)
        indent = len(line) - len(line.lstrip())
        if not line.strip():
            blocks.append(("gap", []))
        elif is_item or not blocks or blocks[-1][0] == "gap":
            blocks.append(("text", [line]))
        else:
            kind, held = blocks[-1]
            item = LIST.match(held[0])
            margin = len(item[0]) if item else len(held[0]) - len(held[0].lstrip())
            if item and indent < margin:  # the paragraph after a list
                blocks.append(("text", [line]))
            else:
                held.append(line)
    out: list[str] = []
    margin = 0
    for kind, held in blocks:
        if kind == "gap":
            out.append("")
            continue
        item = LIST.match(held[0])
        indent = len(held[0]) - len(held[0].lstrip())
        text = "\n".join(line.strip() for line in held)
        if item is None and indent >= margin + 4:
            out += _block(held, indent, margin)
            continue
        margin = len(item[0]) if item else indent
        first = text[len(item[2]) :] if item else text
        turned = _inline(first).split("\n")
        lead = " " * indent + (item[2] if item else "")
        out += ["", lead + turned[0], *(" " * len(lead) + line for line in turned[1:]), ""]
    return out


def _block(held: list[str], indent: int, margin: int) -> list[str]:
    """An indented block: Python, or an equation on lines of its own."""
    body = [line[indent:] for line in held]
    pad = " " * margin
    formula = " ".join(" ".join(body).split()).rstrip(",.")
    is_code = re.search(r"mpfjax\.|\w+\.\w+\(|:$|\bin range", "\n".join(body), re.MULTILINE)
    if is_code or not _renders(formula):
        kind = "python" if is_code else "text"
        return ["", f"{pad}.. code-block:: {kind}", "", *(f"{pad}   {line}" for line in body), ""]
    return ["", f"{pad}.. math:: {latex(formula)}", ""]
