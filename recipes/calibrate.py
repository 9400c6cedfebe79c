"""``ls3 calibrate`` from a clone."""

from ls3_recipes.commands.calibrate import main

if __name__ == "__main__":
    main()
