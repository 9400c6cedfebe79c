"""``ls3 gallery`` from a clone."""

from ls3_recipes.commands.gallery import main

if __name__ == "__main__":
    main()
