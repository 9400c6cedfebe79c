"""Many runs as one: which, in what order, where they are carried out, and what came of them."""


class JobsFailedError(RuntimeError):
    """Some jobs of a sweep failed; all others are finished."""
