"""The braking scenario on a CARLA server: what is asked of it, exactly.

``pemviz.simulators.braking`` says what the controller does; here CARLA's physics carries it out.
The server is one world, so rollouts come one after the other, and none of their states is kept.

- **World**: a straight road of our own, of which the server makes a world in place of whatever map
  it had; synchronous, a tick of ``dt_s`` (physics in substeps of at most 0.01 s), nothing rendered.
- **Cars**: both ``server.BLUEPRINT``, spawned anew for every rollout in one lane. They settle on
  the road, then both are held at the initial speed for ``server.LEAD_IN_S``; there the rollout
  begins. Gap and speeds must then be within 0.2 m and 0.2 m/s of what they should be.
- **Lead car**: held at every tick at the speed that the scenario's script has for it.
- **Ego**: the shipped controller, tracker included, from the measured gap and speed; its
  acceleration as a share of the scenario's limits is throttle or brake, so that emergency braking
  is full brake. What the car makes of it is CARLA's.
- **Signals**: gap from the ego's windscreen camera, 2 m behind the front of its bounding box, to
  the rear of the lead car's; speeds along the road. A rollout ends at contact.

Physics on a server need not repeat itself to the last digit. What it adds is part of the nominal
system and takes no part in weights; that a run repeats to the byte holds for the other back ends.

Never run against a server by us: only what needs none is tested, with the real client.
"""
