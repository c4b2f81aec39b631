"""Traffic of a ``.sumocfg`` with the ego in it: encounters arise by themselves.

The network, the flows and how all other cars follow and change lanes are SUMO's, by the files that
the ``.sumocfg`` names; ``assets/sumo/free-traffic.sumocfg`` is shipped. One of its vehicles is the
ego (``sumo.ego``). A rollout begins ``sumo.warm_up_s`` after the ego has entered: until then SUMO
drives it. Steps last ``sumo.step_s``, whatever the file says.

Random
    SUMO's own generator, seeded for every rollout by a latent that no proposal moves: what it draws
    (who enters when, wanted speeds, dawdling) has no weight. Perception's outcomes are as
    elsewhere.
Processes
    libsumo holds one simulation in a process, so each of the rollouts that are carried out at a
    time has a process of its own, with nothing of pemviz's but the seed and the ego's
    accelerations. A rollout is the same whatever runs beside it. States cannot be kept.
Frame
    x along the ego's heading, y to its left. On a curve what is far ahead lies aside.
Perception
    looks ahead: cars whose rear is in front of the ego's front, nearer than 100 m and within 60
    degrees of straight ahead. The nearest in the ego's path and the nearest others, three in all,
    have a slot each, which they keep while they are among them (by up to 5 m); a slot is empty for
    a step before another car has it. What cars hide of each other is left out. A detection measures
    exactly where the car is and how fast.
Ego
    keeps its lane and drives by what is reported as in the logical scenarios
    (:mod:`pemviz.simulators.encounters.ego`, with the defaults of ``encounter``); it wants the
    speed that SUMO allows it where it is, ``wanted_speed``. It knows no traffic lights and gives no
    way: roads are to be motorways.
Signals
    ``distance`` driven [m], ``ego_speed``, ``ego_acceleration``; of each slot ``gap_NAME``,
    ``aside_NAME``, ``speed_NAME`` (along x) and ``heading_NAME``, a gap of 500 m where there is
    nobody; of four cars more, for pictures alone, the same but for the heading. ``clearance`` [m]
    to the nearest car whose centre is ahead of the ego's, below 0 in contact: who drives into the
    ego from behind is not counted. ``collided`` from such a contact on: the episode then ends.
    ``safe_distance`` [m], the gap to the nearest car ahead in the ego's path less its safe
    distance, once that car has been the nearest for 3 s (Maierhofer et al. 2020, R_G1);
    ``needless_deceleration`` [m/s^2], how much harder the ego braked than that car, 0 if that was
    nearer than its safe distance when the step began (R_G2).
"""
