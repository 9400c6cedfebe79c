"""``ls3 benchmark`` from a clone."""

from ls3_recipes.commands.benchmark import main

if __name__ == "__main__":
    main()
