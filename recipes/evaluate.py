"""``ls3 evaluate`` from a clone."""

from ls3_recipes.commands.evaluate import main

if __name__ == "__main__":
    main()
