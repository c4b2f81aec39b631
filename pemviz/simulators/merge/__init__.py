"""highway-env's own ``merge-v0`` as a black box: an ego passes a ramp, acting on what it tracks.

The road, the other cars and how they drive (IDM and MOBIL, which also react to the ego) are
highway-env's. Three cars are on the road; one on the ramp merges in front of the ego, or behind it.
Their lanes are fixed here, while places (+-5 m) and speeds (+-1 m/s) are drawn at the start as
merge-v0 draws them. Nothing of the environment can be saved; one step of it, of 0.2 s and three of
its simulation steps, is one step of a rollout.

Perception
    looks ahead: cars whose rear is in front of the ego's front, nearer than 100 m and within 60
    degrees of straight ahead, are its obstacles; a slot each, absent while out of view. What they
    hide of each other is left out. A detection measures exactly where the car is.
Ego
    wants 30 m/s, stays in its lane, and passes nobody: not those on the ramp, who are about to
    merge, nor on the right those of the left lane. It acts on the cars that it tracks within 6 m to
    either side, where they are or will be in a second by the track's speed. For one nearer than
    10 m and 1.2 s of driving it brakes (the environment's action SLOWER, 4 to 12 m/s^2); for one
    nearer than 10 m and 1.6 s it keeps its target speed (IDLE); else it speeds up (FASTER). Without
    a tracker it acts on the detections of the step alone, whose cars have no speed.
Rules
    stand in preset ``merge``: no collision; a safe distance to the car in front, if not now then
    within 3 s, as after a cut-in (Maierhofer et al. 2020, R_G1); no hard braking but for a car that
    is near and beside or before the ego (R_G2).
"""
