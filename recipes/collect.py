"""``ls3 collect`` from a clone."""

from ls3_recipes.commands.collect import main

if __name__ == "__main__":
    main()
