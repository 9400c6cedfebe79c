"""``python -m ls3_recipes`` is the command ``ls3``."""

from __future__ import annotations

import sys

from ls3_recipes.commands import main

if __name__ == "__main__":
    sys.exit(main())
