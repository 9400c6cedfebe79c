"""SACfD and, with recovery=true, SACfD+RRL end to end: ``ls3 train algorithm=sacfd`` from a clone."""

from ls3_recipes.commands.train import main

if __name__ == "__main__":
    main(algorithm="sacfd")
