"""How a command ends."""

EXIT_FAILED = 1  # the run went wrong, or its result is not good enough
EXIT_USAGE = 2  # the user can put it right: a file, a setting, a port
EXIT_INTERRUPTED = 130


class RunFailed(Exception):
    """A run that went wrong through no fault of the command line; one line that says what and why."""
