"""The protocol that every algorithm follows: demonstrations, offline training, online improvement, evaluation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ls3_recipes.console import console
from ls3_recipes.experiment import Experiment
from ls3_recipes.interrupts import Interrupts
from ls3_recipes.run_settings import RunSettings
from ls3_torchrl.files import is_full
from ls3_torchrl.trainers import DivergenceError


def run_experiment(settings: RunSettings) -> dict:
    """Follow the protocol from demonstrations to pictures, from where the run in the output folder was cut off.

    Args:
        settings: of the run; an instance of its algorithm's settings.

    Returns:
        What is written to ``summary.json``.

    Raises:
        ValueError, FileNotFoundError, FileExistsError: for settings, data or folders that cannot be used; before any
            work is done.
        Interrupted: for Ctrl-C, SIGTERM or SIGHUP, when the state is on the disk.
        DivergenceError: when training diverges; what it was computed on is kept in the folder's ``diverged/``.
    """
    with Interrupts() as interrupts, _under_way(Experiment(settings, interrupts)) as experiment:
        experiment.collect()
        experiment.resume()
        experiment.train_offline()
        experiment.improve_online()
        experiment.select()
        experiment.evaluate()
        return experiment.finish()


def train_vae(settings: RunSettings) -> Path:
    """Follow the protocol until the VAE is trained, and keep it for runs that differ in nothing that it depends on.

    A run with ``vae.checkpoint`` and ``data`` from there ends in the bits of one that makes both itself.

    Args:
        settings: of one of these runs; ``output`` is the folder that the VAE goes to.

    Returns:
        The VAE's file, ``vae.pt`` in that folder.

    Raises:
        ValueError: for settings of a run without a VAE.
        Interrupted, DivergenceError: as :func:`run_experiment`.
    """
    with Interrupts() as interrupts, _under_way(Experiment(settings, interrupts)) as experiment:
        experiment.collect()
        experiment.resume()
        experiment.train_offline(only="vae")
        return experiment.keep_vae()


@contextmanager
def _under_way(experiment: Experiment) -> Iterator[Experiment]:
    """A run that has its folder; what ends it says how to go on."""
    experiment.start()
    try:
        yield experiment
    except DivergenceError as error:
        kept = experiment.folder.keep_divergence(error, experiment.algorithm.state_dict())
        error.add_note(f"The batch and the state of that moment are in {kept}.")
        raise
    except Exception as error:
        if experiment.under_way or is_full(error, experiment.folder.path):
            error.add_note(f"To go on when the cause is removed: ls3 train resume={experiment.folder.path}")
        raise
    except KeyboardInterrupt:
        console.print(f"To go on: ls3 train resume={experiment.folder.path}", markup=False, soft_wrap=True)
        raise
    finally:
        experiment.folder.close()
