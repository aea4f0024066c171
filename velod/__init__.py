"""velod: metric linear velocity from a stereo event camera and an IMU."""


def __getattr__(name: str) -> str:
    """``__version__``, found when it is asked for: every command begins here, and Ctrl-C may come at any moment."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("velod")
    except PackageNotFoundError:  # a checkout that was not installed
        return "0+unknown"
