"""``ls3 sweep`` from a clone."""

from ls3_recipes.commands.sweep import main

if __name__ == "__main__":
    main()
