"""The commit-msg hook: a subject is "part: what changed" within 72 characters."""

import re
import sys
from pathlib import Path

LONGEST = 72
PART = re.compile(r"[a-z][\w ,./-]*: \S")


def faults(message: str) -> list[str]:
    """Faults of the subject of a commit message; merges and reverts have forms of their own."""
    subject = message.partition("\n")[0].rstrip()
    if subject.startswith(("Merge ", "Revert ", "fixup! ", "squash! ")):
        return []
    result = []
    if len(subject) > LONGEST:
        result.append(f"the subject has {len(subject)} characters, the most are {LONGEST}")
    if not PART.match(subject):
        result.append('the subject does not begin with "part: ", as in "docs: shorten the guides"')
    return result


if __name__ == "__main__":
    sys.exit("\n".join(faults(Path(sys.argv[1]).read_text(encoding="utf-8"))) or 0)
