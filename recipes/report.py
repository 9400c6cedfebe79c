"""``ls3 report`` from a clone."""

from ls3_recipes.commands.report import main

if __name__ == "__main__":
    main()
