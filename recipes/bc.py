"""Behaviour cloning end to end: ``ls3 train algorithm=bc`` from a clone."""

from ls3_recipes.commands.train import main

if __name__ == "__main__":
    main(algorithm="bc")
