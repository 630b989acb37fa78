"""Print what CHANGELOG.md says of a version.

python .github/release_notes.py 1.2.3
"""

import re
import sys
from pathlib import Path

CHANGELOG = Path(__file__).resolve().parents[1] / "CHANGELOG.md"


def notes(version: str, changelog: str) -> str:
    """Return the section of a version, without its heading.

    Raises
    ------
    ValueError
        There is none, or it is empty.
    """
    heading = rf"^## \[{re.escape(version)}\][^\n]*\n"
    found = re.search(rf"{heading}(.*?)(?=^## \[|\Z)", changelog, re.DOTALL | re.MULTILINE)
    if found is None or not found[1].strip():
        raise ValueError(f"CHANGELOG.md: no section [{version}]; rename [Unreleased] to it")
    return found[1].strip() + "\n"


if __name__ == "__main__":
    try:
        sys.stdout.write(notes(sys.argv[1], CHANGELOG.read_text(encoding="utf-8")))
    except (IndexError, ValueError) as error:
        sys.exit(str(error) if sys.argv[1:] else "usage: release_notes.py VERSION")
