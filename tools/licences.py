"""What packages declare as their licence, and whether a BSD-3 project may depend on it.

Usage: python licences.py; names every installed package that is under GPL or AGPL, exit code 1 if there is one.
"""

import re
import sys
from importlib.metadata import PackageMetadata, distributions

#: GPL and AGPL in all spellings; the Lesser GPL, which may be linked to, is none of them.
COPYLEFT = re.compile(r"\bA?GPL|GNU (Affero )?General Public Licen[sc]e|GNU Affero", re.IGNORECASE)
#: A licence field longer than this holds whole texts, of bundled run-time libraries as well: the classifiers tell then.
LONGEST_NAME = 200


def licence_of(about: PackageMetadata) -> str:
    """What a package declares: the SPDX expression, or else its classifiers and the name in its licence field."""
    declared = about.get_all("License-Expression") or [
        one for one in about.get_all("Classifier") or [] if one.startswith("License ::")
    ]
    named = [one for one in about.get_all("License") or [] if len(one) <= LONGEST_NAME]
    titles = [one.strip().splitlines()[0] for one in about.get_all("License") or [] if one.strip() and not declared]
    return "; ".join([*declared, *named, *titles])


def main() -> int:
    """Exit code 1 where an installed package is copyleft."""
    wrong = [(one.metadata["Name"], licence_of(one.metadata)) for one in distributions()]
    wrong = [(name, licence) for name, licence in wrong if COPYLEFT.search(licence)]
    for name, licence in wrong:
        print(f"{name}: {licence}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
