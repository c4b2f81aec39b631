"""Eclipse SUMO, in this process, as a back end: what it steps, and what pemviz does around it.

Needs the extra ``pemviz[sumo]``: libsumo, the simulator as a library. It holds one simulation in a
process. ``assets/sumo/roads.net.xml`` therefore has 128 straight roads of three lanes (and a fourth
to sort cars) that do not meet, and each encounter of a batch drives on a road of its own: a batch
is stepped at once, and cars of other roads are nothing to SUMO.

**One step** (``engine.py``). Every car is put where the state has it, with its speed, the ego at
the middle of its road; SUMO moves all of them by one step and tells where they are and how fast.
Nothing is kept in SUMO between steps, so that states can be gone on from, in any order and beside
other simulators of this process, and a rollout is the same to the last digit in any batch. SUMO's
steps are ballistic: with speed v before a step and u after it, a car moves by (v + u) / 2 dt, where
``pemviz.simulators.braking`` and ``pemviz.simulators.encounters`` have v dt.

**Braking scenario.** SUMO is given the speeds that the specification gives both cars. For the same
accelerations its gaps therefore differ from the other back ends' by exactly dt / 2 times what the
closing speed has grown by since the start (to 1e-9), at most 0.025 s times 20 m/s, half a metre,
in the preset ``paper``. Where that moves a gap past ``emergency_gap_m`` the ego brakes a step
earlier or later.

**Logical scenarios.** The ego drives by what is reported, as the specification says, and SUMO is
given its speed. Other cars drive by a model of SUMO's, ``sumo.model``: IDM, Krauss or ACC, with
SUMO's own parameters, and with the speed they start with as the one that they want. They thereby
react to those ahead in their lane, the ego among them: the lead car of ``cut-out`` brakes for the
one that it hides. Given remain, as the specification has them: where cars begin; a lead car's
braking, from ``brake_time`` on; the lateral profile, with speeds along the road from SUMO; and that
what touched stands. A car is in the lane of SUMO's in which its centre is. From its step's start to
its end a car's deceleration is the average.

**What is random** are the start values and perception alone. The shipped types of cars have no
imperfection (sigma) and no spread of speeds, so SUMO draws no random number. SUMO's ACC remembers
between gaps of 100 and 120 m whether it was following; here it always keeps its speed there.
"""
