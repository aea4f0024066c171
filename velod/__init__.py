"""velod: metric linear velocity from a stereo event camera and an IMU."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("velod")
except PackageNotFoundError:  # a checkout that was not installed
    __version__ = "0+unknown"
