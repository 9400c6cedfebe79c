"""LS³ end to end: ``ls3 train algorithm=ls3`` from a clone."""

from ls3_recipes.commands.train import main

if __name__ == "__main__":
    main(algorithm="ls3")
