"""SACfD and, with recovery=true, SACfD+RRL end to end."""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from comparisons import train


@hydra.main(version_base="1.3", config_path="conf", config_name="sacfd")
def main(config: DictConfig) -> None:
    """Entry point."""
    train(config)


if __name__ == "__main__":
    main()
