"""The last line of what an experiment or a training prints."""


def print_verdict(good: bool, text: str) -> int:
    """Print the last line of an experiment or a training: whether it reached its figures, and what it found.

    Returns:
        The exit status: 0 if it did, else 1.
    """
    print(f"verdict: {'passed' if good else 'FAILED'}: {text}")
    return 0 if good else 1
