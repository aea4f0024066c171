"""Every run of the tests tries the same examples; a slow machine is not a failure."""

from hypothesis import HealthCheck, settings

settings.register_profile("velod", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("velod")
