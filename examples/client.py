"""Print the velocity, with velod's own client. Run beside a velod: python examples/client.py"""

from velod.client import VelocityClient

with VelocityClient("rig0", connect="tcp/127.0.0.1:17447") as client:
    for velocity in client:
        print(velocity.t_ns, velocity.v_B, velocity.cov.diagonal() ** 0.5)
