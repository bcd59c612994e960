"""Exceptions of the library. They carry what is wrong and what to do about it; the command line prints them."""

from __future__ import annotations


class SSAError(Exception):
    """Base class: a problem and its remedy, each one sentence fragment without a final period."""

    def __init__(self, problem: str, remedy: str = "") -> None:
        """Store both parts.

        Args:
            problem: what is wrong with which file, value or step.
            remedy: what the user can do about it; empty where the problem says it.
        """
        super().__init__(problem, remedy)
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        """Problem and remedy in one line."""
        return " ".join("; ".join(part for part in (self.problem, self.remedy) if part).split())


class InputError(SSAError, ValueError):
    """An input that cannot be used: a file, an argument, a dataset, a checkpoint. Exit code 2 of a command."""


class TrainingError(SSAError, RuntimeError):
    """A training with valid input that cannot continue. Exit code 3 of a command."""


class TrainingStopped(SSAError):
    """A training that its user stopped by ctrl+c. Exit code 130 of a command."""
